"""Errors that only the model can detect: refused before the first step, with one message and status 2 on all ranks."""

import pytest

from pfem_petsc import Case, Simulation
from pfem_petsc.errors import InputError

IMPLICIT = ["time.integrator=newmark"]
UNSTABLE = [*IMPLICIT, "time.gamma=0.4"]
WALL = "wall=[{name='wall', type='plane', point=[0.97, 0.0, 0.0], normal=[-1.0, 0.0, 0.0]}]"
REFUSED = {
    "node beyond a wall": ([WALL], ["wall 'wall'", "node 20", "0.03 m beyond", "1 node in all"]),
    "step above the limit": (["time.step=0.051"], ["time.step = 0.051", "central_differences", "0.05 s", "auto"]),
    "limit of chung_lee": (
        ["time.integrator=chung_lee", "time.step=0.048"],
        ["time.step = 0.048", "chung_lee", "0.0466"],
    ),
    "limit with consistent mass": (
        ["time.mass=consistent", "time.step=0.03"],
        ["time.step = 0.03", "0.02886"],
    ),
    "auto step of an implicit scheme": ([*IMPLICIT, "time.step='auto'"], ["time.step", "newmark"]),
    "scheme unstable at any step": (UNSTABLE, ["newmark", "unstable at any step", "gamma"]),
    "unknown bar group": (["section.default.bars=rd"], ["section.default.bars", "'rd'", "rod"]),
    "unknown node group": (["node_set.tip={group='edn'}"], ["node_set.tip.group", "'edn'", "end"]),
    "node that is not there": (["node_set.tip={indices=[21]}"], ["node_set.tip.indices", "21", "0 to 20"]),
    "empty box": (["node_set.tip={box=[[2.0, 0.0, 0.0], [3.0, 1.0, 1.0]]}"], ["node_set.tip", "no node"]),
    "wall without normal": (["wall.0.normal=[0.0, 0.0, 0.0]"], ["wall", "normal", "zero length"]),
}


@pytest.mark.parallel
@pytest.mark.parametrize("what", REFUSED)
def test_refused_on_all_ranks(what, comm, shared_tmp_path):
    overrides, parts = REFUSED[what]
    folder = shared_tmp_path / "out"
    with pytest.raises(InputError) as error:
        Simulation(Case.load("rod_impact", overrides), comm, output=folder, quiet=True).run()
    assert error.value.exit_status == 2
    message = str(error.value)
    assert comm.allgather(message) == [message] * comm.size
    for part in ("rod_impact", *parts):
        assert part in message, message
    assert not folder.exists()


@pytest.mark.parallel
def test_steps_at_the_limit_are_taken(comm, shared_tmp_path):
    for k, keys in enumerate((["time.step=0.05"], ["time.integrator=chung_lee", "time.step=0.0466"])):
        case = Case.load("rod_impact", [*keys, "time.end=0.5"])
        assert Simulation(case, comm, output=shared_tmp_path / str(k), quiet=True).run() == 0


@pytest.mark.slow
@pytest.mark.parametrize(("what", "ranks"), [("node beyond a wall", 2), ("step above the limit", 1)])
def test_status_of_the_command_line(what, ranks, tmp_path, on_ranks):
    overrides, parts = REFUSED[what]
    keys = [word for key in overrides for word in ("--set", key)]
    done = on_ranks(ranks, "-m", "pfem_petsc", "rod_impact", "-o", tmp_path / "out", "--quiet", *keys, timeout=300)
    assert done.returncode == 2
    message = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert len(message) == 1
    for part in parts:
        assert part in message[0]
    assert "Traceback" not in done.stderr


@pytest.mark.slow
def test_status_of_a_failing_run(tmp_path, on_ranks):
    """A bar driven through zero length: status 3."""
    keys = ["--set", "initial.velocity=[3.0, 0.0, 0.0]"]
    done = on_ranks(2, "-m", "pfem_petsc", "rod_impact", "-o", tmp_path / "out", "--quiet", *keys, timeout=300)
    assert done.returncode == 3
    assert done.stderr.count("error: ") == 1
    assert "gone through zero length" in done.stderr
    assert (tmp_path / "out" / "result.vtkhdf").is_file()

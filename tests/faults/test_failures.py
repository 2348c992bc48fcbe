"""Failures provoked during runs on two ranks: both end with status 3, one message and readable results."""

import subprocess
import sys

import numpy as np
import pytest
from helpers.launch import environment

from pfem_petsc.output.result import open_result

pytestmark = pytest.mark.slow

SCRIPT = """
import os, signal, shutil, sys, time
import numpy as np
from mpi4py import MPI
from pfem_petsc.cli.main import main
from pfem_petsc.stepping import plan
from pfem_petsc.stepping.stepper import Stepper
from pfem_petsc.stepping.explicit import ExplicitStepper
from pfem_petsc.stepping.implicit import ImplicitStepper
rank = MPI.COMM_WORLD.rank
folder = sys.argv[sys.argv.index("-o") + 1]

{before}
def provoke(stepper):
    state = stepper.state
{body}

provoked = []

def watched(steps):
    def wrapper(self, most):
        if self.state.step >= {at} and not provoked:  # a batch may pass this step
            provoked.append(True)
            if rank == 0:
                print("provoked after step", self.state.step, flush=True)
            provoke(self)
        steps(self, most)
    return wrapper

for kind in (ExplicitStepper, ImplicitStepper):
    kind.steps = watched(kind.steps)
sys.exit(main(sys.argv[1:]))
"""

ROD = ["rod_impact", "--quiet", "--set", "time.end=1000", "mesh.elements=40"]


def fail(on_ranks, tmp_path, body, *words, at=57, folder=None, before=""):
    """Run with a fault before step ``at`` + 1; gives the finished process. One that hangs ends in a time-out."""
    script, folder = tmp_path / "fault.py", folder or tmp_path / "out"
    lines = "\n".join(f"    {line}" for line in body.splitlines())
    script.write_text(SCRIPT.format(body=lines, at=at, before=before))
    done = on_ranks(2, script, *words, "-o", folder, timeout=300.0, cwd=tmp_path)
    assert "provoked" in done.stdout, done.stderr
    return done


def run_on_ranks(ranks, *arguments, timeout, cwd):
    """As ``on_ranks``, where a killed rank is no time-out."""
    line = ["mpirun", "-n", str(ranks), sys.executable, *map(str, arguments)]
    return subprocess.run(line, env=environment(), capture_output=True, text=True, timeout=timeout, cwd=cwd)


def assert_told(done, *texts, status=3):
    assert done.returncode == status, done.stderr
    said = [line for line in done.stderr.splitlines() if "error: " in line]
    assert len(said) == 1, done.stderr
    for text in texts:
        assert text in said[0]
    assert "Traceback" not in done.stderr


def assert_results(folder, last):
    """Readable, with sound numbers up to about the step of the fault."""
    with open_result(folder) as result:
        assert len(result.times) >= 1
        assert np.isfinite(result.positions(-1)).all()
        steps = result.history["step"]
        np.testing.assert_array_equal(np.diff(steps), steps[1] - steps[0])
        assert last - 10 <= steps[-1] <= last + 100
        for name in result.history:
            assert np.isfinite(np.asarray(result.history[name], dtype=float)).all(), name


def assert_last_snapshot(done, folder):
    """The last one before the fault, of one every ten steps of 0.01."""
    provoked = int(done.stdout.split("provoked after step")[1].split()[0])
    with open_result(folder) as result:
        assert result.times[-1] == pytest.approx(provoked // 10 / 10)


@pytest.mark.parametrize("failing", [0, 1])
def test_exception_on_one_rank(on_ranks, tmp_path, failing):
    """The other rank waits in an exchange of ghosts that never ends."""
    body = f"if rank == {failing}: raise ZeroDivisionError('surprise')"
    done = fail(on_ranks, tmp_path, body, *ROD)
    assert_told(done, f"rank {failing}: ", "ZeroDivisionError: surprise")
    assert_last_snapshot(done, tmp_path / "out")


def test_killed_rank(tmp_path):
    """The launcher ends the others; the status is its own."""
    body = "if rank == 1: os.kill(os.getpid(), signal.SIGKILL)"
    done = fail(run_on_ranks, tmp_path, body, *ROD)
    assert done.returncode not in (0, 2, 4)
    assert_last_snapshot(done, tmp_path / "out")


@pytest.mark.parametrize("every", [1, 100_000])
def test_positions_that_are_no_numbers(on_ranks, tmp_path, every):
    """Found also where no history row is written, and told with the bar."""
    body = "if rank == 1: state.memory['half_velocity'][0] = np.nan"
    words = (f"output.history_every={every}", "output.fields_every=0")
    done = fail(on_ranks, tmp_path, body, *ROD, *words)
    assert_told(done, "diverged", "bar ", "nodes ", "reduce time.step", "step ")
    said, last = done.stderr.partition("step ")[2], int(done.stdout.partition("after step")[2].split()[0])
    assert last <= int(said.partition(",")[0]) <= last + 101
    with open_result(tmp_path / "out") as result:
        assert len(result.times) == 1
        assert np.isfinite(result.positions(-1)).all()
        assert result.history["step"][-1] == (last if every == 1 else 0)


def test_unstable_step(on_ranks, tmp_path):
    """The frequency is taken for half of what it is, as where a structure stiffens far beyond its first state."""
    halved = "found = plan.highest_frequency\nplan.highest_frequency = lambda *given: type(found(*given))("
    halved += "*(0.5 * frequency for frequency in found(*given)))\n"
    # two per cent above the limit, so that it takes some steps; stiff, so that the bar is far from zero length then
    words = ["pendulum", "--quiet", "--set", "material.default.young_modulus=1e10", "time.step=4.56e-4"]
    done = fail(on_ranks, tmp_path, "pass", *words, at=1, before=halved)
    assert_told(done, "the integration has created", "the motion is unstable", "at node", "reduce time.step")
    with open_result(tmp_path / "out") as result:
        kinetic = result.history["kinetic_energy"]
        assert np.isfinite(kinetic).all()
        assert 10 < len(kinetic) < 200


@pytest.mark.parametrize("integrator", ["central_differences", "newmark"])
def test_collapsed_bar(on_ranks, tmp_path, integrator):
    """The rod hits the wall at five times its wave speed."""
    words = ("initial.velocity=[5,0,0]", "time.step=0.002", f"time.integrator={integrator}", "time.end=1")
    done = fail(on_ranks, tmp_path, "pass", *ROD, *words, at=0)
    assert_told(done, "step ", "bar 39 between nodes 39 and 40", "the impact is too strong")
    with open_result(tmp_path / "out") as result:
        assert np.isfinite(result.positions(-1)).all()


@pytest.mark.parametrize(
    ("body", "text"),
    [
        ("if rank == 1: state.v[0] = np.nan", "step 58"),
        (
            "stepper.hessian.fill = lambda write: (stepper.hessian.mat.zeroEntries(), stepper.hessian.mat.assemble())",
            "bisected 10 times",
        ),
    ],
    ids=["velocities that are no numbers", "neither stiffness nor mass"],
)
def test_implicit_step_without_a_solution(on_ranks, tmp_path, body, text):
    """No halving of the step mends it; nothing of it gets into the results."""
    done = fail(on_ranks, tmp_path, body, *ROD, "time.integrator=newmark", "time.end=2", "output.fields_every=1")
    assert_told(done, "step 58", text)
    assert_results(tmp_path / "out", 57)


def test_folder_that_vanishes(on_ranks, tmp_path):
    done = fail(on_ranks, tmp_path, "if rank == 0: os.rename(folder, folder + '-gone')", *ROD)
    assert_told(done, "result.vtkhdf: gone or unreachable during the run")
    assert_results(tmp_path / "out-gone", 57)


@pytest.fixture
def small(tmp_path):
    """A file system of sixteen megabytes."""
    folder = tmp_path / "small"
    folder.mkdir()
    try:
        subprocess.run(["mount", "-t", "tmpfs", "-o", "size=16m", "tmpfs", folder], check=True, capture_output=True)
    except (FileNotFoundError, subprocess.CalledProcessError) as error:
        pytest.skip(f"cannot mount a small file system: {error}")
    yield folder
    subprocess.run(["umount", "-l", folder], check=True)


def filled(leave):
    """Lines that fill the disk up to so many bytes."""
    return (
        "if rank == 0:\n"
        "    free = shutil.disk_usage(folder).free\n"
        f"    with open(os.path.join(folder, 'filler'), 'wb') as file: file.write(bytes(max(0, free - {leave})))"
    )


@pytest.mark.parametrize("words", [("output.fields_every=1",), ("output.fields_every=0",)], ids=["fields", "history"])
def test_full_disk(on_ranks, tmp_path, small, words):
    """All that was flushed before is whole, and the run goes on from it once there is room."""
    words = (*words, "output.checkpoint_every=50", "time.end=8")
    done = fail(on_ranks, tmp_path, filled(100_000), *ROD, *words, folder=small / "out")
    assert_told(done, "disk full", "make room and continue with --restart")
    (small / "out" / "filler").unlink()
    with open_result(small / "out") as result:
        steps = result.history["step"]
        np.testing.assert_array_equal(steps, range(len(steps)))
        assert len(steps) > 50
        assert np.isfinite(result.positions(-1)).all()
        if words[0] == "output.fields_every=1":
            np.testing.assert_array_equal(result.steps, range(len(result.times)))
            assert len(result.times) > 50
    again = ("-m", "pfem_petsc", *ROD, *words, "time.end=2", "-o", small / "out", "--restart")
    done = on_ranks(2, *again, timeout=300.0)
    assert done.returncode == 0, done.stderr

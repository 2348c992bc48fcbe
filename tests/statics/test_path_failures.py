"""Paths that cannot be followed, cases that ask for what paths do not have, and motions that meet no stiffness."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.small_models import TRUSSES
from mpi4py import MPI

import pfem_petsc.statics.stability
from pfem_petsc import Case, Simulation, Truss, open_result
from pfem_petsc.cli.main import main
from pfem_petsc.errors import InputError, SimulationFailure
from pfem_petsc.solvers.linear import has_mumps


def von_mises(static=None, **tables):
    data = Case.load("von_mises").to_dict()
    if static is not None:
        data["static"] = static
    data |= tables
    return Case.from_dict(data, name="von_mises", source="case.toml")


def failure(case, folder, comm=MPI.COMM_SELF):
    with pytest.raises(SimulationFailure) as raised, Simulation(case, comm, output=folder, quiet=True) as simulation:
        simulation.run()
    return str(raised.value)


FOLLOWED = {"node_set": "apex", "direction": [0.0, 0.0, -1.0]}


@pytest.mark.parametrize(
    ("static", "words"),
    [
        ({"method": "displacement"}, "node_set and direction are missing"),
        ({"method": "arc_length", "displacement": 0.1}, "displacement needs node_set"),
        ({"method": "arc_length", "node_set": "apex"}, "node_set and direction belong together"),
        ({"method": "arc_length", "node_set": "apx", "direction": [0.0, 0.0, 1.0]}, "apex"),
        ({"method": "arc_length", **FOLLOWED, "direction": [0.0, 0.0, 0.0]}, "has zero length"),
        ({"method": "arc_length", "step": 0.1, "max_step": 0.01}, "max_step = 0.01 is smaller"),
        ({"method": "arc_length", "branch_at": [0]}, "from 1"),
        ({"method": "arc_length", "branch_at": [1], "critical_points": False}, "critical_points"),
    ],
)
def test_keys_that_are_refused(static, words):
    with pytest.raises(InputError, match=words):
        von_mises(static)


FLOOR = {"name": "floor", "type": "plane", "point": [0.0, 0.0, -0.5], "normal": [0.0, 0.0, 1.0]}


@pytest.mark.parametrize(
    ("tables", "words"),
    [
        ({"wall": [FLOOR]}, "remove walls"),
        ({"load": []}, "nothing depends on the load factor"),
        ({"load": [{"node_set": "feet", "force": [0.0, 0.0, -1.0]}]}, "moves no node"),
    ],
)
def test_cases_that_have_no_path(tables, words, tmp_path):
    with pytest.raises((InputError, SimulationFailure), match=words):
        Simulation(von_mises(**tables), MPI.COMM_SELF, output=tmp_path / "a", quiet=True).run()


def test_path_that_cannot_go_on_keeps_its_points(tmp_path):
    """A load whose table stops at 0.2: no point has a larger load, and lengths ask for one."""
    load = [{"node_set": "apex", "force": [0.0, 0.0, -100.0], "table": [[0.0, 0.0], [0.2, 0.2]]}]
    text = failure(von_mises(load=load), tmp_path / "a")
    assert "cannot be followed beyond point" in text
    reached = float(text.split("at load factor ")[1].split()[0])
    history = open_result(tmp_path / "a").history
    assert history["load_factor"][-1] == pytest.approx(reached, rel=1e-5)
    assert len(history["load_factor"]) > 3


@pytest.mark.slow
def test_displacement_that_turns_back(tmp_path):
    """The dome of 16 bars goes up again after the third limit point: displacement control says so and stops."""
    data = Case.load("dome_16").to_dict()
    data["static"]["method"] = "displacement"
    text = failure(Case.from_dict(data), tmp_path / "a")
    assert "arc_length" in text
    history = open_result(tmp_path / "a").history
    assert (history["event/kind"] == "limit").sum() == 3
    assert 0.143 < 0.1016 - history["probe/apex/position"][-1, 0, 2] < 0.16


class TestFreeMotions:
    @pytest.mark.parametrize("dense", [True, False])
    @pytest.mark.parametrize("method", ["newton", "arc_length"])
    def test_rotation_of_two_bars(self, method, dense, tmp_path, monkeypatch):
        """An arch that nothing stops to turn about the line through its feet."""
        if not dense:
            monkeypatch.setattr(pfem_petsc.statics.stability, "DENSE", 0)
        case = von_mises({"method": method}, support=[{"node_set": "feet", "fix": "xyz"}])
        text = failure(case, tmp_path / "a")
        assert "leaves 1 motion free, of the truss as a rigid body: node 0 along (0, 1, 0)" in text

    @pytest.mark.parallel
    def test_mechanisms_of_the_dome(self, comm, shared_tmp_path):
        """Feet held in z alone: 23 unknowns and 16 bars leave 7 motions, 3 of the dome as a whole."""
        data = Case.load("dome_16").to_dict()
        data["support"] = [{"node_set": "feet", "fix": "z"}]
        text = failure(Case.from_dict(data), shared_tmp_path / "a", comm)
        assert "leaves 7 motions free, 3 of them of the truss as a rigid body: node" in text

    def test_limit_point_is_no_free_motion(self, tmp_path):
        """Newton's method stops next to the limit load, where the stiffness is small."""
        text = failure(von_mises({"method": "newton", "step": 0.05, "min_step": 1e-6, "end": 1.0}), tmp_path / "a")
        reached = float(text.split("beyond load factor ")[1].split()[0])
        assert 0.38 < reached < 0.3810873
        assert "free" not in text


@pytest.mark.slow
@pytest.mark.parallel
def test_large_models_have_their_bifurcations_by_mumps(comm, shared_tmp_path, monkeypatch):
    """Multigrid solves for the path, the inertia is that of a factorisation on all ranks; beyond, the log tells."""
    stability = pfem_petsc.statics.stability
    if not has_mumps():
        pytest.skip("this PETSc does not have MUMPS")
    monkeypatch.setattr(stability, "DENSE", 0)
    monkeypatch.setattr(stability, "LARGEST", 0)
    keys = ["static.step=0.05", "static.max_points=15", "output.fields_every=0", "solver.linear=gamg"]
    case = Case.load("dome_16", keys)
    with Simulation(case, comm, output=shared_tmp_path / "a", quiet=True) as simulation:
        simulation.run()
    if comm.rank == 0:
        history = open_result(shared_tmp_path / "a").history
        bifurcations = np.asarray(history["event/kind"]) == "bifurcation"
        assert history["event/load_factor"][bifurcations] == pytest.approx([0.3096137053, 0.3203373879], rel=1e-6)
    monkeypatch.setattr(stability, "LARGEST_WITH_MUMPS", 0)
    with Simulation(case, comm, output=shared_tmp_path / "b", quiet=True) as simulation:
        assert "the model has 27 unknowns, more than 0" in simulation.stepper.scheme.notice


@pytest.mark.parallel
@pytest.mark.parametrize(
    "solver", [("gamg", "assembled"), ("gamg", "matrix_free"), ("mumps", "matrix_free"), ("mumps", "assembled")]
)
def test_linear_solvers_find_the_same_path(solver, comm, shared_tmp_path):
    linear, operator = solver
    limits = ["static.step=0.05", "static.max_points=9", "output.fields_every=0"]
    case = Case.load("dome_16", [*limits, f"solver.linear={linear}", f"solver.operator={operator}"])
    Simulation(case, comm, output=shared_tmp_path / "a", quiet=True).run()
    if comm.rank == 0:
        history = open_result(shared_tmp_path / "a").history
        assert history["event/load_factor"] == pytest.approx([0.09565880620, -0.09612898292], rel=1e-8)


PLANE = """\
[mesh]
generator = "arrays"
points = [[0,0,0],[4,0,0],[2,0,1.5]]
bars = [[0,1],[1,2],[0,2]]
[node_set]
feet = { indices = [0, 1] }
apex = { indices = [2] }
[material.steel]
young_modulus = 210e9
density = 7850.0
[section.all]
area = 5e-4
material = "steel"
[[support]]
node_set = "feet"
fix = "xyz"
[[load]]
node_set = "apex"
force = [0.0, 0.0, -1000.0]
[static]
step = 1.0
"""
SUPPORT = '[[support]]\nnode_set = "apex"\nnormal = [0.1, 1.0, 0.2]\n'


def static(points, bars, fixed, **method):
    """A truss under loads on its last node, in a static analysis by a factorisation."""
    data = {
        "node_set": {"fixed": {"indices": fixed or [0]}, "last": {"indices": [len(points) - 1]}},
        "material": {"m": {"young_modulus": 1e9, "density": 1000.0}},
        "section": {"s": {"area": 1e-3, "material": "m"}},
        "support": [{"node_set": "fixed", "fix": "xyz" if fixed else "x"}],
        "load": [{"node_set": "last", "force": [1.0, 2.0, 3.0]}],
        "static": {"step": 1.0, **method},
        "output": {"fields_every": 0},
    }
    return Case(data, mesh=Truss(np.array(points, dtype=float), bars))


@pytest.mark.parallel
@pytest.mark.parametrize("name", ["hinged square", "tetrahedron", "cube of edges", "square with a whip"])
def test_as_many_motions_as_counted_by_hand(name, comm):
    """Of Maxwell's count: free components less bars, and states of self-stress."""
    points, bars, fixed, (*_, self_stresses, _) = TRUSSES[name]
    free = 3 * (len(points) - len(fixed)) - (0 if fixed else 1)
    rank = len(bars) - self_stresses
    with Simulation(static(points, bars, fixed), comm, check_only=True) as simulation:
        text = simulation.obstacle()
    count = free - rank
    assert f"leaves {min(count, 8)}{' or more' * (count >= 8)} motion{'s' * (count > 1)} free" in text


@pytest.mark.parallel
@pytest.mark.parametrize("method", ["newton", "arc_length"])
def test_a_run_ends_at_once(method, comm, shared_tmp_path):
    """Without halving the increment; the message is that of the check."""
    points, bars, fixed, _ = TRUSSES["hinged square"]
    case = static(points, bars, fixed, method=method, **({"max_points": 3} if method == "arc_length" else {}))
    simulation = Simulation(case, comm, output=shared_tmp_path / "out", quiet=True)
    named = simulation.obstacle()
    with simulation, pytest.raises(SimulationFailure) as failure:
        simulation.run()
    assert str(failure.value) == named
    assert "halving" not in (shared_tmp_path / "out" / "log.txt").read_text()


def test_a_check_refuses_the_plane_truss_that_is_free_across(tmp_path, capsys):
    """Status 2 with the node and its direction; with a roller that is no axis, which stops it, the case can run."""
    (tmp_path / "free.toml").write_text(PLANE)
    (tmp_path / "held.toml").write_text(PLANE + SUPPORT)
    assert main(["check", str(tmp_path / "free.toml")]) == 2
    out, err = capsys.readouterr()
    assert "This case can run" not in out and "1 free directions out of it" in out
    assert err.count("node 2 along (0, 1, 0)") == 1
    assert "can move freely" not in out + err
    assert main(["check", str(tmp_path / "held.toml")]) == 0
    assert "This case can run" in capsys.readouterr()[0]

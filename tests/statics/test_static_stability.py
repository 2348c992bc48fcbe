"""Static analyses that end on unstable equilibria tell it, and those on stable ones do not."""

from __future__ import annotations

import numpy as np
import pytest

from pfem_petsc import Case, Simulation
from pfem_petsc.statics.equilibrium import problem_at_rest
from pfem_petsc.statics.stability import is_indefinite

UNSTABLE = "the equilibrium is unstable, with"
STIFFNESS, SIDE, SHORT, LONG = 100.0, 4.0, 0.5, 1.0
STEEL = {"young_modulus": 1e9, "density": 1000.0}


def strut(force, **tables):
    """A pin-ended rod of two bars along z, whose joint two soft springs hold along x: it buckles at k L/4."""
    given = {
        "mesh": {
            "generator": "arrays",
            "points": [[0.0, 0.0, 0.0], [0.0, 0.0, SHORT], [0.0, 0.0, LONG], [SIDE, 0.0, SHORT], [-SIDE, 0.0, SHORT]],
            "bars": [[0, 1], [1, 2], [1, 3], [1, 4]],
            "bar_groups": {"rod": [0, 1], "springs": [2, 3]},
        },
        "node_set": {"base": {"indices": [0, 3, 4]}, "joint": {"indices": [1]}, "top": {"indices": [2]}},
        "material": {"steel": STEEL},
        "section": {
            "rod": {"bars": "rod", "area": 1e-4, "material": "steel"},
            "springs": {"bars": "springs", "area": 0.5 * STIFFNESS * SIDE / 1e9, "material": "steel"},
        },
        "support": [
            {"node_set": "base", "fix": "xyz"},
            {"node_set": "joint", "fix": "y"},
            {"node_set": "top", "fix": "xy"},
        ],
        "load": [{"node_set": "top", "force": [0.0, 0.0, -force]}],
        "static": {"step": 0.25},
    } | tables
    return Case.from_dict({key: value for key, value in given.items() if value is not None}, source="strut.toml")


CRITICAL = STIFFNESS * LONG / 4.0
METHODS = {
    "newton": {"step": 0.25},
    "stabilised": {"step": 0.25, "stabilise": 1e-6},
    "relaxation": {"method": "relaxation", "step": 1.0},
    "relaxation alone": {"method": "relaxation", "step": 1.0, "newton": False},
}


def warnings(case, comm, folder, capsys):
    with Simulation(case, comm, output=folder / "out", quiet=True) as simulation:
        simulation.run()
    return comm.bcast(capsys.readouterr().err)


@pytest.mark.parallel
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("share", [0.99, 1.01])
def test_beyond_the_buckling_load(comm, shared_tmp_path, capsys, method, share):
    """Nothing bends a straight strut: it stays straight beyond its buckling load, and the run ends with status 0."""
    told = warnings(strut(share * CRITICAL, static=METHODS[method]), comm, shared_tmp_path, capsys)
    assert (f"load factor 1: {UNSTABLE} 1 negative eigenvalue of" in told) == (share > 1.0)
    assert (UNSTABLE in told) == (share > 1.0)


@pytest.mark.parallel
def test_a_stage_that_ends_on_an_unstable_equilibrium(comm, shared_tmp_path, capsys):
    """The second stage takes the load away: only the first one ends beyond the buckling load."""
    away = {"node_set": "top", "force": [0.0, 0.0, 1.5 * CRITICAL]}
    press = {"name": "press", "static": {"step": 0.5}}
    lift = {"name": "lift", "static": {"step": 0.5}, "load": [away]}
    case = strut(1.5 * CRITICAL, static=None, stage=[press, lift])
    assert warnings(case, comm, shared_tmp_path, capsys).count(UNSTABLE) == 1


@pytest.mark.parallel
@pytest.mark.parametrize("radius", [None, 0.2])
def test_walls_hold_what_would_be_unstable(comm, shared_tmp_path, capsys, radius):
    """The joint of a strut that is loaded beyond its buckling load leans on walls on both sides of it."""
    wall = {"name": "side", "type": "plane", "point": [1e-4, 0.0, 0.0], "normal": [-1.0, 0.0, 0.0], "node_set": "joint"}
    if radius is not None:  # inside of a tube
        axis = {"point": [1e-4 - radius, 0.0, SHORT], "axis": [0.0, 0.0, 1.0], "radius": radius, "side": "inside"}
        wall = {"name": "side", "type": "cylinder", "node_set": "joint"} | axis
    push = [{"node_set": "joint", "force": [1.0, 0.0, 0.0]}, {"node_set": "top", "force": [0.0, 0.0, -1.5 * CRITICAL]}]
    case = strut(0.0, load=push, wall=[wall], static={"step": 0.02})
    assert UNSTABLE not in warnings(case, comm, shared_tmp_path, capsys)


@pytest.mark.parallel
@pytest.mark.parametrize(("linear", "operator"), [("mumps", "assembled"), ("gamg", "assembled"), ("cg", "matrix_free")])
@pytest.mark.parametrize("share", [0.99, 1.01])
def test_conjugate_gradients_find_the_negative_curvature(comm, shared_tmp_path, linear, operator, share):
    """What large models without a factorisation use, on the strut; the mode is orthogonal to its load."""
    case = strut(share * CRITICAL, solver={"linear": linear, "operator": operator})
    with Simulation(case, comm, output=shared_tmp_path / "out", quiet=True) as simulation:
        simulation.run()
        stepper = simulation.stepper
        model, state = stepper.model, stepper.state
        problem = problem_at_rest(model, state, state.external)
        stepper.hessian.put(problem, model.bars.state_stiffness(state.x))
        free = np.zeros(model.mesh.n_owned, dtype=bool)
        assert is_indefinite(model, stepper.hessian, stepper.lagged, free) == (share > 1.0)
        assert not is_indefinite(model, stepper.hessian, stepper.lagged, ~free)


def test_a_path_names_the_stability_of_its_end(comm, shared_tmp_path):
    static = {"method": "arc_length", "step": 0.25, "end": 1.0}
    case = strut(1.01 * CRITICAL, static=static)
    with Simulation(case, comm, output=shared_tmp_path / "out", quiet=True) as simulation:
        simulation.run()
    log = (shared_tmp_path / "out" / "log.txt").read_text()
    assert "the equilibrium there is unstable, with 1 negative eigenvalue of the stiffness" in log


@pytest.mark.slow
def test_struts_that_have_buckled_resist_small_motions_elastically(comm, shared_tmp_path, capsys):
    """Their stiffness of further loading is negative and that of unloading is not; the modes there are stable, too."""
    case = Case.load("octet_buckling")
    assert UNSTABLE not in warnings(case, comm, shared_tmp_path, capsys)

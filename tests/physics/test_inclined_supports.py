"""Supports along directions that are no axes: turned trusses give turned answers."""

import copy

import h5py
import numpy as np
import pytest
from helpers.runs import run
from helpers.small_models import SCHEMES, in_time
from helpers.stopped import assert_restart_is_bitwise
from scipy.spatial.transform import Rotation

from pfem_petsc import Case, Simulation, open_result
from pfem_petsc.preflight import Geometry

TURN = Rotation.from_rotvec([0.4, -0.9, 0.7]).as_matrix()
POINTS = np.array(
    [[0, 0, 0], [1, 0, 0], [1, 1.1, 0], [0, 1.2, 0], [0.1, 0.2, 1], [0.9, 0.1, 1.1], [0.8, 0.9, 1], [0.4, 0.5, 1.9]]
)
BARS = [[0, 1], [1, 2], [2, 3], [3, 0], [0, 2], [0, 4], [1, 5], [2, 6], [3, 4], [3, 6], [0, 5], [1, 6], [4, 5], [5, 6]]
BARS += [[6, 4], [4, 7], [5, 7], [6, 7]]
IMPLICIT = list(SCHEMES)[4:]
MOTION = [[0.0, 0.0, 0.0, 0.0], [0.01, 0.0, 0.0, 0.004], [0.02, 0.0, 0.0, -0.002], [0.03, 0.0, 0.0, 0.0]]


def tower(folder, comm, turned, moves=MOTION, **tables):
    """A small tower on a hinge, a guide along x and two rollers, one of which moves; with everything turned, or not."""
    turn = TURN if turned else np.eye(3)
    if comm.rank == 0:
        with h5py.File(folder / f"tower{turned}.h5", "w") as file:
            file["points"], file["bars"] = POINTS @ turn.T, BARS
            file["bar_groups/leg"] = [5]
    comm.Barrier()
    frame = {"frame": (2.0 * turn.T[:2]).tolist()} if turned else {}
    motion = [[row[0], *(turn @ row[1:])] for row in np.array(moves)]
    roller = {"normal": turn[:, 2].tolist()} if turned else {"fix": "z"}
    supports = [
        {"node_set": "hinge", "fix": "xyz", **frame},
        {"node_set": "guide", "fix": "yz", "name": "guide", **frame},
        {"node_set": "moved", **roller, **({"motion": motion} if len(moves) else {})},
        {"node_set": "roller", "name": "roller", **roller},
    ]
    case = {
        "mesh": {"file": f"tower{turned}.h5"},
        "node_set": {n: {"indices": [k]} for n, k in zip(("hinge", "guide", "moved", "roller", "top"), (0, 1, 2, 3, 7))}
        | {"every": {"all": True}},
        "material": {"m": {"young_modulus": 2e8, "density": 1000.0}},
        "section": {"s": {"area": 1e-3, "material": "m"}},
        "support": supports,
        "load": [{"node_set": "top", "force": (turn @ [300.0, 200.0, -400.0]).tolist()}],
        "output": {"fields_every": 0, "probe": [{"name": "every", "node_set": "every"}]},
        "solver": {"rtol": 1e-13},
    }
    return Case.from_dict(case | copy.deepcopy(tables), folder=folder)


def both(folder, comm, tight=1e-11, keys=(), **tables):
    """Run the tower as it is and turned; check that the answers are turned copies; return both histories."""
    plain = run(tower(folder, comm, False, **tables), folder / "plain", comm)
    turned = run(tower(folder, comm, True, **tables), folder / "turned", comm)
    for name in ("position", "reaction", *keys):
        one, other = plain[f"probe/every/{name}"], turned[f"probe/every/{name}"]
        assert np.abs(one @ TURN.T - other).max() <= tight * max(np.abs(one).max(), 1e-300), name
    for name in ("external_work", "elastic_energy", "kinetic_energy"):
        scale = max(np.abs(plain["external_work"]).max(), 1e-300)
        assert np.abs(plain[name] - turned[name]).max() <= 10 * tight * scale, name
    assert np.abs(plain["probe/every/reaction"]).max() > 10.0
    return plain, turned


@pytest.mark.parametrize("mass", ["lumped", "consistent"])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_turned_tower_in_motion(scheme, mass, comm, shared_tmp_path):
    _, turned = both(shared_tmp_path, comm, **in_time(scheme, mass))
    assert np.abs(turned["energy_imbalance"]).max() <= 1e-10 * np.abs(turned["external_work"]).max()


@pytest.mark.parallel
@pytest.mark.parametrize("operator", ["assembled", "matrix_free"])
def test_both_operators_on_ranks(operator, comm, shared_tmp_path):
    linear = "cg"
    solver = {"solver": {"rtol": 1e-12, "operator": operator, "linear": linear}}
    both(shared_tmp_path, comm, 1e-10, **in_time("newmark", step=5e-4, end=5e-3), **solver)


@pytest.mark.parallel
@pytest.mark.parametrize("integrator", ["central_differences", "hulbert_chung", "houbolt"])
def test_wall_at_other_nodes(integrator, comm, shared_tmp_path):
    wall = {"name": "stop", "node_set": "top"}
    histories = []
    for turned in (False, True):
        turn = TURN if turned else np.eye(3)
        plane = {"type": "plane", "point": (turn @ [0.4, 0.5, 1.8995]).tolist(), "normal": turn[:, 2].tolist()}
        tables = in_time(integrator, end=5e-3) | {"wall": [wall | plane]}
        case = tower(shared_tmp_path, comm, turned, **tables)
        histories.append(run(case, shared_tmp_path / f"{turned}", comm))
    one, other = histories
    assert np.abs(one["wall/stop/force"]).max() > 100.0
    assert np.abs(one["wall/stop/force"] @ TURN.T - other["wall/stop/force"]).max() < 1e-6
    assert np.abs(one["probe/every/position"] @ TURN.T - other["probe/every/position"]).max() < 1e-12


STATIC = {
    "newton": {"step": 0.25},
    "relaxation": {"step": 0.5, "method": "relaxation"},
    "arc_length": {"step": 0.25, "method": "arc_length", "max_points": 4},
    # steps of one length: those that adapt depend on numbers of iterations
    "displacement": {"step": 1e-4, "max_step": 1e-4, "method": "displacement", "max_points": 4, "node_set": "top"},
}


@pytest.mark.parallel
@pytest.mark.parametrize("moves", [[], [[0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.004]]])
@pytest.mark.parametrize("method", STATIC)
def test_turned_tower_in_statics(method, moves, comm, shared_tmp_path):
    table = dict(STATIC[method])
    loose = {"newton": 1e-11, "relaxation": 1e-6}.get(method, 1e-8)
    histories = []
    for turned in (False, True):
        turn = TURN if turned else np.eye(3)
        if method == "displacement":
            table |= {"direction": (turn @ [0.0, 0.0, -1.0]).tolist(), "displacement": 4e-4}
        if method in ("arc_length", "displacement"):
            table |= {"critical_points": True}
        case = tower(shared_tmp_path, comm, turned, moves, static=table, modes={"count": 4})
        histories.append(run(case, shared_tmp_path / f"{turned}", comm))
        if comm.rank == 0:
            histories[-1]["frequency"] = open_result(shared_tmp_path / f"{turned}").modes.frequency
    one, other = histories
    for name in ("position", "reaction"):
        a, b = one[f"probe/every/{name}"] @ TURN.T, other[f"probe/every/{name}"]
        assert np.abs(a - b).max() <= loose * np.abs(a).max(), name
    assert np.allclose(one["external_work"], other["external_work"], rtol=loose, atol=loose)
    if comm.rank == 0:
        assert np.allclose(one["frequency"], other["frequency"], rtol=100 * loose)
    net = other["probe/every/reaction"][-1].sum(axis=0) + other["load_factor"][-1] * TURN @ [300.0, 200.0, -400.0]
    assert np.abs(net).max() < 100 * loose * 500.0


@pytest.mark.parametrize("integrator", ["central_differences", "generalized_alpha", "energy_momentum"])
@pytest.mark.parametrize("first, duration", [(1e-3, 0.0), (1e-3, 5e-4), (0.0, 0.0)])
def test_removed_supports(integrator, first, duration, comm, shared_tmp_path):
    removals = [{"supports": name, "time": t, "duration": duration} for name, t in (("guide", first), ("roller", 2e-3))]
    both(shared_tmp_path, comm, **in_time(integrator), remove=removals)


@pytest.mark.parametrize("analysis", ["central_differences", "newmark", "houbolt", "static"])
def test_stages(analysis, comm, shared_tmp_path):
    first = {"name": "one", "static": {"step": 0.5}}
    second = {"name": "two", **in_time("newmark" if analysis == "static" else analysis)}
    stages = [second, first] if analysis == "static" else [first, second]
    plain, turned = both(shared_tmp_path, comm, 1e-10, stage=stages)


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["central_differences", "energy_momentum"])
def test_restart_in_a_stage_without_a_removed_support(integrator, comm, tmp_path):
    """A support that an earlier stage has removed stays away, in the turned tower as in the other; and in a restart."""
    time = in_time(integrator, end=2e-3)
    removal = [{"supports": "guide", "time": 1e-3, "duration": 5e-4}]
    stages = [{"name": "one", **time, "remove": removal}, {"name": "two", **time}]
    both(tmp_path, comm, stage=stages)
    assert_restart_is_bitwise(tower(tmp_path, comm, True, stage=stages), comm, tmp_path, 30)


@pytest.mark.parallel
def test_reports_before_a_run(comm, shared_tmp_path):
    """Mechanisms, rigid motions and free directions are those of the tower that is not turned."""
    found = []
    for turned in (False, True):
        case = tower(shared_tmp_path, comm, turned, **in_time("newmark"), modes={"count": 3})
        simulation = Simulation(case, comm, check_only=True)
        entries, warnings = simulation.inspect()
        loose = Geometry(simulation.model).unbraced()
        found.append((entries["rigidity"], simulation.summary()["modes"], loose, warnings, simulation.plan.frequency))
    assert found[0][:4] == found[1][:4]
    np.testing.assert_allclose(found[0][4], found[1][4], rtol=1e-3)
    assert "17 free directions, 0 rigid motions" in found[0][0]

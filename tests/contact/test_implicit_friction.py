"""Friction in implicit steps: closed forms."""

import numpy as np
import pytest
from helpers.lattices import SCHEMES, G, lattice_case, planes, rod, rows_of, tumbling
from helpers.runs import run

from pfem_petsc import Case


@pytest.mark.slow
@pytest.mark.parametrize("integrator, parameters", SCHEMES + [("central_differences", {}), ("chung_lee", {})])
def test_incline(integrator, parameters, comm, shared_tmp_path):
    """Above the angle of friction a rod slides with g (sin - mu cos) from the first step on, below it stays."""
    angle = 0.4
    for friction in (0.0, 0.2, 0.4):
        rows, run = rows_of(rod(integrator, parameters, friction, angle=angle), comm, shared_tmp_path, f"{friction}")
        a = G * (np.sin(angle) - friction * np.cos(angle))
        last = rows[-1]
        for row in rows[1:]:
            assert row["momentum"][1] / run.model.total_mass == pytest.approx(a * row["time"], abs=1e-10)
        assert last["centre_of_mass"][1] == pytest.approx(0.5 * a * last["time"] ** 2, abs=1e-11)
        force = last["wall/floor/force"] / (run.model.total_mass * G * np.cos(angle))
        np.testing.assert_allclose(force, [0.0, -friction, 1.0], atol=1e-9)
        assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-11
    rows, run = rows_of(rod(integrator, parameters, 0.5, angle=angle), comm, shared_tmp_path, "stays")
    moved = run.state.position - run.mesh.points[: run.mesh.n_owned]
    assert np.abs(moved).max(initial=0.0) < 1e-13
    assert rows[-1]["wall/floor/force"][1] == pytest.approx(-run.model.total_mass * G * np.sin(angle), rel=1e-9)
    assert abs(rows[-1]["contact_work"]) < 1e-14


@pytest.mark.slow
@pytest.mark.parametrize("integrator, parameters", SCHEMES)
def test_sliding_to_a_stop(integrator, parameters, comm, shared_tmp_path):
    """A rod thrown along the floor stops after v^2/(2 mu g), and all its energy went into friction."""
    friction, speed = 0.3, 0.2
    far = speed**2 / (2.0 * friction * G)
    errors = []
    for step in (1e-3, 5e-4):
        case = rod(integrator, parameters, friction, velocity=(0.0, speed, 0.0), step=step)
        rows, run = rows_of(case, comm, shared_tmp_path, f"{step}")
        last = rows[-1]
        errors.append(abs(last["centre_of_mass"][1] - far))
        # with wilson and energy_momentum the velocity of a node that is held goes to and fro
        left = 0.0 if integrator not in ("wilson", "energy_momentum") else friction * G * step
        assert np.abs(last["momentum"]).max() <= left * run.model.total_mass + 1e-12
        assert last["friction_dissipation"] == pytest.approx(0.5 * run.model.total_mass * speed**2, rel=0.06)
        assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-12
    assert max(errors) < 0.01 * far


TRAPEZOID = {"beta": 0.25, "gamma": 0.5}


@pytest.mark.slow
@pytest.mark.parametrize(
    "integrator, parameters", [("energy_momentum", {}), ("newmark", TRAPEZOID), ("generalized_alpha", {})]
)
def test_stick_ends_the_motion(integrator, parameters, comm, shared_tmp_path):
    """With the treatment stick, what has stopped is at rest, and friction has taken all energy."""
    friction, speed = 0.3, 0.2
    case = rod(integrator, parameters, friction, velocity=(0.0, speed, 0.0), step=1e-3, contact={"treatment": "stick"})
    rows, run = rows_of(case, comm, shared_tmp_path)
    last, mass = rows[-1], run.model.total_mass
    assert last["kinetic_energy"] < 1e-20 and last["elastic_energy"] < 1e-16
    if integrator != "generalized_alpha":
        assert last["friction_dissipation"] == pytest.approx(0.5 * mass * speed**2, rel=1e-4)
    assert last["centre_of_mass"][1] == pytest.approx(speed**2 / (2.0 * friction * G), rel=0.002)
    assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-12
    # thrown at the floor askew, a lattice never gains energy
    floor = planes([[0.1, -0.1, 1.0]], [-0.02], friction=0.5, static_friction=0.6)
    case = tumbling(floor, integrator, parameters, end=0.03, contact={"treatment": "stick"})
    del case["gravity"]
    rows, _ = rows_of(case, comm, shared_tmp_path, "lattice")
    energy = np.array([row["kinetic_energy"] + row["elastic_energy"] for row in rows])
    assert (np.diff(energy) < 1e-3 * energy[0]).all() and energy[-1] < energy[0]
    assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-9 * energy[0]


@pytest.mark.slow
@pytest.mark.parametrize("integrator, parameters", [*SCHEMES[:5], ("central_differences", {})])
def test_breaking_loose(integrator, parameters, comm, shared_tmp_path):
    """Pulled ever harder, a rod at rest starts when the pull is mu_static times its weight, and mu drags it then."""
    static, dynamic, full = 0.6, 0.3, 0.1
    case = rod(integrator, parameters, dynamic, static_friction=static, end=full, step=5e-4)
    case["mesh"]["elements"], case["node_set"] = 1, {"both": {"all": True}}
    weight = 0.2e-2 * G / 2.0  # of each node
    pull = [0.0, 2.0 * static * weight, 0.0]
    case["load"] = [{"node_set": "both", "force": pull, "table": [[0.0, 0.0], [full, 1.0]]}]
    rows, _ = rows_of(case, comm, shared_tmp_path)
    start = max(row["time"] for row in rows if row["momentum"][1] < 1e-12)
    assert start == pytest.approx(0.5 * full, abs=2.1 * 5e-4)
    for row in rows:
        away = row["time"] - start
        gained = 2.0 * weight * ((static - dynamic) * away + static * away**2 / full) if away > 0.0 else 0.0
        assert row["momentum"][1] == pytest.approx(gained, abs=2.0 * weight * static * 3 * 5e-4)


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["newmark", "houbolt", "energy_momentum"])
def test_oblique_impact(integrator, comm, shared_tmp_path):
    """Thrown flat at the floor: the tangential impulse is mu times the normal one, or what stops the rod."""
    for friction, speed in ((0.3, 2.0), (0.8, 0.5)):
        case = rod(integrator, {}, friction, velocity=(0.0, speed, -1.0), height=0.01, end=0.03)
        del case["gravity"]
        rows, run = rows_of(case, comm, shared_tmp_path, f"{friction}")
        impulse, mass = rows[-1]["wall/floor/impulse"], run.model.total_mass
        # the whole force of houbolt's method acts over some steps, in which the rod may leave the wall again
        assert impulse[2] > 0.9 * mass
        if friction == 0.3:
            assert impulse[1] == pytest.approx(-friction * impulse[2], rel=1e-8)
        else:
            assert abs(impulse[1]) < friction * impulse[2]
        assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-11


@pytest.mark.parametrize("friction", [0.2, 0.0])
def test_wall_out_of_reach_changes_nothing(friction, comm, shared_tmp_path):
    """A plane 100 m above, oblique to the floor, is in no nodal frame: the steps are bitwise the same."""
    floor = {"type": "plane", "name": "floor", "point": [0, 0, 0], "normal": [0, 0, 1.0], "friction": friction}
    far = {"type": "plane", "name": "far", "point": [0, 0, 100.0], "normal": [0.1, 0, -1.0]}
    x = []
    for name, walls in (("one", [floor]), ("two", [floor, far])):
        case = lattice_case(
            walls, cells=(1, 1, 1), integrator="newmark", step=1e-3, end=8e-3, gravity=(3.0, 1.0, -9.81)
        )
        case["initial"]["velocity"] = [0.1, 0.0, -0.2]
        rows, run = rows_of(case, comm, shared_tmp_path, name)
        assert rows[-1]["wall/floor/contacts"] > 0
        x.append(run.state.position.copy())
    np.testing.assert_array_equal(*x)


def test_valley_of_almost_parallel_planes(comm, shared_tmp_path):
    """Nodes that come to rest where two planes one degree apart meet are on both of them."""
    tilt = np.radians(0.5)
    valley = planes([[s * np.sin(tilt), 0.0, np.cos(tilt)] for s in (1.0, -1.0)], [0.0, 0.0])
    for name, wall in zip(("left", "right"), valley, strict=True):
        wall["name"] = name
    case = lattice_case(valley, cells=(1, 1, 1), integrator="newmark", step=2e-3, end=0.04, gravity=(0.0, 0.0, -9.81))
    lowest = "bottom"
    case["node_set"] = {lowest: {"box": [[-1e-3, -1, -1e-3], [1e-3, 1, 1e-3]]}}
    for wall in valley:
        wall["node_set"] = lowest
    case["support"] = [{"node_set": "rest", "fix": "y"}]
    case["node_set"]["rest"] = {"box": [[-1, -1e-3, -1], [1, 1e-3, 1]]}
    rows, run = rows_of(case, comm, shared_tmp_path)
    gaps = run.model.contact.gaps(run.state.position, run.state.time)
    assert gaps.min() >= -1e-13
    assert min(row["wall/left/contacts"] + row["wall/right/contacts"] for row in rows) >= 1


@pytest.mark.parametrize("steps", [120])
def test_node_between_a_floor_and_a_sphere(steps, comm, shared_tmp_path):
    """Pushed up and down below the pole of a sphere, whose plane is 1e-9 to 1e-7 off that of the floor."""
    step = 1e-3
    floor = {"type": "plane", "name": "floor", "point": [0, 0, 0], "normal": [0, 0, 1.0]}
    ball = {"type": "sphere", "name": "ball", "point": [1e-8, 0, 0.3 + 2e-4], "radius": 0.3, "node_set": "below"}
    factors = [[20.0 * k * step, float((-1) ** k)] for k in range(2 + steps // 20)]
    case = lattice_case([floor, ball], integrator="newmark", step=step, end=steps * step, gravity=(0.0, 0.0, -1.0))
    case["mesh"] = {"generator": "rod", "length": 0.1, "elements": 1}
    case["node_set"] = {"below": {"indices": [0]}, "all": {"all": True}}
    case["load"] = [{"node_set": "all", "force": [0.0, 0.0, 5e-3], "table": factors}]
    case["initial"]["velocity"] = [-1e-7, 0.0, -1e-2]
    rows, run = rows_of(case, comm, shared_tmp_path)
    for name in ("floor", "ball"):
        touching = np.array([row[f"wall/{name}/contacts"] > 0 for row in rows])
        assert 5 < touching.sum() < steps and np.diff(touching).sum() >= 2
    assert run.state.position[:, 2].min(initial=1.0) >= -1e-15
    assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-12


@pytest.mark.parametrize(("theta", "friction"), [(1.4, 0.6), (1.6, 1.3)])
def test_friction_of_nodes_that_stick_beyond_the_step_only_takes(theta, friction, comm, shared_tmp_path):
    """``wilson`` finds a node to stick at t + theta h; it slips at the end of the step, and a jump takes nothing back
    that was not booked."""
    case = Case.from_dict(
        {
            "mesh": {"generator": "rod", "length": 1.5, "elements": 5},
            "node_set": {"end": {"group": "end"}},
            "material": {"m": {"young_modulus": 1.2e6, "density": 1e4}},
            "section": {"s": {"area": 3e-3, "material": "m"}},
            "initial": {"velocity": [0.03, 0.0, 0.0], "angular_velocity": [0.007, 0.005, -0.0045]},
            "wall": [
                {
                    "name": "rough",
                    "adjust": True,
                    "node_set": "end",
                    "type": "plane",
                    "point": [1.494, 0.0, 0.0],
                    "normal": [-0.5, 0.054, -0.038],
                    "friction": friction,
                }
            ],
            "contact": {"treatment": "stick"},
            "time": {"integrator": "wilson", "theta": theta, "step": 0.02, "end": 0.4},
            "solver": {"rtol": 1e-12},
            "output": {"fields_every": 0},
        }
    )
    history = run(case, shared_tmp_path / "out", comm)
    assert (history["wall/rough/contacts"] > 0).sum() > 5
    taken = np.diff(history["friction_dissipation"])
    assert taken.min() >= -1e-12 * history["kinetic_energy"][0]
    assert np.abs(history["energy_imbalance"]).max() < 1e-9 * history["kinetic_energy"][0]

"""Walls that turn: closed forms of nodes on paddles, discs and rollers, and what walls work."""

import numpy as np
import pytest
from helpers.lattices import rows_of
from helpers.stopped import assert_as_on_one_rank, assert_restart_is_bitwise

from pfem_petsc import Case
from pfem_petsc.errors import InputError

SPIN, G = 3.0, 10.0
AXIS = {"centre": [0.0, 0.0, 0.0], "axis": [0.0, 0.0, 2.0]}
PADDLE = {"type": "plane", "point": [0.0, 0.0, 0.0], "normal": [0.0, 1.0, 0.0]}
DISC = {"type": "plane", "point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}
UPRIGHT, FLAT = [[1.0, 0.0, -0.5], [1.0, 0.0, 0.5]], [[1.0, 0.0, 0.0], [1.0, 0.1, 0.0]]


def bar(points, wall, velocity, integrator="central_differences", end=0.5, **tables):
    """A soft bar beside a wall that turns about the z axis."""
    return {
        "mesh": {"generator": "arrays", "points": points, "bars": [[0, 1]]},
        "material": {"m": {"young_modulus": 1e3, "density": 1e3}},
        "section": {"s": {"area": 1e-4, "material": "m"}},
        "initial": {"velocity": velocity},
        "wall": [{"name": "w", "rotation": {**AXIS, "angular_velocity": SPIN}, **wall}],
        "time": {"integrator": integrator, "step": 1e-3, "end": end},
        "solver": {"rtol": 1e-12},
        "output": {"fields_every": 0},
        **tables,
    }


@pytest.mark.parametrize(
    ("integrator", "tolerance"), [("central_differences", 3e-6), ("generalized_alpha", 3e-6), ("bathe", 4e-6)]
)
def test_node_on_a_paddle(integrator, tolerance, comm, shared_tmp_path):
    """A node on a smooth paddle is at r = r0 cosh(w t); the paddle works what the node gains beside the impact."""
    rows, run = rows_of(bar(UPRIGHT, PADDLE, [0.0, SPIN, 0.0], integrator), comm, shared_tmp_path)
    x = run.state.position
    np.testing.assert_allclose(np.hypot(x[:, 0], x[:, 1]), np.cosh(0.5 * SPIN), rtol=tolerance)
    np.testing.assert_allclose(np.arctan2(x[:, 1], x[:, 0]), 0.5 * SPIN, atol=1e-12)
    assert abs(rows[-1]["energy_imbalance"]) < 1e-11
    if integrator == "central_differences":
        energy = 0.05 * SPIN**2 * np.cosh(SPIN) - 0.05 * SPIN**2
        assert rows[-1]["contact_work"] == pytest.approx(energy, rel=1e-5)


@pytest.mark.parametrize("restitution", [0.0, 0.6, 1.0])
def test_node_hit_by_a_paddle(restitution, comm, shared_tmp_path):
    """A node at rest leaves a paddle with (1 + e) w r along its normal; the impact takes m (w r)^2 (1 - e^2)/2."""
    wall = {**PADDLE, "restitution": restitution, "rotation": {**AXIS, "angles": [[0.0, -0.03], [1.0, SPIN - 0.03]]}}
    wall["rotation"]["interpolation"] = "linear"
    case = bar(UPRIGHT, wall, [0.0, 0.0, 0.0], end=0.0142)
    case["time"]["step"] = 1e-4
    rows, run = rows_of(case, comm, shared_tmp_path)
    speed = np.linalg.norm(run.state.v, axis=1)
    np.testing.assert_allclose(speed, SPIN * (1.0 + restitution), rtol=3e-4)
    lost = 0.5 * 0.1 * SPIN**2 * (1.0 - restitution**2)
    assert rows[-1]["impact_dissipation"] == pytest.approx(lost, abs=3e-4)


@pytest.mark.parametrize("integrator", ["central_differences", "chung_lee", "newmark"])
def test_node_that_sticks_to_a_disc(integrator, comm, shared_tmp_path):
    """It goes round with the disc if mu g > w^2 r."""
    wall = {**DISC, "friction": 1.02 * SPIN**2 / G}
    case = bar(FLAT, wall, [0.0, 0.0, 0.0], integrator, gravity={"acceleration": [0.0, 0.0, -G]})
    case["initial"] = {"angular_velocity": [0.0, 0.0, SPIN], "centre": [0.0, 0.0, 0.0]}
    _, run = rows_of(case, comm, shared_tmp_path)
    x, start = run.state.position, run.mesh.points[: run.mesh.n_owned]
    angle = np.arctan2(x[:, 1], x[:, 0]) - np.arctan2(start[:, 1], start[:, 0])
    np.testing.assert_allclose(angle, 0.5 * SPIN, atol=1e-6)
    np.testing.assert_allclose(np.hypot(x[:, 0], x[:, 1]), np.hypot(start[:, 0], start[:, 1]), rtol=1e-6)


@pytest.mark.parametrize("integrator", ["central_differences", "newmark"])
def test_node_dragged_by_a_disc(integrator, comm, shared_tmp_path):
    """A node at rest is pulled along by mu m g; what the disc works goes to the node and to friction."""
    case = bar(FLAT, {**DISC, "friction": 0.3}, [0.0] * 3, integrator, 0.05, gravity={"acceleration": [0.0, 0.0, -G]})
    rows, run = rows_of(case, comm, shared_tmp_path)
    np.testing.assert_allclose(np.linalg.norm(run.state.v, axis=1), 0.3 * G * 0.05, rtol=2e-3)
    last = rows[-1]
    gained = last["kinetic_energy"] + last["elastic_energy"] + last["friction_dissipation"]
    assert last["contact_work"] == pytest.approx(gained, rel=1e-5)
    assert last["friction_dissipation"] > 0.5 * last["contact_work"]


def test_bar_on_a_roller(comm, shared_tmp_path):
    """A roller below a bar along its axis pushes with mu m g along the way of its surface, w x r."""
    wall = {"type": "cylinder", "point": [0.0, 0.0, 0.0], "axis": [0.0, 0.0, 1.0], "radius": 0.5, "friction": 0.2}
    points = [[0.0, 0.5, -0.5], [0.0, 0.5, 0.5]]
    case = bar(points, wall, [0.0] * 3, end=0.02, gravity={"acceleration": [0.0, -G, 0.0]})
    _, run = rows_of(case, comm, shared_tmp_path)
    np.testing.assert_allclose(run.state.v[:, 0], -0.2 * G * 0.02, rtol=0.03)


def test_table_of_angles_and_displacement_at_once(comm, shared_tmp_path):
    """Nodes tied to a wall go round a centre that moves, as does the recorded position of the wall."""
    wall = {**DISC, "tied": True, "velocity": [0.5, 0.0, 0.0]}
    wall["rotation"] = {**AXIS, "centre": [0.5, 0.0, 0.0], "angles": [[0.0, 0.0], [0.05, 0.0], [0.45, 0.7]]}
    rows, run = rows_of(bar(FLAT, wall, [0.0, 0.0, -0.01]), comm, shared_tmp_path)
    c, s = np.cos(0.7), np.sin(0.7)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    start = run.mesh.points[: run.mesh.n_owned] - [0.5, 0.0, 0.0]
    np.testing.assert_allclose(run.state.position, start @ turn.T + [0.75, 0.0, 0.0], atol=6e-3)
    expected = turn @ [-0.5, 0.0, 0.0] + [0.75, 0.0, 0.0]
    np.testing.assert_allclose(rows[-1]["wall/w/position"], expected, atol=1e-12)


@pytest.mark.parallel
@pytest.mark.parametrize("integrator", ["central_differences", "newmark"])
def test_turning_walls_on_any_rank_count(integrator, comm, shared_tmp_path):
    case = Case.from_dict(bar(UPRIGHT, {**PADDLE, "friction": 0.1}, [0.0, SPIN, 0.0], integrator, 0.02))
    history = assert_restart_is_bitwise(case, comm, shared_tmp_path, 7, allowed=1e-9 * (integrator == "newmark"))
    names = "momentum", "kinetic_energy", "contact_work", "friction_dissipation", "wall/w/impulse"
    assert_as_on_one_rank(history, case, comm, shared_tmp_path, *names)


@pytest.mark.parametrize(
    ("rotation", "message"),
    [
        ({"axis": [0.0, 0.0, 1.0], "angular_velocity": 1.0}, "centre"),
        ({**AXIS}, "angular_velocity, angles"),
        ({**AXIS, "axis": [0.0, 0.0, 0.0], "angular_velocity": 1.0}, "zero length"),
        ({**AXIS, "angles": [[0.0, 0.0], [0.0, 1.0]]}, "times must increase"),
    ],
)
def test_bad_rotations(rotation, message):
    with pytest.raises(InputError, match=message):
        Case.from_dict(bar(UPRIGHT, {**PADDLE, "rotation": rotation}, [0.0, 0.0, 0.0]))

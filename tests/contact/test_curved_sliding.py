"""Sliding on curved walls: the order of the energy, friction against an integral, moving walls, and places far away."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI

from pfem_petsc import Case, Simulation
from pfem_petsc.contact.explicit import Arrivals, PressedWalls, WallSums, kind_of, press_nodes
from pfem_petsc.contact.node_walls import TURN
from pfem_petsc.contact.surfaces import Surfaces
from pfem_petsc.errors import SimulationFailure

GRAVITY, ANGLE = 9.81, np.pi / 3.0
SCHEMES = [
    ("central_differences", {}),
    ("central_differences", {"mass": "consistent"}),
    ("chung_lee", {}),
    ("hulbert_chung", {}),
    ("newmark", {"beta": 0.25, "gamma": 0.5}),
    ("houbolt", {}),
    ("wilson", {"theta": 2.0}),
    ("generalized_alpha", {}),
    ("energy_momentum", {}),
]
TUBE = {"name": "tube", "type": "cylinder", "point": [0, 0, 0], "axis": [0, 1, 0], "radius": 1.0, "side": "inside"}


def slide(folder, integrator, step, end, wall=None, at=(0.0, 0.0, 0.0), keys=None, **tables):
    """Final positions, velocities and last row of a bar across a tube of radius 1 m, released at 60 degrees in it."""
    place = np.array(at) + [np.sin(ANGLE), 0.0, -np.cos(ANGLE)]
    wall = {**(wall if "type" in (wall or {}) else {**TUBE, **(wall or {})})}
    case = {
        "mesh": {"generator": "arrays", "points": [place.tolist(), (place + [0, 1, 0]).tolist()], "bars": [[0, 1]]},
        "material": {"m": {"young_modulus": 1e6, "density": 1000.0}},
        "section": {"s": {"area": 1e-3, "material": "m"}},
        "gravity": {"acceleration": [0.0, 0.0, -GRAVITY]},
        "wall": [{**wall, "point": (np.array(at) + wall["point"]).tolist()}],
        "time": {"integrator": integrator, "step": step, "end": end, **(keys or {})},
        "solver": {"rtol": 1e-12},
        "output": {"fields_every": 0, "history_every": 10},
        **tables,
    }
    with Simulation(Case.from_dict(case), MPI.COMM_SELF, output=folder, quiet=True) as run:
        gaps = [run.model.contact.gaps(run.state.position, run.state.time).min() for _ in run]
        return run.state.position - np.array(at), run.state.v, min(gaps), run.row


def energy_error(x, v):
    """Energy lost, relative to that of the whole fall."""
    height = x[:, 2].mean() + np.cos(ANGLE)
    return -((0.5 * (v * v).sum(axis=1).mean() + GRAVITY * height) / (GRAVITY * (1.0 - np.cos(ANGLE))))


@pytest.mark.slow
@pytest.mark.parametrize("integrator, keys", SCHEMES)
def test_sliding_keeps_its_energy_to_second_order(integrator, keys, tmp_path):
    """Through the lowest point, up and half-way back; the nodes are in the tube after every step."""
    errors = []
    for step in (8e-3, 4e-3):
        x, v, gap, _ = slide(tmp_path, integrator, step, 1.44, keys=keys)
        assert gap > -1e-12 or integrator == "wilson"  # which bounds the position at t0 + theta h
        errors.append(abs(energy_error(x, v)))
    assert errors[1] < 1e-3
    assert errors[1] < 0.35 * errors[0] + 1e-10


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["central_differences", "generalized_alpha", "energy_momentum"])
def test_tube_in_steady_motion(integrator, tmp_path):
    """In a tube that moves on with the bar's own velocity, the slide is that in a tube at rest."""
    rate = np.array([0.7, 0.0, -0.4])
    x, v, *_ = slide(tmp_path, integrator, 4e-3, 0.6)
    moved, faster, *_ = slide(
        tmp_path, integrator, 4e-3, 0.6, {"velocity": rate.tolist()}, initial={"velocity": rate.tolist()}
    )
    np.testing.assert_allclose(moved - 0.6 * rate, x, atol=2e-10)
    np.testing.assert_allclose(faster - rate, v, atol=2e-9)


def rubbing(friction, end):
    """Angle from the lowest point and its rate of a mass that slides with friction from 60 degrees, by Runge-Kutta."""

    def slope(y):
        press = y[1] ** 2 + GRAVITY * np.cos(y[0])
        return np.array([y[1], -GRAVITY * np.sin(y[0]) - friction * press * np.sign(y[1])])

    y, h = np.array([ANGLE, -1e-12]), end / 2000
    for _ in range(2000):
        k1 = slope(y)
        k2 = slope(y + 0.5 * h * k1)
        k3 = slope(y + 0.5 * h * k2)
        y = y + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + slope(y + h * k3))
    return y


@pytest.mark.slow
@pytest.mark.parametrize(
    "integrator, keys",
    [("central_differences", {}), ("chung_lee", {}), ("generalized_alpha", {}), ("energy_momentum", {})],
)
def test_sliding_with_friction(integrator, keys, tmp_path):
    """Against the equation of motion, on the way down; friction is what lacks in the energy."""
    friction, end = 0.2, 0.6
    angle, rate = rubbing(friction, end)
    errors = []
    for step in (8e-3, 4e-3):
        x, v, gap, row = slide(tmp_path, integrator, step, end, {"friction": friction}, keys=keys)
        assert gap > -1e-12
        errors.append([abs(np.arctan2(x[0, 0], -x[0, 2]) - angle), abs(np.linalg.norm(v[0]) + rate)])
        lost = energy_error(x, v) * GRAVITY * (1.0 - np.cos(ANGLE))
        assert row["friction_dissipation"] == pytest.approx(lost, rel=4.0 * step)
    assert max(errors[1]) < 3e-4
    assert (np.array(errors[1]) < 0.3 * np.array(errors[0])).all()


START = [np.sin(ANGLE), 0.5, -np.cos(ANGLE)]
STEEP = {"name": "w", "point": START, "normal": [-np.sin(ANGLE), 0.0, np.cos(ANGLE)]}
ROUND = {"name": "w", "type": "sphere", "point": [0.0, 0.5, 0.0]}
PLACES = [
    TUBE,
    {**TUBE, "friction": 0.2, "static_friction": 0.3},
    {**TUBE, "axis": [0.1, 1.0, 0.05], "side": "outside", "point": [0.3, 0.5, -1.6]},
    {**ROUND, "side": "inside", "radius": np.sqrt(1.25)},
    {**ROUND, "side": "outside", "point": [0.3, 0.5, -2.4], "radius": 2.04},
    {**STEEP, "type": "plane"},
    {**STEEP, "type": "rectangle", "along": [1.0, 0.0, 0.0], "size": [8.0, 8.0]},
]


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["central_differences", "newmark"])
@pytest.mark.parametrize("wall", PLACES)
def test_slides_far_from_the_origin(wall, integrator, tmp_path):
    """As at the origin, to some thousand roundings of the coordinates, about 1 and 1000 km away."""
    here, speed, *_ = slide(tmp_path, integrator, 2e-3, 0.3, wall)
    for away in (2.0**10, 2.0**20):
        there, faster, gap, _ = slide(tmp_path, integrator, 2e-3, 0.3, wall, at=(away, -away, away))
        rounding = 2.2e-16 * away
        np.testing.assert_allclose(there, here, atol=1e4 * rounding)
        np.testing.assert_allclose(faster, speed, atol=1e5 * rounding)
        assert gap > -1e2 * rounding


@pytest.mark.slow
@pytest.mark.parametrize("friction", [0.1, 0.6, 2.0])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_friction_on_a_sphere_in_large_steps(side, friction):
    """Nodes that go any way in a step are on the sphere, and the forces on them follow the law of friction."""
    rng, m = np.random.default_rng(7), 1000
    radial = rng.normal(size=(m, 3))
    start = radial / np.linalg.norm(radial, axis=1)[:, None] * (1.0 + side * rng.uniform(0.0, 0.05, (m, 1)))
    free = start + rng.normal(size=(m, 3)) * 10.0 ** rng.uniform(-3.0, 0.3, (m, 1))
    lengths = np.linalg.norm(free, axis=1)
    turned = np.einsum("mi,mi->m", start, free) / (np.linalg.norm(start, axis=1) * lengths) <= TURN
    # what turns less is pushed along the first normal, which need not lead back to the sphere from afar
    some = (side * (lengths - 1.0) < 0.0) & (lengths > 1e-2) & (turned | (lengths < 1.3))
    start, free, turned = start[some], free[some], turned[some]
    m, stiffness = len(free), 3.0
    zero = np.zeros((1, 3))
    walls = PressedWalls(
        *(Surfaces(zero, np.zeros(1), zero, zero, np.array([side])), 0.0, np.ones(1, dtype=bool)),
        *(np.ones((m, 1), dtype=bool), 1e-13, np.empty(m, dtype=np.int64), np.zeros(1, dtype=np.int64), zero, zero),
        *(np.full((2, 1), friction), np.empty(0), np.empty((0, 1)), np.empty((0, 1))),
    )
    no = np.zeros((m, 1), dtype=bool)
    given = Arrivals(
        *(free, start, np.zeros((m, 1, 3)), np.zeros((m, 3)), np.full(m, stiffness)),
        *(np.zeros((m, 3), dtype=bool), ~no, no),
        *(np.empty((m, 0)), np.empty((m, 0)), np.empty((0, 1, 3)), np.empty((0, 1))),
    )
    sums = WallSums(np.zeros((1, 3)), np.zeros(1, dtype=np.int64), np.zeros((1, 3)))
    kind = kind_of(walls.surfaces.radii, walls.friction)
    failed, _, (x, *_), force, _, dissipated = press_nodes(given, walls, sums, *kind)
    assert m > 60 and turned.sum() > 20 and failed < 0
    np.testing.assert_allclose(np.linalg.norm(x, axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(force, stiffness * (x - free), atol=1e-12)
    normal = side * np.where(turned[:, None], x, start)
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    push = np.einsum("mi,mi->m", force, normal)
    drag, slip = force - push[:, None] * normal, x - start
    slip -= np.einsum("mi,mi->m", slip, normal)[:, None] * normal
    size = np.linalg.norm(slip, axis=1)
    slides = size > 1e-10
    assert push.min() > 0.0 and slides.sum() > 10
    expected = -friction * (push / np.maximum(size, 1e-300))[:, None] * slip
    np.testing.assert_allclose(drag[slides], expected[slides], atol=1e-9)
    assert (np.linalg.norm(drag, axis=1) <= friction * push * (1.0 + 1e-9)).all()
    assert dissipated == pytest.approx((friction * push * size).sum(), rel=1e-9)


@pytest.mark.slow
def test_friction_that_is_not_found_is_told(tmp_path):
    """A node that a step throws far into the edge of a rough bowl and a rough floor: which node, step and time."""
    start = np.array([0.5038536020178621, -0.7592935699532672, -0.29994349529666003])
    free = np.array([1.1895945211209882, -1.4418835246329729, -0.3976981328859728])
    walls = [
        {"name": "bowl", "type": "sphere", "point": [0.0, 0.0, 0.0], "radius": 1.0, "side": "inside"},
        {"name": "floor", "type": "plane", "point": [0.0, 0.0, -0.3], "normal": [0.0, 0.0, 1.0]},
    ]
    case = {
        "mesh": {"generator": "arrays", "points": [start.tolist(), [-0.5, 0.2, 0.1]], "bars": [[0, 1]]},
        "node_set": {"first": {"indices": [0]}},
        "material": {"m": {"young_modulus": 1e-3, "density": 1000.0}},
        "section": {"s": {"area": 1e-3, "material": "m"}},
        "initial": {"velocity": ((free - start) / 1e-2).tolist()},
        "wall": [wall | {"node_set": "first", "friction": 1.5} for wall in walls],
        "time": {"integrator": "central_differences", "step": 1e-2, "end": 0.05},
        "output": {"fields_every": 0},
    }
    told = r"step 1, t = 0.01 s: the friction of node 0 on its walls did not converge; reduce time.step"
    with pytest.raises(SimulationFailure, match=told), Simulation(Case(case), output=tmp_path, quiet=True) as run:
        run.run()

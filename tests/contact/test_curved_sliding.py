"""Sliding on curved walls: the order of the energy, friction against an integral, moving walls, and places far away."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI

from pfem_petsc import Case, Simulation

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

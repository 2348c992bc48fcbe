"""Velocity and acceleration of a node that is stopped and held: the recursion that makes contact smooth or chatter."""

import numpy as np
import pytest
from mpi4py import MPI
from oscillator import roots, wilson

from pfem_petsc import Case
from pfem_petsc.stepping.model import Model
from pfem_petsc.stepping.prepare import make_plan, make_stepper

SPEED, STEP, MOVING = 0.1, 0.01, 8  # the node moves for so many steps, then it is held


def held(integrator, parameters, steps):
    """Velocity over SPEED and acceleration times STEP over SPEED after the stop, step by step."""
    stop = MOVING * STEP
    rows = [[0.0, 0.0, 0.0, 0.0], [stop, SPEED * stop, 0.0, 0.0], [10.0, SPEED * stop, 0.0, 0.0]]
    case = Case.from_dict(
        {
            "mesh": {"generator": "rod", "length": 1.0, "elements": 1},
            "node_set": {"held": {"nearest": [1.0, 0.0, 0.0]}, "all": {"all": True}},
            "material": {"soft": {"young_modulus": 1e-9, "density": 1.0}},
            "section": {"it": {"area": 1.0, "material": "soft"}},
            "initial": {"velocity": [SPEED, 0.0, 0.0]},
            "support": [{"node_set": "held", "fix": "x", "motion": rows}],
            "time": {"integrator": integrator, "step": STEP, "end": 1.0, **parameters},
        }
    )
    model = Model(case, MPI.COMM_SELF)
    it = make_stepper(model, make_plan(model))
    it.start()
    node = int(np.flatnonzero(model.mesh.node_ids == 1)[0])
    found = []
    for _ in range(MOVING + steps):
        it.step()
        found.append((it.state.v[node, 0] / SPEED, it.state.a[node, 0] * STEP / SPEED))
    return np.array(found[MOVING:]).T


@pytest.mark.parametrize(
    ("integrator", "parameters", "expected"),
    [
        ("newmark", {}, [-0.5, 0.0, 0.0, 0.0]),
        ("chung_lee", {"beta": 1.0}, [-0.5, 0.0, 0.0, 0.0]),
        ("chung_lee", {}, [-0.45, -0.07, 0.01, 0.003]),
        ("hulbert_chung", {"rho_b": 0.0}, [0.0, -0.20, -0.16, -0.09, -0.04, -0.01, -0.003]),
        ("hulbert_chung", {"rho_b": 0.3}, [-0.27, -0.19, -0.05, -0.003]),
        ("souza_moura", {}, [-0.27, -0.19, -0.05, -0.003]),
        ("hulbert_chung", {"rho_b": 0.8}, [-0.75, 0.36, -0.18, 0.09]),
        ("houbolt", {}, [-0.83, 0.33, 0.0, 0.0]),
    ],
)
def test_velocity_after_the_stop(integrator, parameters, expected):
    v, a = held(integrator, parameters, len(expected))
    np.testing.assert_allclose(v, expected, atol=6e-3)
    if integrator == "newmark" or parameters.get("beta") == 1.0:
        # Hu's pair: exactly at rest after two steps
        assert np.abs(v[2:]).max() < 1e-10
        assert np.abs(a[2:]).max() < 1e-10


@pytest.mark.parametrize(
    ("integrator", "parameters", "radius"),
    [
        ("chung_lee", {}, 0.189),
        ("hulbert_chung", {"rho_b": 0.0}, 0.447),
        ("hulbert_chung", {"rho_b": 0.3}, 0.289),
        ("hulbert_chung", {"rho_b": 0.8}, 0.486),
        ("hulbert_chung", {"rho_b": 1.0}, 1.0),
        ("newmark", {"beta": 0.25, "gamma": 0.5}, 1.0),
        ("newmark", {"beta": 0.3025, "gamma": 0.6}, 0.82),
        ("newmark", {"beta": 1 / 6, "gamma": 0.5}, 3.73),
    ],
)
def test_growth_of_the_recursion(integrator, parameters, radius):
    """By the accelerations of consecutive steps; above 1 contact chatters and gains energy."""
    _, a = held(integrator, parameters, 9)
    # a double eigenvalue (the trapezoid's, the bifurcation of Chung and Lee) is found to the root of rounding
    assert np.abs(roots(a[1:], 2)).max() == pytest.approx(radius, abs=6e-3)


def test_chatter_of_the_trapezoid_grows_linearly():
    _, a = held("newmark", {"beta": 0.25, "gamma": 0.5}, 12)
    assert np.sign(a[1:]) @ np.sign(a[:-1]) == -11
    growth = np.diff(np.abs(a))
    np.testing.assert_allclose(growth, growth[0], rtol=1e-6)
    assert growth[0] > 0.0


@pytest.mark.parametrize(
    ("theta", "radius", "alternates"),
    [(1.37, 0.976, True), (1.4, 0.778, True), (1.5, 0.533, False), (2.0, 0.634, False)],
)
def test_wilson_held_at_theta_h(theta, radius, alternates):
    """Held at t + theta h the node itself is not on its place: it moves as at infinite frequency.

    Below theta = 1.5 a real root near -1 makes the reaction alternate, so that a wall lets go every other step.
    """
    _, a = held("wilson", {"theta": theta}, 16)
    found = roots(a, 3)
    assert np.abs(found).max() == pytest.approx(radius, abs=6e-4)
    assert np.abs(found).max() == pytest.approx(np.abs(wilson(theta)(1e8)).max(), rel=1e-4)
    largest = found[np.argmax(np.abs(found))]
    assert (abs(largest.imag) < 1e-6 and largest.real < 0.0) == alternates

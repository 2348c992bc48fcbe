"""Velocity and acceleration of a node that is stopped and fixed: the recursion that determines chatter."""

import numpy as np
import pytest
from helpers.oscillator import roots, wilson

from pfem_petsc.integrators.base import State
from pfem_petsc.registry import lookup

SPEED, STEP, MOVING = 0.1, 0.01, 8  # the node moves for so many steps, then it is held


def held(integrator, parameters, steps):
    """Velocity over SPEED and acceleration times STEP over SPEED after the stop, step by step."""
    module = lookup("pfem_petsc.integrators", integrator, "test")
    scheme = module.Scheme(module.Parameters(**parameters))
    start = np.zeros((1, 3))
    state = State(start.copy(), start + [SPEED, 0.0, 0.0], *(start.copy() for _ in range(5)))
    scheme.start(state, STEP)
    found = []
    for step in range(MOVING + steps):
        balance = scheme.balance(state, STEP)
        place = start + [SPEED * min(balance.time, MOVING * STEP), 0.0, 0.0]
        scheme.finish(state, balance, place - balance.predictor, STEP)
        state.time = (step + 1) * STEP
        found.append((state.v[0, 0] / SPEED, state.a[0, 0] * STEP / SPEED))
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

"""The elastic rod on a rigid wall: force, duration and rebound of every scheme, against independent computations."""

from functools import cache

import numpy as np
import pytest
from helpers.runs import energy, episodes, force, imbalance, run_alone

ELEMENTS, LENGTH, STEP = 20, 1.0, 0.01


@cache
def rod(speed, *overrides, elements=ELEMENTS, step=STEP):
    """History of rod_impact; E = rho = A = 1, so rho c A v = v."""
    settings = [f"initial.velocity=[{speed}, 0.0, 0.0]", f"time.step={step}", f"mesh.elements={elements}"]
    return run_alone("rod_impact", *settings, *overrides, "solver.rtol=1e-12")


def plateau(history, speed):
    """Mean force while the wave runs, over rho c A v: from 0.2 to 1.8 after the impact, the last instant left out."""
    since = history["time"] - 0.05 / speed
    return force(history, "wall")[(since > 0.2 - 1e-9) & (since < 1.8 - 1e-9)].mean() / speed


def rebound(history):
    return -history["momentum"][-1, 0] / history["momentum"][0, 0]


def one_dimensional(scheme, speed, gap=0.05, end=5.0):
    """The same rod as springs and masses on a line: force on the wall after each step, and the mean final velocity."""
    size = LENGTH / ELEMENTS
    m = np.full(ELEMENTS + 1, size)
    m[[0, -1]] *= 0.5
    k = np.diag(np.r_[1.0, np.full(ELEMENTS - 1, 2.0), 1.0]) - np.diag(np.ones(ELEMENTS), 1)
    k = (k - np.diag(np.ones(ELEMENTS), -1)) / size
    steps = round(end / STEP)
    forces = np.zeros(steps + 1)
    u, v, a = np.zeros(ELEMENTS + 1), np.full(ELEMENTS + 1, speed), np.zeros(ELEMENTS + 1)
    before = u - STEP * v
    effective = k + np.diag(m) / STEP**2
    for n in range(steps):
        if scheme == "central_differences":  # the force that keeps x_{n+1} behind the wall acts at t_n
            after = 2 * u - before - STEP**2 * (k @ u) / m
            forces[n] = max(m[-1] * (after[-1] - gap) / STEP**2, 0.0)
            after[-1] = min(after[-1], gap)
            v, before, u = (after - before) / (2 * STEP), u, after
        else:  # beta = 1, gamma = 3/2
            predictor = u + STEP * v - 0.5 * STEP**2 * a
            load = m * predictor / STEP**2
            after = np.linalg.solve(effective, load)
            if after[-1] > gap:
                after[-1] = gap
                after[:-1] = np.linalg.solve(effective[:-1, :-1], load[:-1] - effective[:-1, -1] * gap)
                forces[n + 1] = load[-1] - effective[-1] @ after
                assert forces[n + 1] > 0.0
            new = (after - predictor) / STEP**2
            v, u, a = v + STEP * (1.5 * new - 0.5 * a), after, new
    return forces, m @ v


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scheme", "mean", "spike", "last", "back"),
    [("central_differences", 0.9998, 2.500, 2.14, 0.958), ("newmark", 0.9925, 2.693, 2.11, 0.884)],
)
def test_numbers_of_two_independent_implementations(scheme, mean, spike, last, back):
    history = rod(0.5, f"time.integrator={scheme}")
    assert plateau(history, 0.5) == pytest.approx(mean, abs=1e-3)
    assert force(history, "wall").max() / 0.5 == pytest.approx(spike, abs=1e-3)
    ((start, end),) = episodes(history, "wall")
    assert start == pytest.approx(0.10, abs=STEP * 1.01)
    assert end == pytest.approx(last, abs=STEP * 1.01)
    assert rebound(history) == pytest.approx(back, abs=1e-3)
    assert imbalance(history) < 1e-10


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["central_differences", "newmark"])
def test_force_history_is_that_of_springs_and_masses_on_a_line(scheme):
    history = rod(0.1, f"time.integrator={scheme}")
    forces, momentum = one_dimensional(scheme, 0.1)
    found = force(history, "wall")
    # the impact at t = 0.5 falls on a step: rounding decides which of two steps has the first touch
    delay = int(np.flatnonzero(found)[0] - np.flatnonzero(forces > 1e-12)[0])
    assert abs(delay) <= 1
    assert np.abs(np.roll(found, -delay) - forces)[2:-2].max() < 1e-7
    assert history["momentum"][-1, 0] == pytest.approx(momentum, abs=1e-3 * abs(momentum))


# v0 = 0.1, gap 0.05, lumped mass: last contact, largest force over rho c A v, releases, rebound, energy left
TABLE = [
    ("central_differences", {}, 2.55, 2.50, 1, 0.958, 0.975),
    ("chung_lee", {"beta": 1.0}, 2.55, 2.50, 1, 0.958, 0.976),
    ("chung_lee", {}, 2.55, 2.41, 1, 0.958, 0.975),
    ("newmark", {}, 2.52, 2.69, 1, 0.884, 0.808),
    ("houbolt", {}, 2.54, 5.20, 2, 0.950, 0.947),
    ("hulbert_chung", {"rho_b": 0.0}, 2.54, 2.00, 1, 0.955, 0.958),
    ("wilson", {"theta": 1.5}, 2.54, 3.4, 2, 0.955, 0.965),
    ("wilson", {"theta": 2.0}, 2.54, 3.9, 2, 0.951, 0.954),
]


@pytest.mark.slow
@pytest.mark.parametrize(("scheme", "parameters", "last", "largest", "releases", "back", "left"), TABLE)
def test_table_of_schemes(scheme, parameters, last, largest, releases, back, left):
    keys = [f"time.{name}={value}" for name, value in parameters.items()]
    history = rod(0.1, f"time.integrator={scheme}", *keys)
    found = episodes(history, "wall")
    assert found[-1][1] == pytest.approx(last, abs=2.01 * STEP)
    # wilson's were noted with two digits
    assert force(history, "wall").max() / 0.1 == pytest.approx(largest, abs=0.06 if scheme == "wilson" else 0.006)
    assert len(found) == releases
    assert rebound(history) == pytest.approx(back, abs=1e-3)
    assert energy(history)[-1] / energy(history)[0] == pytest.approx(left, abs=1.5e-3)
    assert imbalance(history) < 1e-10


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mass", "scheme", "largest", "left"),
    [("consistent", "newmark", None, 0.811), ("consistent", "houbolt", 3.2, 0.957)],
)
def test_consistent_mass(mass, scheme, largest, left):
    history = rod(0.1, f"time.integrator={scheme}", f"time.mass={mass}")
    assert energy(history)[-1] / energy(history)[0] == pytest.approx(left, abs=1.5e-3)
    if largest:
        assert force(history, "wall").max() / 0.1 == pytest.approx(largest, abs=0.06)


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["central_differences", "newmark"])
def test_convergence_under_refinement(scheme):
    """Force, duration and rebound tend to 1, 2 and 1 as bars and step shrink together."""
    sizes = (20, 40, 80, 160) if scheme == "central_differences" else (20, 40, 80)
    errors = []
    for elements in sizes:
        history = rod(0.5, f"time.integrator={scheme}", "time.end=2.6", elements=elements, step=0.2 / elements)
        found = episodes(history, "wall")
        duration = found[-1][1] - found[0][0]
        inside = (history["time"] > 0.3) & (history["time"] < 1.9)
        median = np.median(force(history, "wall")[inside]) / 0.5
        errors.append([abs(median - 1.0), abs(duration - 2.0), 1.0 - rebound(history)])
    errors = np.array(errors)
    assert (errors[1:, 2] < 0.85 * errors[:-1, 2]).all()
    assert errors[-1, 0] < 2e-3
    assert errors[-1, 1] < 0.6 * errors[0, 1]

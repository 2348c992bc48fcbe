"""Two bars that collide end on: plane-wave theory for force, duration and the plastic plateau."""

import numpy as np
import pytest
from helpers.runs import episodes, force, imbalance, run_alone

YOUNG, DENSITY, LENGTH, AREA, SPEED = 207e9, 7844.0, 0.254, 645e-6, 5.136
YIELD, HARDENING = 69e6, 6.9e9
WAVE = np.sqrt(YOUNG / DENSITY)
FORCE = DENSITY * WAVE * AREA * SPEED
DURATION = 2.0 * LENGTH / WAVE
ARRIVAL = 25.4e-6 / SPEED


def bars(name, elements, step):
    return run_alone(name, f"mesh.elements={elements}", f"time.step={step}")


def plateau(history):
    """Force [N] while the first waves run."""
    since = history["time"] - ARRIVAL
    return force(history, "symmetry")[(since > 0.1 * DURATION) & (since < 0.9 * DURATION)]


@pytest.mark.parametrize(
    ("elements", "step", "slack"), [(20, 0.5e-6, 0.035), (20, 2e-6, 0.035), (80, 0.25e-6, 0.015), (80, 0.5e-6, 0.015)]
)
def test_elastic_force_and_duration(elements, step, slack):
    history = bars("bar_collision", elements, step)
    ((first, last),) = episodes(history, "symmetry")
    # a force recorded at t_n acts over a step around it: contact lasts from the first to the last, that step included
    assert last - first == pytest.approx(98.9e-6, rel=slack)
    assert np.median(plateau(history)) == pytest.approx(133.5e3, rel=5e-3)
    assert imbalance(history) < 1e-10


def test_plastic_plateau_converges_and_contact_is_longer():
    modulus = YOUNG * HARDENING / (YOUNG + HARDENING)
    slow = np.sqrt(modulus / DENSITY)
    yield_speed = YIELD / (DENSITY * WAVE)
    theory = AREA * (YIELD + DENSITY * slow * (SPEED - yield_speed))
    assert theory == pytest.approx(60.48e3, rel=2e-3)
    errors = []
    for elements, step in ((20, 1e-6), (80, 0.25e-6)):
        history = bars("bar_collision_plastic", elements, step)
        errors.append(abs(plateau(history).mean() / 60.48e3 - 1.0))
        assert imbalance(history) < 1e-10
    assert errors[-1] < 0.015
    assert errors[-1] < errors[0]
    (_, last) = episodes(history, "symmetry")[-1]
    elastic = bars("bar_collision", 80, 0.25e-6)
    assert last > episodes(elastic, "symmetry")[-1][1] + 0.5 * DURATION
    assert last == pytest.approx(173e-6, rel=0.02)
    rebound = -SPEED * history["momentum"][-1, 0] / history["momentum"][0, 0]
    assert rebound == pytest.approx(1.47, abs=0.05)


@pytest.mark.parametrize("scheme", ["newmark", "houbolt", "chung_lee", "souza_moura"])
def test_every_scheme_finds_the_plastic_plateau(scheme):
    history = run_alone("bar_collision_plastic", f"time.integrator={scheme}", "time.end=1e-4")
    assert plateau(history).mean() == pytest.approx(60.48e3, rel=0.03)
    assert imbalance(history) < 1e-10

"""The largest force of a wall does not depend on the step: a node that is stopped gives an impulse, not a force."""

import numpy as np
import pytest

from pfem_petsc import Case, Simulation, Truss, open_result
from pfem_petsc.output.result import peak_force, touch_impulse

# a rod of unit E, rho and A whose end node, of mass l/2, is at the wall
LENGTH, SPEED = 0.05, 0.5
WALL = {"name": "wall", "type": "plane", "point": [1.0, 0, 0], "normal": [-1.0, 0, 0]}


def impulse_of_chain(time):
    """Of the wall, at v = 1: nodes of a semi-infinite chain have the velocities v (J_0 + J_2)(2 c t/l) of the infinite
    one with opposite velocities on both sides, which gives the force rho c A v times the integral of J_1(x)/x."""
    x = 2.0 * time / LENGTH
    angle = (np.arange(400) + 0.5) * np.pi / 400
    slope = np.array([np.cos(angle - a * np.sin(angle)).mean() / a if a else 0.5 for a in x])
    force = np.concatenate([[0.0], np.cumsum(0.5 * np.diff(x) * (slope[1:] + slope[:-1]))])
    return 0.5 * LENGTH + np.concatenate([[0.0], np.cumsum(0.5 * np.diff(time) * (force[1:] + force[:-1]))])


def run(folder, steps, **sets):
    sets = {"mesh.length": 1.0, "time.step": 0.025 / steps, "time.end": 0.5, "wall": [WALL], **sets}
    assert Simulation(Case.load("rod_impact").copy(sets), output=folder, quiet=True).run() == 0
    return open_result(folder)


@pytest.mark.slow
def test_peak_at_first_touch_converges(tmp_path):
    """To the largest mean of the closed form over 2 l/c, which is 3 % above the continuous rod's rho c A v.

    The force of the first row is v l/(2 h) or half of it, 16 times as large at the smallest step.
    """
    time = np.linspace(0.0, 0.5, 2001)
    exact = impulse_of_chain(time)
    mean = (exact[400:] - np.concatenate([exact[:-400]])) / (2.0 * LENGTH)
    largest = SPEED * max(mean.max(), exact[400] / (2.0 * LENGTH))
    assert largest == pytest.approx(SPEED, rel=0.05)
    peaks, rows, touches = [], [], []
    for steps in (1, 4, 16):
        result = run(tmp_path / str(steps), steps)
        peak, _, window = peak_force(result, "wall/wall/force")
        assert window == pytest.approx(2.0 * LENGTH, rel=1e-9)
        peaks.append(abs(peak - largest))
        rows.append(np.linalg.norm(result.history["wall/wall/force"], axis=1).max())
        touches.append(abs(touch_impulse(result, "wall")[0] - 0.5 * LENGTH * SPEED))
    assert peaks[2] < peaks[1] < peaks[0] and peaks[2] < 3e-3 * SPEED
    assert rows[2] > 3.5 * rows[1]
    # first order: the force goes on in the steps after the touch
    assert touches[2] < 0.35 * touches[1] < 0.15 * touches[0]


@pytest.mark.slow
@pytest.mark.parametrize(("scheme", "factor"), [("newmark", 1.0), ("energy_momentum", 2.0)])
def test_impulse_of_touches_is_the_momentum_that_is_stopped(tmp_path, scheme, factor):
    """Twice of it for a scheme that keeps the energy: the node is thrown back."""
    result = run(tmp_path, 64, **{"time.integrator": scheme, "time.end": 0.01})
    touching, whole = touch_impulse(result, "wall")
    assert touching == pytest.approx(factor * 0.5 * LENGTH * SPEED, rel=5e-3)
    assert touching <= whole


@pytest.mark.slow
def test_support_that_starts_at_once(tmp_path):
    """A chain whose end is pulled at once: the node's momentum is an impulse, whatever the step."""
    peaks, rows = [], []
    for steps in (4, 16):
        points = LENGTH * np.arange(21)[:, None] * [1.0, 0, 0]
        tables = {
            "material": {"it": {"young_modulus": 1.0, "density": 1.0}},
            "section": {"it": {"area": 1.0, "material": "it"}},
            "node_set": {"end": {"indices": [20]}, "all": {"all": True}},
            "support": [
                {
                    "node_set": "end",
                    "fix": "xyz",
                    "motion": [[0.0, 0, 0, 0], [0.1, 0, 0, 0], [1.1, 1e-3, 0, 0]],
                    "interpolation": "linear",
                },
            ],
            "time": {"integrator": "central_differences", "step": 0.025 / steps, "end": 0.5},
        }
        case = Case(tables, mesh=Truss(points, np.stack([np.arange(20), np.arange(1, 21)], axis=1)))
        assert Simulation(case, output=tmp_path / str(steps), quiet=True).run() == 0
        result = open_result(tmp_path / str(steps))
        peaks.append(peak_force(result, "support_force")[0])
        rows.append(np.linalg.norm(result.history["support_force"], axis=1).max())
    assert rows[1] > 3.5 * rows[0]
    assert peaks[1] == pytest.approx(1e-3, rel=0.05) and peaks[0] == pytest.approx(peaks[1], rel=0.05)


@pytest.mark.slow
def test_walls_of_later_stages_have_a_window(tmp_path):
    time = {"integrator": "central_differences", "step": 0.0125}
    stages = [
        {"name": "flight", "wall": [], "time": {**time, "end": 0.05}},
        {"name": "touch", "wall": [{**WALL, "point": [1.05, 0, 0]}], "time": {**time, "end": 0.2}},
    ]
    rod = Case.load("rod_impact").to_dict()
    del rod["time"], rod["wall"]
    case = Case(**{**rod, "stage": stages})
    assert Simulation(case, output=tmp_path, quiet=True).run() == 0
    result = open_result(tmp_path)
    peak, _, window = peak_force(result, "wall/wall/force")
    assert window == pytest.approx(2.0 * LENGTH, rel=1e-9)
    assert peak == pytest.approx(SPEED, rel=0.1)
    assert touch_impulse(result, "wall")[0] > 0.5 * LENGTH * SPEED

"""The largest force of a wall does not depend on the step: a node that is stopped gives an impulse, not a force."""

import pytest

from pfem_petsc import Case, Simulation, open_result
from pfem_petsc.output.peaks import peak_force


@pytest.mark.slow
def test_peak_at_first_touch_converges(tmp_path):
    """A rod of unit E, rho, A at the wall: its end node has the mass l/2, the wave needs 2 l forth and back.

    While the wave runs through the first bar and back, the exact force is rho c A v = v, and the mean of the discrete
    truss is that of the same impulse to some percent; the force of the first row is v l/(2 h).
    """
    peaks = []
    for steps in (1, 4, 16):
        sets = {"mesh.length": 1.0, "time.step": 0.025 / steps, "time.end": 0.5}
        case = Case.load("rod_impact").copy(
            {**sets, "wall": [{"name": "wall", "type": "plane", "point": [1.0, 0, 0], "normal": [-1.0, 0, 0]}]}
        )
        assert Simulation(case, output=tmp_path / str(steps), quiet=True).run() == 0
        peak, _, window = peak_force(open_result(tmp_path / str(steps)), "wall")
        assert window == pytest.approx(0.1, rel=1e-9)
        peaks.append(peak)
    assert abs(peaks[2] - peaks[1]) < 0.3 * abs(peaks[1] - peaks[0]) + 1e-3
    assert peaks[2] == pytest.approx(0.5, rel=0.25)  # v = 0.5; the largest row is 0.5 * 0.05/(2 h) = 8 at 16

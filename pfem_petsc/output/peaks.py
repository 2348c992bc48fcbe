"""Peak forces of walls that do not depend on the step: means over a window of the mesh."""

from __future__ import annotations

from typing import Any

import numpy as np

__all__ = ["peak_force"]


def peak_force(result: Any, wall: str) -> tuple[float, float, float]:
    """Return the largest mean force of a wall [N], the time [s] at which its window ends, and the window [s].

    The window is the time of a wave forth and back in the shortest bar at the wall, or the interval of the rows if that
    is longer. The mean is the change of the impulse over it, zero before the run. Without an impulse, as in static
    analyses and old results, it is the largest force of a row, with a window of zero.
    """
    history = result.history
    time, force = history["time"], history[f"wall/{wall}/force"]
    window = 2.0 * float(result.attributes.get(f"wave_time/{wall}", 0.0))
    columns = [f"wall/{wall}/impulse", f"wall/{wall}/jump_impulse"]
    if "load_factor" in history or not 0.0 < window < np.inf or len(time) < 2 or columns[1] not in history:
        size = np.linalg.norm(force, axis=1)
        peak = int(np.argmax(size))
        return float(size[peak]), float(time[peak]), 0.0
    window = max(window, float(np.diff(time).max()))
    impulse = history[columns[0]] + history[columns[1]]
    # the mean of a piecewise linear impulse is largest where the window begins or ends at a row
    ends = np.unique(np.concatenate([time, np.minimum(time + window, time[-1])]))
    change = [np.interp(ends, time, part) - np.interp(ends - window, time, part, left=0.0) for part in impulse.T]
    mean = np.linalg.norm(change, axis=0) / window
    peak = int(np.argmax(mean))
    return float(mean[peak]), float(ends[peak]), window

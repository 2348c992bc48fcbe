"""Peak forces of walls and supports that do not depend on the step: means over a window of the mesh."""

from __future__ import annotations

from typing import Any

import numpy as np

__all__ = ["peak_force", "touch_impulse"]


def _impulse(history: Any, column: str) -> np.ndarray | None:
    """Return the impulse (rows, 3) [N s] of a column of forces, None where the result has none."""
    names = [f"{column.removesuffix('force')}{kind}" for kind in ("impulse", "jump_impulse")]
    if "load_factor" in history or names[0] not in history:
        return None
    return sum(np.asarray(history[name], dtype=float) for name in names if name in history)


def peak_force(result: Any, column: str) -> tuple[float, float, float]:
    """Return the largest mean force [N] of a column, the time [s] at which its window ends, and the window [s].

    The column is ``wall/NAME/force`` or ``support_force``. The window is the time of a wave forth and back in the
    shortest bar at the wall or the supports, or the interval of the rows if that is longer. The mean is the change of
    the impulse over it, zero before the run. Without an impulse, as in static analyses and old results, it is the
    largest force of a row, with a window of zero.
    """
    history = result.history
    time, force = history["time"], history[column]
    impulse = _impulse(history, column)
    window = 2.0 * float(result.attributes.get(f"wave_time/{column}", 0.0))
    if impulse is None or not 0.0 < window < np.inf or len(time) < 2:
        size = np.linalg.norm(force, axis=1)
        peak = int(np.argmax(size))
        return float(size[peak]), float(time[peak]), 0.0
    window = max(window, float(np.diff(time).max()))
    # the mean of a piecewise linear impulse is largest where the window begins or ends at a row
    ends = np.unique(np.concatenate([time, np.minimum(time + window, time[-1])]))
    change = [np.interp(ends, time, part) - np.interp(ends - window, time, part, left=0.0) for part in impulse.T]
    mean = np.linalg.norm(change, axis=0) / window
    peak = int(np.argmax(mean))
    return float(mean[peak]), float(ends[peak]), window


def touch_impulse(result: Any, wall: str) -> tuple[float, float]:
    """Return the impulse [N s] of a wall in the rows in which nodes touch it, and that of all rows.

    Nodes touch in a row with more nodes in contact than the row before, and in the first row with an impulse. The row
    after each is counted too, as schemes correct the force there. As the interval of the rows falls, it converges to
    the impulse that stops nodes, which no mean force of a row shows.
    """
    history = result.history
    impulse = _impulse(history, f"wall/{wall}/force")
    if impulse is None or len(impulse) < 2:
        return 0.0, 0.0
    changes = np.diff(impulse, axis=0)
    touching = np.diff(np.asarray(history[f"wall/{wall}/contacts"], dtype=float)) > 0.0
    touching[:1] |= changes[0].any()
    touching[1:] |= touching[:-1].copy()
    return float(np.linalg.norm(changes[touching].sum(axis=0))), float(np.linalg.norm(impulse[-1] - impulse[0]))

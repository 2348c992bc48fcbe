"""Tables over time, many of them evaluated together in one compiled loop.

Between rows, values are linear, or with ``smooth`` those of the cubic spline of :mod:`~pfem_petsc.mechanics.motion`:
twice continuously differentiable, with zero slope at the first and the last row and at intervals of rest. Values are
constant outside the rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .compiled import kernel
from .motion import spline_slopes

__all__ = ["Group", "Table", "TimeTables", "grouped"]


@kernel
def _evaluate(time, first, count, times, start, width, smooth, values, slopes, out):
    """Write the values of all groups at a time to ``out``, group by group."""
    at = 0
    for g in range(len(first)):
        t, n, w, here = first[g], count[g], width[g], start[g]
        low, high = 0, n - 1
        while high - low > 1:
            middle = (low + high) // 2
            if times[t + middle] <= time:
                low = middle
            else:
                high = middle
        passed = time - times[t + low]
        if time >= times[t + n - 1]:
            low, passed = n - 1, 0.0
        v0 = here + low * w
        if passed <= 0.0:
            for c in range(w):
                out[at + c] = values[v0 + c]
        elif smooth[g]:
            span = times[t + low + 1] - times[t + low]
            for c in range(w):
                y0, m0, m1 = values[v0 + c], slopes[v0 + c], slopes[v0 + w + c]
                rate = (values[v0 + w + c] - y0) / span
                square = (3.0 * rate - 2.0 * m0 - m1) / span
                cube = (m0 + m1 - 2.0 * rate) / (span * span)
                out[at + c] = y0 + passed * (m0 + passed * (square + passed * cube))
        else:
            span = times[t + low + 1] - times[t + low]
            for c in range(w):
                y0 = values[v0 + c]
                out[at + c] = (values[v0 + w + c] - y0) / span * passed + y0
        at += w


class Group(NamedTuple):
    """Columns with the same times.

    Attributes
    ----------
    times : (n,) increasing [s]
    values : (n, k)
    smooth : whether they are interpolated by a spline
    """

    times: np.ndarray
    values: np.ndarray
    smooth: bool = False


class TimeTables:
    """All columns of some groups.

    Attributes
    ----------
    width : number of columns
    """

    def __init__(self, groups: Sequence[Group]) -> None:
        self.width = sum(group.values.shape[1] for group in groups)
        counts = np.array([len(group.times) for group in groups], dtype=np.int64)
        widths = np.array([group.values.shape[1] for group in groups], dtype=np.int64)
        smooth = np.array([group.smooth for group in groups], dtype=np.bool_)
        nothing = np.zeros(0)
        times = np.concatenate([nothing, *(group.times for group in groups)])
        values = np.concatenate([nothing, *(np.ravel(group.values) for group in groups)])
        slopes = nothing
        if smooth.any():
            slopes = np.concatenate([np.ravel(_slopes(g) if g.smooth else np.zeros_like(g.values)) for g in groups])
        first = np.cumsum(counts) - counts
        start = np.cumsum(counts * widths) - counts * widths
        self._arguments = (first, counts, times, start, widths, smooth, values, slopes)

    def at(self, time: float, out: np.ndarray) -> None:
        """Write the values (width,) at a time [s], group by group."""
        _evaluate(time, *self._arguments, out)


def _slopes(group: Group) -> np.ndarray:
    if len(group.times) < 2:
        return np.zeros_like(group.values)
    return np.column_stack([spline_slopes(group.times, column) for column in group.values.T])


def grouped(tables: Sequence[tuple[np.ndarray, bool]]) -> tuple[list[Group], np.ndarray]:
    """Return groups of tables with two columns (n, 2), smooth or not, and the column of each table in the groups."""
    members: dict[tuple[bytes, bool], list[int]] = {}
    for k, (rows, smooth) in enumerate(tables):
        members.setdefault((rows[:, 0].tobytes(), smooth), []).append(k)
    columns = np.empty(len(tables), dtype=np.int64)
    groups, n = [], 0
    for (_, smooth), which in members.items():
        groups.append(
            Group(tables[which[0]][0][:, 0].copy(), np.column_stack([tables[k][0][:, 1] for k in which]), smooth)
        )
        columns[which] = np.arange(n, n + len(which))
        n += len(which)
    return groups, columns


class Table:
    """A function of time by rows (t, value, ...).

    Attributes
    ----------
    values : (n, k) of its rows
    """

    def __init__(self, rows: Sequence[Sequence[float]], smooth: bool = False) -> None:
        rows = np.array(rows, dtype=np.float64)
        self.values = rows[:, 1:].copy()
        self._tables = TimeTables([Group(rows[:, 0].copy(), self.values, smooth)])

    def __call__(self, time: float) -> np.ndarray:
        """Return the values at a time, one per column."""
        out = np.empty(self._tables.width)
        self._tables.at(time, out)
        return out

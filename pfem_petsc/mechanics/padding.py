"""Padded columns: bars of diagonal runs with a few columns between them that belong to no bar.

In a lattice the bars of one direction are diagonal runs as long as a row of cells, with a gap of one node between rows.
Columns for these gaps make one long run of all rows in a chunk, for which compiled loops need no start and end at each
row. Further columns let it begin and end at nodes whose numbers are multiples of the length of vector instructions. The
loops give columns without a bar, which have negative rest lengths, the state of a bar without strain and area.
"""

from __future__ import annotations

import numpy as np

from .compiled import kernel
from .planes import aligned
from .strips import LANES
from .sweep import OWN_CHUNK, Sweep

__all__ = ["NO_BAR", "Padding"]

NO_BAR = -1.0
"""Rest length of a column without a bar [m]."""


class Padding:
    """Columns for the bars of a sweep that begins at bar 0.

    Attributes
    ----------
    sweep : Sweep
        The same chunks by columns, with fewer runs.
    any : whether any column has no bar; if not, columns are bars
    """

    def __init__(self, sweep: Sweep) -> None:
        runs = len(sweep.heads)
        self._bars = sweep.starts
        self._columns = np.empty(runs + 1, dtype=np.uint32)
        merged = np.empty(runs, dtype=np.bool_)
        leads = np.zeros(runs, dtype=np.uint32)
        places = (sweep.starts, sweep.lanes, sweep.chunks, sweep.diagonal)
        columns = _count_columns(*places, self._columns, merged, leads)
        self.any = columns > int(sweep.starts[-1])
        kept = np.flatnonzero(~merged)
        chunks = np.searchsorted(kept, sweep.chunks).astype(np.uint32)
        ahead = leads[kept]
        self.sweep = sweep._replace(
            heads=sweep.heads[kept] - ahead,
            fars=sweep.fars[kept] - ahead,
            starts=np.append(self._columns[kept] - ahead, np.uint32(columns)),
            lanes=sweep.lanes[kept] - ahead,
            chunks=chunks,
        )

    def spread(self, values: np.ndarray, none: float | None = None) -> np.ndarray:
        """Return ``values`` (..., b) of bars by columns (..., c), with ``none`` at columns without a bar, by default
        the value of the bar before; the same array if there are no such columns."""
        if not self.any or not values.shape[-1]:
            return values
        columns = int(self._columns[-1])
        spread = aligned(columns * (values.size // values.shape[-1])).reshape(*values.shape[:-1], columns)
        self.renew(values, spread, none)
        return spread

    def renew(self, values: np.ndarray, spread: np.ndarray, none: float | None = None) -> None:
        """Write ``values`` to ``spread``, the result of :meth:`spread`."""
        if spread is not values:
            for row, columns in zip(_rows(values), _rows(spread), strict=True):
                _spread(row, self._bars, self._columns, none is None, none or 0.0, columns)

    def collect(self, spread: np.ndarray, values: np.ndarray) -> None:
        """Write the values of :meth:`spread` back to those of the bars."""
        if spread is not values:
            for row, columns in zip(_rows(values), _rows(spread), strict=True):
                _collect(columns, self._bars, self._columns, row)

    @property
    def counted(self) -> int:
        """Number of columns of the bars that are counted on this rank."""
        return int(self.sweep.starts[self.sweep.chunks[self.sweep.counted]])

    def bar(self, column: int) -> int:
        """Return the bar of a column."""
        run = int(np.searchsorted(self._columns, column, side="right")) - 1
        return int(self._bars[run]) + column - int(self._columns[run])


def _rows(values: np.ndarray) -> np.ndarray:
    return values.reshape(-1, values.shape[-1])


@kernel
def _count_columns(starts, lanes, chunks, diagonal, columns, merged, leads):
    """Return the number of columns; write the first column of each run, the end, which runs continue others, and how
    many columns without a bar there are before the first run of a chunk."""
    count = np.int64(0)
    for c in range(len(chunks) - 1):
        origin = count
        single = diagonal[c] and starts[chunks[c + 1]] - starts[chunks[c]] >= OWN_CHUNK
        for run in range(chunks[c], chunks[c + 1]):
            merged[run] = run > chunks[c] and origin + np.int64(lanes[run]) > count
            single = single and (run == chunks[c] or merged[run])
            columns[run] = origin + np.int64(lanes[run])
            count = np.int64(columns[run]) + np.int64(starts[run + 1]) - np.int64(starts[run])
        leads[chunks[c]] = lanes[chunks[c]]
        if single:
            count = origin + -(-(count - origin) // LANES) * LANES
    columns[len(merged)] = count
    return count


@kernel
def _spread(values, bars, columns, repeat, none, spread):
    for k in range(columns[0]):
        spread[k] = values[0] if repeat else none
    for run in range(len(bars) - 1):
        count = bars[run + 1] - bars[run]
        for k in range(count):
            spread[columns[run] + k] = values[bars[run] + k]
        for k in range(columns[run] + count, columns[run + 1]):
            spread[k] = spread[k - 1] if repeat else none


@kernel
def _collect(spread, bars, columns, values):
    for run in range(len(bars) - 1):
        for k in range(bars[run + 1] - bars[run]):
            values[bars[run] + k] = spread[columns[run] + k]

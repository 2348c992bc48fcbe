"""Columns: the bars of one offset in a block of nodes as one run.

In a lattice the bars of one direction are diagonal runs as long as a row of cells, with a gap of one node between rows.
Columns for these gaps, and up to nodes whose numbers are multiples of the length of vector instructions, make one run
of all rows in a block. Columns without a bar have negative rest lengths; they get the state of a bar without strain and
area.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .compiled import kernel
from .planes import aligned, copy_run
from .rows import CHUNK
from .strips import APART, LANES
from .sweep import Sweep

__all__ = ["NO_BAR", "Columns", "gather_history", "make_columns", "no_columns", "spread_history"]

NO_BAR = -1.0
"""Rest length of a column without a bar [m]."""

_MOST = 1.25  # columns for each bar; beyond, they cost more than the begin and end of each run


class Columns(NamedTuple):
    """Columns of all bars of a sweep that begins at bar 0, in groups of one offset and one block of nodes.

    Attributes
    ----------
    heads, fars : (groups,) uint32, ends of the first column of each group
    starts : (groups + 1,) uint32, first column of each group, and the end
    runs : (groups + 1,) uint32, first run of the sweep in each group, and the end
    close : (groups,) bool, whether vectors of both ends overlap: forces are then added run by run, as in single steps
    rest : (columns,) rest lengths [m]
    area : areas [m2], a number or (columns,)
    kept : (rows, columns) history of the bars, or rows without columns; see :func:`spread_history`
    counted : number of leading groups whose bars are counted on this rank
    parts : (parts + 1,) int64, first group of each part of the sweep; (0,) if there are no columns
    """

    heads: np.ndarray
    fars: np.ndarray
    starts: np.ndarray
    runs: np.ndarray
    close: np.ndarray
    rest: np.ndarray
    area: float | np.ndarray
    kept: np.ndarray
    counted: int
    parts: np.ndarray


def no_columns(area: float | np.ndarray, rows: int) -> Columns:
    """Return the columns of a sweep that has none, for ``rows`` of a history; ``area``: for its type."""
    none = np.empty(0, dtype=np.uint32)
    empty = np.empty(0)
    area = empty if isinstance(area, np.ndarray) else area
    return Columns(
        none,
        none,
        none,
        none,
        np.empty(0, dtype=np.bool_),
        empty,
        area,
        np.empty((rows, 0)),
        0,
        np.empty(0, dtype=np.int64),
    )


def make_columns(sweep: Sweep, rest: np.ndarray, area: float | np.ndarray, rows: int) -> Columns:
    """Make the columns of a sweep of diagonal chunks, with room for ``rows`` of a history; ``rest`` (b,) [m],
    ``area`` [m2] a number or (b,)."""
    n = len(sweep.heads)
    firsts = np.append(sweep.chunks[sweep.parts].astype(np.int64), n)  # runs that begin a part, or are not counted
    fresh = np.zeros(n + 1, dtype=np.bool_)
    fresh[firsts] = True
    group_of = np.empty(n, dtype=np.int64)
    groups = _group_runs(sweep.heads, sweep.fars, sweep.starts, fresh, group_of)
    runs = np.searchsorted(group_of, np.arange(groups + 1)).astype(np.uint32)
    counted = int(np.searchsorted(runs, sweep.chunks[sweep.counted]))
    heads, fars, starts = (np.empty(groups + k, dtype=np.uint32) for k in (0, 0, 1))
    columns = _place_groups(sweep.heads, sweep.fars, sweep.starts, runs, heads, fars, starts)
    spread = aligned(columns)
    _spread(rest, sweep.heads, sweep.starts, runs, heads, starts, NO_BAR, spread)
    if isinstance(area, np.ndarray):
        values, area = area, aligned(columns)
        _spread(values, sweep.heads, sweep.starts, runs, heads, starts, 0.0, area)
    close = (fars - heads) < APART
    parts = np.searchsorted(runs, sweep.chunks[sweep.parts]).astype(np.int64)
    return Columns(heads, fars, starts, runs, close, spread, area, np.zeros((rows, columns)), counted, parts)


@kernel
def _group_runs(heads, fars, starts, fresh, group_of):
    """Return the number of groups of runs; write the group of each run."""
    groups = 0
    first = 0  # run that begins the group
    bars = 0
    for run in range(len(heads)):
        count = np.int64(starts[run + 1]) - np.int64(starts[run])
        head, before = np.int64(heads[run]), np.int64(heads[run - 1]) if run else np.int64(-1)
        alike = run > 0 and not fresh[run] and np.int64(fars[run]) - head == np.int64(fars[run - 1]) - before
        alike = alike and head > before
        span = head + count - np.int64(heads[first]) // LANES * LANES
        if not alike or span > CHUNK or span > _MOST * (bars + count) + LANES:
            groups += 1
            first = run
            bars = 0
        bars += count
        group_of[run] = groups - 1
    return groups


@kernel
def _place_groups(run_heads, run_fars, run_starts, runs, heads, fars, starts):
    """Return the number of columns; write the first column of each group, and its ends."""
    count = np.int64(0)
    for g in range(len(heads)):
        first, last = runs[g], runs[g + 1] - 1
        lead = np.int64(run_heads[first]) % LANES
        wide = np.int64(run_heads[last]) + np.int64(run_starts[last + 1]) - np.int64(run_starts[last])
        wide -= np.int64(run_heads[first]) - lead
        heads[g] = np.int64(run_heads[first]) - lead
        fars[g] = np.int64(run_fars[first]) - lead
        starts[g] = count
        count += -(-wide // LANES) * LANES
    starts[len(heads)] = count
    return count


@kernel
def _spread(values, run_heads, run_starts, runs, heads, starts, none, spread):
    """Write the values of bars to their columns, and ``none`` to the others."""
    for k in range(len(spread)):
        spread[k] = none
    for g in range(len(heads)):
        for run in range(runs[g], runs[g + 1]):
            at = starts[g] + run_heads[run] - heads[g]
            begin = run_starts[run]
            for k in range(run_starts[run + 1] - begin):
                spread[at + k] = values[begin + k]


@kernel
def spread_history(sweep, columns, history):
    """Write the ``history`` (rows, b) of the bars of a sweep to ``columns.kept``, which loops over columns update."""
    kept, wide, from_wide = columns.kept.reshape(-1), columns.kept.shape[1], history.shape[1]
    values = history.reshape(-1)
    for group in range(len(columns.heads) if len(history) > 0 else 0):
        for run in range(columns.runs[group], columns.runs[group + 1]):
            begin, count = sweep.starts[run], sweep.starts[run + 1] - sweep.starts[run]
            at = columns.starts[group] + sweep.heads[run] - columns.heads[group]
            for j in range(len(history)):
                copy_run(values, j * from_wide + begin, kept, j * wide + at, count)


@kernel
def gather_history(sweep, columns, history):
    """Write ``columns.kept`` back to the ``history`` (rows, b) of the bars of a sweep."""
    kept, wide, to_wide = columns.kept.reshape(-1), columns.kept.shape[1], history.shape[1]
    values = history.reshape(-1)
    for group in range(len(columns.heads) if len(history) > 0 else 0):
        for run in range(columns.runs[group], columns.runs[group + 1]):
            begin, count = sweep.starts[run], sweep.starts[run + 1] - sweep.starts[run]
            at = columns.starts[group] + sweep.heads[run] - columns.heads[group]
            for j in range(len(history)):
                copy_run(kept, j * wide + at, values, j * to_wide + begin, count)

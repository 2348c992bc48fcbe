"""Runs of bars whose ends are known from the first one, by blocks of nodes: as they are, and padded to long rows for
loops over components of positions and forces.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..mesh.ordering import FEW, LEAST_RUN, NODE_BLOCK
from .compiled import borrowing, borrowing_apart, inlined, kernel
from .tuples import CHUNK, ROW

_LINE = LANES = 8  # numbers in a line of the cache, and of a vector


PAGE = 512
"""Numbers in a page of memory. Loads wait for earlier stores to other arrays whose addresses end with the bits of a
place in a page. What a loop over padded runs reads and writes at the same time therefore begins at different thirds:
positions and other vectors, a workspace, and sums of forces."""

_VECTORS, _WORKSPACE, _SUMS = 0, 168, 336


def aligned(count: int, place: int | None = None) -> np.ndarray:
    """Return ``count`` zeros, aligned to lines of the cache, or that begin at a ``place`` in a page."""
    wide = _LINE if place is None else PAGE
    room = np.zeros(count + wide)
    first = ((place or 0) - room.ctypes.data // room.itemsize) % wide
    return room[first : first + count]


def new_planes(nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return planes (3 stride,) for positions and forces of ``nodes`` nodes, and for columns without a bar beyond
    them."""
    stride = -(-nodes // _LINE) * _LINE + 2 * _LINE if nodes else 0
    return aligned(3 * stride, _VECTORS), aligned(3 * stride, _SUMS)


@inlined
def new_rows(count):
    """Return ``count`` rows of a workspace in one array, which begins at its place in a page; not initialised."""
    room = np.empty(count * ROW + PAGE)
    return room[(_WORKSPACE - room.ctypes.data // 8) % PAGE :]


@borrowing
def copy(values, out):
    """Write the first numbers of ``values`` to all of ``out``."""
    for i in range(len(out)):
        out[i] = values[i]


@borrowing
def fill(out, value):
    """Write a value to all of ``out``."""
    for i in range(len(out)):
        out[i] = value


@borrowing
def split_components(x, first, count, planes, stride, base):
    """Write the vectors of ``count`` nodes of ``x`` (n, 3), from ``first`` on, to ``planes`` (3 stride,), which begin
    at node ``base``."""
    nodes = x[first : first + count].reshape(-1)
    at = first - base
    xs, ys, zs = planes[at:], planes[at + stride :], planes[at + 2 * stride :]
    for i in range(count):
        xs[i] = nodes[3 * i]
        ys[i] = nodes[3 * i + 1]
        zs[i] = nodes[3 * i + 2]


@borrowing
def join_components(planes, base, first, f):
    """Write the vectors of nodes from ``first`` on in ``planes`` (3 stride,), which begin at node ``base``, to ``f``
    (n, 3)."""
    stride = len(planes) // 3
    at = first - base
    xs, ys, zs = planes[at:], planes[at + stride :], planes[at + 2 * stride :]
    nodes = f.reshape(-1)
    for i in range(len(f)):
        nodes[3 * i] = xs[i]
        nodes[3 * i + 1] = ys[i]
        nodes[3 * i + 2] = zs[i]


@borrowing
def slide_planes(planes, shift, count):
    """Move ``count`` nodes of ``planes`` (3 stride,) from ``shift`` on to the beginning."""
    stride = len(planes) // 3
    for c in range(3):
        one, other = planes[c * stride : c * stride + count], planes[c * stride + shift :]
        for i in range(len(one)):
            one[i] = other[i]


@borrowing
def clear_lower_ends(work):
    """Set the first three rows of a workspace to zero."""
    for i in range(3 * ROW):
        work[i] = 0.0


@borrowing
def add_lower_ends(work, count, pulls, first):
    """Add the first three rows of a workspace to components ``pulls`` (3 stride,) of ``count`` nodes from ``first``
    on."""
    stride = len(pulls) // 3
    for c in range(3):
        sums, row = pulls[c * stride + first : c * stride + first + count], work[c * ROW :]
        for i in range(len(sums)):
            sums[i] += row[i]


class Sweep(NamedTuple):
    """Runs and chunks of the bars [start, stop) of a block. Indices are unsigned, so compiled loops need not handle
    negative ones.

    Attributes
    ----------
    heads : (runs,) uint32, lower end of the first bar of each run
    fars : (runs,) uint32, its upper end
    starts : (runs + 1,) uint32, first bar of each run, and the end
    chunks : (chunks + 1,) uint32, first run of each chunk, and the end
    diagonal : (chunks,) bool, whether the runs of a chunk are diagonal, else stars
    counted : number of leading chunks whose bars are counted on this rank
    parts : (parts + 1,) int64, first chunk of each part, and the end: the counted bars by their lower ends, part k with
        those of the nodes [k, k + 1) times :data:`~pfem_petsc.mesh.ordering.NODE_BLOCK`
    """

    heads: np.ndarray
    fars: np.ndarray
    starts: np.ndarray
    chunks: np.ndarray
    diagonal: np.ndarray
    counted: int
    parts: np.ndarray


def make_sweep(bars: np.ndarray, start: int, counted: int, stop: int, chunk: int = CHUNK) -> Sweep:
    """Make the sweep over ``bars`` (b, 2) [start, stop), of which [start, counted) are counted.

    Chunks end after ``chunk`` bars, at ``counted``, and where the lower end passes to another block of nodes.
    """
    firsts = np.empty(_cut(bars, start, counted, stop, chunk, np.empty(0, dtype=np.uint32)) + 1, dtype=np.uint32)
    _cut(bars, start, counted, stop, chunk, firsts)
    firsts[-1] = stop
    diagonal = np.empty(len(firsts) - 1, dtype=np.bool_)
    chunks = np.empty(len(firsts), dtype=np.uint32)
    none = (np.empty(0, dtype=np.uint32),) * 3
    runs = _find_runs(bars, firsts, False, diagonal, chunks, none)
    short = np.diff(firsts.astype(np.int64))[~diagonal].sum()
    forced = bool(0 < short <= FEW * (stop - start))
    if forced:  # few bars: the others have faster loops if all chunks are alike
        diagonal[:] = True
        runs = _find_runs(bars, firsts, True, diagonal, chunks, none)
    heads, fars, starts = (np.empty(n, dtype=np.uint32) for n in (runs, runs, runs + 1))
    _find_runs(bars, firsts, forced, diagonal, chunks, (heads, fars, starts))
    starts[runs] = stop
    chunks_counted = int(np.searchsorted(firsts[:-1], counted))
    lower = bars[firsts[:chunks_counted]].min(axis=1) // NODE_BLOCK
    parts = np.searchsorted(lower, np.arange((int(lower[-1]) if len(lower) else -1) + 2))
    return Sweep(heads, fars, starts, chunks, diagonal, chunks_counted, parts.astype(np.int64))


@kernel
def _cut(bars, start, counted, stop, chunk, firsts):
    """Return the number of chunks; write their first bars unless ``firsts`` is empty."""
    count = 0
    first = start
    block = -1
    for k in range(start, stop):
        here = min(bars[k, 0], bars[k, 1]) // NODE_BLOCK
        if k in (start, counted) or here != block or k - first == chunk:
            if len(firsts) > 0:
                firsts[count] = k
            count += 1
            first = k
            block = here
    return count


@kernel
def _find_runs(bars, firsts, forced, diagonal, chunks, runs):
    """Return the number of runs; write chunks, the first run of each, and the ``runs`` (heads, fars and starts) unless
    they are empty, and which chunks are ``diagonal``, unless ``forced``."""
    heads, fars, starts = runs
    count = 0
    for c in range(len(firsts) - 1):
        chunks[c] = count
        breaks = 1
        for k in range(firsts[c] + 1, firsts[c + 1]):
            breaks += 0 if _follows(bars, k) else 1
        if not forced:
            diagonal[c] = firsts[c + 1] - firsts[c] >= LEAST_RUN * breaks
        for k in range(firsts[c], firsts[c + 1]):
            low = min(bars[k, 0], bars[k, 1])
            if k > firsts[c]:
                if diagonal[c]:
                    if _follows(bars, k):
                        continue
                elif low == min(bars[k - 1, 0], bars[k - 1, 1]):
                    continue
            if len(heads) > 0:
                heads[count] = low
                fars[count] = max(bars[k, 0], bars[k, 1])
                starts[count] = k
            count += 1
    chunks[len(firsts) - 1] = count
    return count


@kernel
def _follows(bars, k):
    """Whether both ends of bar k are the nodes after those of bar k - 1."""
    low = min(bars[k, 0], bars[k, 1]) == min(bars[k - 1, 0], bars[k - 1, 1]) + 1
    return low and max(bars[k, 0], bars[k, 1]) == max(bars[k - 1, 0], bars[k - 1, 1]) + 1


@borrowing_apart
def end_differences(x, sweep, ends, chunk, work):
    """Write the end differences of a chunk of bars at positions ``x`` (n, 3) to the first three rows of a workspace,
    from the lower one of the ``ends`` (b, 2) to the upper one."""
    heads, fars, starts = sweep.heads, sweep.fars, sweep.starts
    first = np.int64(starts[sweep.chunks[chunk]])
    places = x.reshape(-1)
    if sweep.diagonal[chunk]:
        for run in range(sweep.chunks[chunk], sweep.chunks[chunk + 1]):
            at = np.int64(starts[run])
            xs, ys, zs = work[at - first :], work[ROW + at - first :], work[2 * ROW + at - first :]
            low, high = places[3 * np.int64(heads[run]) :], places[3 * np.int64(fars[run]) :]
            for i in range(np.int64(starts[run + 1]) - at):
                xs[i] = high[3 * i] - low[3 * i]
                ys[i] = high[3 * i + 1] - low[3 * i + 1]
                zs[i] = high[3 * i + 2] - low[3 * i + 2]
        return
    xs, ys, zs = work[:ROW], work[ROW : 2 * ROW], work[2 * ROW : 3 * ROW]
    for i in range(np.int64(starts[sweep.chunks[chunk + 1]]) - first):
        one, other = np.int64(ends[first + i, 0]), np.int64(ends[first + i, 1])
        a, b = 3 * min(one, other), 3 * max(one, other)
        # unsigned: negative indices need not be handled
        xs[i] = places[np.uint64(b)] - places[np.uint64(a)]
        ys[i] = places[np.uint64(b + 1)] - places[np.uint64(a + 1)]
        zs[i] = places[np.uint64(b + 2)] - places[np.uint64(a + 2)]


@borrowing_apart
def scatter_forces(f, sweep, far, chunk, work, pulls):
    """Subtract the forces of a chunk of bars from their lower ends in ``f`` (n, 3), and add them to the upper ones:
    the first three rows of a workspace times the fourth one. ``pulls``: room for vectors (3 CHUNK,)."""
    heads, fars, starts = sweep.heads, sweep.fars, sweep.starts
    first = np.int64(starts[sweep.chunks[chunk]])
    xs, ys, zs = work[:ROW], work[ROW : 2 * ROW], work[2 * ROW : 3 * ROW]
    cs = work[3 * ROW : 4 * ROW]
    for i in range(np.int64(starts[sweep.chunks[chunk + 1]]) - first):
        pulls[3 * i] = cs[i] * xs[i]
        pulls[3 * i + 1] = cs[i] * ys[i]
        pulls[3 * i + 2] = cs[i] * zs[i]
    forces = f.reshape(-1)
    if sweep.diagonal[chunk]:
        for run in range(sweep.chunks[chunk], sweep.chunks[chunk + 1]):
            of_run = pulls[3 * (np.int64(starts[run]) - first) : 3 * (np.int64(starts[run + 1]) - first)]
            low, high = forces[3 * np.int64(heads[run]) :], forces[3 * np.int64(fars[run]) :]
            for i in range(len(of_run)):
                low[i] -= of_run[i]
            for i in range(len(of_run)):
                high[i] += of_run[i]
        return
    for run in range(sweep.chunks[chunk], sweep.chunks[chunk + 1]):
        fx = 0.0
        fy = 0.0
        fz = 0.0
        for k in range(starts[run], starts[run + 1]):
            b = 3 * np.int64(far[k])
            at = 3 * (k - first)
            gx, gy, gz = pulls[at], pulls[at + 1], pulls[at + 2]
            fx += gx
            fy += gy
            fz += gz
            # unsigned: negative indices need not be handled
            forces[np.uint64(b)] += gx
            forces[np.uint64(b + 1)] += gy
            forces[np.uint64(b + 2)] += gz
        a = 3 * np.int64(heads[run])
        forces[np.uint64(a)] -= fx
        forces[np.uint64(a + 1)] -= fy
        forces[np.uint64(a + 2)] -= fz


NO_BAR = -1.0
"""Rest length of a column without a bar [m]."""

_MOST = 1.25  # columns for each bar; beyond, they cost more than the begin and end of each run


class Groups(NamedTuple):
    """Groups of the runs of a sweep, of one offset and one block of nodes each.

    Attributes
    ----------
    heads, fars : (groups,) uint32, ends of the first column of each group
    starts : (groups + 1,) uint32, first column of each group, and the end
    runs : (groups + 1,) uint32, first run of the sweep in each group, and the end
    """

    heads: np.ndarray
    fars: np.ndarray
    starts: np.ndarray
    runs: np.ndarray


def make_groups(sweep: Sweep) -> Groups:
    """Make the groups of a sweep of diagonal chunks."""
    n = len(sweep.heads)
    firsts = np.append(sweep.chunks[sweep.parts].astype(np.int64), n)  # runs that begin a part, or are not counted
    fresh = np.zeros(n + 1, dtype=np.bool_)
    fresh[firsts] = True
    group_of = np.empty(n, dtype=np.int64)
    count = _group_runs(sweep.heads, sweep.fars, sweep.starts, fresh, group_of)
    runs = np.searchsorted(group_of, np.arange(count + 1)).astype(np.uint32)
    heads, fars, starts = (np.empty(count + k, dtype=np.uint32) for k in (0, 0, 1))
    _place_groups(sweep.heads, sweep.fars, sweep.starts, runs, heads, fars, starts)
    return Groups(heads, fars, starts, runs)


class Columns(NamedTuple):
    """Columns of all bars of a sweep, in :class:`Groups`.

    Attributes
    ----------
    heads, fars, starts, runs : of the groups
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
        empty,
        area,
        np.empty((rows, 0)),
        0,
        np.empty(0, dtype=np.int64),
    )


def make_columns(sweep: Sweep, rest: np.ndarray, area: float | np.ndarray, rows: int) -> Columns:
    """Make the columns of a sweep of diagonal chunks over b bars, with room for ``rows`` of a history; ``rest`` (b,)
    [m], ``area`` [m2] a number or (b,)."""
    groups = make_groups(sweep)
    counted = int(np.searchsorted(groups.runs, sweep.chunks[sweep.counted]))
    columns = int(groups.starts[-1])
    spread = aligned(columns)
    spread_values(rest, sweep, groups, NO_BAR, spread)
    if isinstance(area, np.ndarray):
        values, area = area, aligned(columns)
        spread_values(values, sweep, groups, 0.0, area)
    parts = np.searchsorted(groups.runs, sweep.chunks[sweep.parts]).astype(np.int64)
    return Columns(*groups, spread, area, np.zeros((rows, columns)), counted, parts)


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
    """Write the first column of each group, and its ends."""
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


@kernel
def spread_values(values, sweep, groups, none, spread):
    """Write the values of the bars of a sweep to their columns, and ``none`` to the others."""
    runs, heads, starts = groups.runs, groups.heads, groups.starts
    for g in range(len(heads)):
        end = starts[g]
        for run in range(runs[g], runs[g + 1]):
            at = starts[g] + sweep.heads[run] - heads[g]
            begin, count = sweep.starts[run] - sweep.starts[0], sweep.starts[run + 1] - sweep.starts[run]
            fill(spread[end:at], none)
            end = at + count
            copy(values[begin : begin + count], spread[at:end])
        fill(spread[end : starts[g + 1]], none)


@kernel
def exchange_history(sweep, columns, history, back):
    """Write the ``history`` (rows, b) of the bars of a sweep to ``columns.kept``, which loops over padded runs update,
    or ``back``."""
    for group in range(len(columns.heads) if len(history) > 0 else 0):
        for run in range(columns.runs[group], columns.runs[group + 1]):
            begin, count = sweep.starts[run] - sweep.starts[0], sweep.starts[run + 1] - sweep.starts[run]
            at = columns.starts[group] + sweep.heads[run] - columns.heads[group]
            for j in range(len(history)):
                if back:
                    copy(columns.kept[j][at : at + count], history[j][begin : begin + count])
                else:
                    copy(history[j][begin : begin + count], columns.kept[j][at : at + count])

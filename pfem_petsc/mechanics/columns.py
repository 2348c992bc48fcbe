"""The order of loops over bars: runs of bars whose ends are known from the first one, by blocks and by components."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from ..mesh.ordering import FEW, LEAST_RUN, NODE_BLOCK
from .compiled import borrowing, kernel
from .rows import CHUNK, known_ends
from .strips import APART, LANES, Arguments, Strip, for_strips, separate, weave

_AXES = range(3)
_LINE = 8  # numbers in a line of the cache


def aligned(count: int) -> np.ndarray:
    """Return ``count`` zeros, aligned to lines of the cache."""
    room = np.zeros(count + _LINE)
    first = -(room.ctypes.data // room.itemsize) % _LINE
    return room[first : first + count]


def new_planes(nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return planes (3 stride,) for positions and forces of ``nodes`` nodes, and for columns without a bar beyond them;
    aligned to lines of the cache."""
    stride = -(-nodes // _LINE) * _LINE + 2 * _LINE if nodes else 0
    return aligned(3 * stride), aligned(3 * stride)


@intrinsic
def address(typingctx, values, index):  # noqa: ANN001, ANN201
    """Return the address of ``values[index]``."""

    def generate(context, builder, signature, arguments):  # noqa: ANN001, ANN202
        given = Arguments(context, builder, signature, arguments)
        return builder.ptrtoint(given.numbers(0, given.index(1)), ir.IntType(64))

    return types.int64(values, index), generate


@intrinsic
def number_at(typingctx, place, index):  # noqa: ANN001, ANN201
    """Return number ``index`` behind the address ``place``; see :func:`difference_of_ends`."""

    def generate(context, builder, signature, arguments):  # noqa: ANN001, ANN202
        given = Arguments(context, builder, signature, arguments)
        pointer = builder.inttoptr(arguments[0], ir.DoubleType().as_pointer())
        load = builder.load(builder.gep(pointer, [given.index(1)]))
        load.set_metadata("alias.scope", known_ends(builder))
        return load

    return types.float64(place, index), generate


@intrinsic
def difference_of_ends(typingctx, low, high, stride, bar):  # noqa: ANN001, ANN201
    """Return the end difference (dx, dy, dz) of a bar: that of the numbers ``bar`` behind the addresses ``high`` and
    ``low``, of planes with ``stride`` numbers.

    Compilers assume that :func:`~pfem_petsc.mechanics.rows.put_apart` does not change these numbers.
    """

    def generate(context, builder, signature, arguments):  # noqa: ANN001, ANN202
        given = Arguments(context, builder, signature, arguments)
        kind, known, found = ir.DoubleType().as_pointer(), known_ends(builder), []
        for c in _AXES:
            at = builder.add(given.index(3), builder.mul(given.index(2), ir.Constant(ir.IntType(64), c)))
            loads = [builder.load(builder.gep(builder.inttoptr(arguments[k], kind), [at])) for k in (0, 1)]
            for load in loads:
                load.set_metadata("alias.scope", known)
            found.append(builder.fsub(loads[1], loads[0]))
        return context.make_tuple(builder, signature.return_type, found)

    return types.UniTuple(types.float64, 3)(low, high, stride, bar), generate


def _change_planes(sign: str) -> Any:
    """Make the intrinsic that adds the first three rows of a workspace to planes, or subtracts them."""

    @intrinsic
    def change(typingctx, f, stride, node, count, work, first):  # noqa: ANN001, ANN202
        def generate(context, builder, signature, values):  # noqa: ANN001, ANN202
            given = Arguments(context, builder, signature, values)
            combine = getattr(builder, sign)
            ends = [given.plane(0, given.index(2), given.index(1), c) for c in _AXES]
            rows = [given.row(4, given.index(5), c) for c in _AXES]

            def body(at: Any, strip: Strip) -> None:
                for end, row in zip(ends, rows, strict=True):
                    strip.store(combine(strip.load(end, at), strip.load(row, at)), end, at)

            for_strips(builder, given.index(3), body, ends[0])
            return context.get_dummy_value()

        return types.void(f, stride, node, count, work, first), generate

    return change


add_rows, subtract_rows = _change_planes("fadd"), _change_planes("fsub")


@intrinsic
def copy_run(typingctx, values, first, copy, at, count):  # noqa: ANN001, ANN201
    """Write ``count`` numbers of ``values`` (n,) from ``first`` on to ``copy`` (m,) from ``at`` on."""

    def generate(context, builder, signature, arguments):  # noqa: ANN001, ANN202
        given = Arguments(context, builder, signature, arguments)
        source, target = given.numbers(0, given.index(1)), given.numbers(2, given.index(3))
        for_strips(builder, given.index(4), lambda place, strip: strip.store(strip.load(source, place), target, place))
        return context.get_dummy_value()

    return types.void(values, first, copy, at, count), generate


@intrinsic
def split_planes(typingctx, x, first, count, planes, stride, base):  # noqa: ANN001, ANN201
    """Write the vectors of ``count`` nodes of ``x`` (n, 3), from ``first`` on, to ``planes`` (3 stride,), which begin
    at node ``base``."""

    def generate(context, builder, signature, values):  # noqa: ANN001, ANN202
        given = Arguments(context, builder, signature, values)
        first = given.index(1)
        nodes = given.numbers(0, first, 3)
        ends = [given.plane(3, builder.sub(first, given.index(5)), given.index(4), c) for c in _AXES]

        def body(at: Any, strip: Strip) -> None:
            for end, component in zip(ends, separate(builder, strip.load_nodes(nodes, at)), strict=True):
                strip.store(component, end, at)

        for_strips(builder, given.index(2), body)
        return context.get_dummy_value()

    return types.void(x, first, count, planes, stride, base), generate


@intrinsic
def join_planes(typingctx, planes, stride, base, first, count, f, row):  # noqa: ANN001, ANN201
    """Write the vectors of ``count`` nodes from ``first`` on in ``planes`` (3 stride,), which begin at node ``base``,
    to ``f`` (n, 3), from ``row`` on."""

    def generate(context, builder, signature, values):  # noqa: ANN001, ANN202
        given = Arguments(context, builder, signature, values)
        first = given.index(3)
        ends = [given.plane(0, builder.sub(first, given.index(2)), given.index(1), c) for c in _AXES]
        nodes = given.numbers(5, given.index(6), 3)

        def body(at: Any, strip: Strip) -> None:
            strip.store_nodes(weave(builder, [strip.load(end, at) for end in ends]), nodes, at)

        for_strips(builder, given.index(4), body)
        return context.get_dummy_value()

    return types.void(planes, stride, base, first, count, f, row), generate


@borrowing
def slide_planes(planes, shift, count):
    """Move ``count`` nodes of ``planes`` (3 stride,) from ``shift`` on to the beginning."""
    stride = len(planes) // 3
    for c in range(3):
        one, other = planes[c * stride : c * stride + count], planes[c * stride + shift :]
        for i in range(len(one)):
            one[i] = other[i]


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
    none = np.empty(0, dtype=np.uint32)
    runs = _find_runs(bars, firsts, False, diagonal, chunks, none, none, none)
    short = np.diff(firsts.astype(np.int64))[~diagonal].sum()
    forced = bool(0 < short <= FEW * (stop - start))
    if forced:  # few bars: the others have faster loops if all chunks are alike
        diagonal[:] = True
        runs = _find_runs(bars, firsts, True, diagonal, chunks, none, none, none)
    heads, fars, starts = (np.empty(n, dtype=np.uint32) for n in (runs, runs, runs + 1))
    _find_runs(bars, firsts, forced, diagonal, chunks, heads, fars, starts)
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
def _find_runs(bars, firsts, forced, diagonal, chunks, heads, fars, starts):
    """Return the number of runs; write chunks, the first run of each, and the runs unless ``heads`` is empty, and which
    chunks are ``diagonal``, unless ``forced``."""
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

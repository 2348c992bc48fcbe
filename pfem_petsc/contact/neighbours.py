"""Pairs of line segments that are close to each other, among segments of all ranks.

Segments, or pieces of long ones, are sorted by the cells of their middles. Cells are as wide as two of them can be
apart and still be close: then they are in the same cell or in neighbouring ones. Two planes of cells at a time are
sorted and compared, by vectors of boxes in single precision, so that there are few temporary arrays. On several ranks,
each has the cells that a hash assigns to it. Points are segments whose ends coincide.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from mpi4py import MPI

from ..mechanics.compiled import inlined, kernel
from ..mesh.exchange import Router

# Limits for each segment: pieces, and comparisons.
_PIECES, _COMPARISONS = 8.0, 2000.0

# Cells of 8 x 8 x 8 belong to one rank, so that most segments are sent to one or two.
_BLOCK = 8

_CELLS = (1 << 21) - 2  # along an axis; those beyond belong to the last one
_ROOM = 1 << 12  # pairs for which there is room at first
_LANES = 32  # boxes compared at once, at most
# In single precision and cells: rounding, a half, and a product of lengths below which squares vanish.
_SLACK, _HALF, _TINY = np.float32(1e-3), np.float32(0.5), np.float32(1e-15)
_DIGIT = 11  # bits by which cells are sorted at once


# The places of the bits of a byte that are 1, lowest first, and their number.
_PLACES = np.array([([k for k in range(8) if byte >> k & 1] + 8 * [0])[:8] for byte in range(256)], np.int32)
_NUMBERS = np.array([byte.bit_count() for byte in range(256)], np.int32)


class Points(NamedTuple):
    """Ends of segments: positions ``at`` (p, 3) [m]; ``names`` (p,), the same on all ranks: segments that share one are
    no pair; positions ``before`` (p, 3) [m], if any: what was a pair there is none."""

    at: np.ndarray
    names: np.ndarray
    before: np.ndarray = np.empty((0, 3))


class Segments(NamedTuple):
    """Segments of a rank: numbers ``ids`` (n,), unique on all ranks; their end ``points`` (n, 2) int32, rows of
    :class:`Points`; ``margin`` (n,) [m]: pairs are closer than the sum of theirs; ``kind`` (n,) uint8, or (0,): two of
    one kind are no pair, unless it is 0."""

    ids: np.ndarray
    points: np.ndarray
    margin: np.ndarray
    kind: np.ndarray = np.empty(0, np.uint8)


class Pairs(NamedTuple):
    """Pairs that a rank has found, each on one rank.

    ``ids`` (m, 2), that with the lower kind and number first; ``names`` of their ends (m, 2, 2); where they are closest
    to each other, ``at`` (m, 2), from 0 at the first end of each to 1 at the second; and the ``gap``, the smallest
    difference [m] between a distance and the sum of the margins on all ranks, up to the skin, also of what is no pair
    because of positions before.
    """

    ids: np.ndarray
    names: np.ndarray
    at: np.ndarray
    gap: float


class _Grid(NamedTuple):
    """Cells: their lowest corner (3,) [m], inverse edges (3,) [1/m] and numbers (3,) int64 along x, y and z; the axis
    across planes, that across rows, that along rows; how far pieces reach from their middles (3,) [m], the unit of
    single-precision numbers [m], the longest piece of a segment [m], the skin [m]; and the number of ranks, and this
    one."""

    low: np.ndarray
    inverse: np.ndarray
    count: np.ndarray
    axes: tuple[int, int, int]
    extents: np.ndarray
    unit: float
    longest: float
    skin: float
    ranks: tuple[int, int]


def find_pairs(comm: MPI.Comm, points: Points, own: Segments, skin: float = 0.0, factor: float = 1.0) -> Pairs | None:
    """Find the pairs of segments that are closer than the sum of their margins, on any rank. Collective.

    Parameters
    ----------
    comm : MPI.Comm
    points : Points
        Coordinates must be finite, and their squares too.
    own : Segments of this rank
    skin : float
        Distance beyond the margins to which :attr:`Pairs.gap` is found, over the mean length with margins.
    factor : float
        Of the margins, for the positions before.

    Returns
    -------
    Pairs, or None on all ranks if the search would take too long, because too many segments are in one place
    """
    number = comm.allreduce(len(own.ids))
    box, extents, sums = _measure(comm, points.at, own, np.inf, 0.0)
    mean = float(sums[1]) / max(float(sums[0]), 1.0)
    skin, longest, pieces = skin * mean, 2.0 * mean or 1.0, 0.0
    while number:
        box, extents, sums = _measure(comm, points.at, own, longest, skin)
        before, pieces = pieces, float(sums[2])
        if pieces == before or pieces > _PIECES * number:  # shorter pieces are no better, or too many
            return None
        grid = _make_grid(comm, *box, extents, longest, skin)
        held = (points, own) if comm.size == 1 else _hold(comm, grid, points, own)
        found, comparisons = _compare(grid, *held, factor, _COMPARISONS * number)
        if comm.allreduce(comparisons) <= _COMPARISONS * number:
            return found._replace(gap=comm.allreduce(min(found.gap, skin), op=MPI.MIN))
        longest *= 0.5
    return Pairs(np.empty((0, 2), np.int64), np.empty((0, 2, 2), np.int64), np.empty((0, 2)), np.inf)


class Regions(NamedTuple):
    """Cells of space, by which nodes near each other are compared: of each owned node ``of`` (n,); their numbers along
    the axes ``count`` (3,), and their width [m]."""

    of: np.ndarray
    count: np.ndarray
    width: float


_REGIONS = 24  # along an axis, at most


def make_regions(comm: MPI.Comm, x: np.ndarray, width: float) -> Regions:
    """Return cells of at least a width [m] around owned nodes at ``x`` (n, 3). Collective."""
    ends = np.stack([x.max(axis=0, initial=-np.inf), -x.min(axis=0, initial=np.inf)])
    comm.Allreduce(MPI.IN_PLACE, ends, op=MPI.MAX)
    width = max(width, float((ends[0] + ends[1]).max()) / _REGIONS)
    count = ((ends[0] + ends[1]) / width).astype(np.int64) + 1
    at = np.minimum(((x + ends[1]) / width).astype(np.int64), count - 1)
    return Regions((at[:, 0] * count[1] + at[:, 1]) * count[2] + at[:, 2], count, width)


def largest_change(
    comm: MPI.Comm,
    motion: tuple[np.ndarray, np.ndarray],
    n_nodes: int,
    reach: float,
    near: tuple[Regions, float] | None = None,
) -> float:
    """Return by how much distances up to ``reach`` between any bars may have changed [m]; infinite for positions that
    are not finite. Collective.

    An affine map, the fit of all displacements, takes nodes to within r of where they are. With its singular values s,
    a distance d has become one between s_min d - 2 r and s_max d + 2 r: a body that spins has not changed. Instead of
    2 r, bars whose ends are in neighbouring regions have what these differ in at most from the map, as long as others
    are too far from each other to come near.

    Parameters
    ----------
    motion : positions (owned, 3) before and now [m]
    n_nodes : of all ranks
    near : regions of the positions before, and the length of the longest bar [m]
    """
    start, now = (np.asarray(x) for x in motion)
    sums = comm.allreduce(_sum_motion(start, now)) / n_nodes
    moments = comm.allreduce(_moments(start, now, sums))
    if not np.isfinite(moments).all():
        return np.inf
    gradient = np.linalg.pinv(moments[0], rcond=1e-9, hermitian=True) @ moments[1]
    regions, longest = near or (None, 0.0)
    most = np.full((int(np.prod(regions.count)) if near else 0, 6), -np.inf)
    ends = np.full(6, -np.inf)
    _ranges(start, now, sums, gradient, regions.of if near else np.empty(0, np.int64), most, ends)
    comm.Allreduce(MPI.IN_PLACE, ends, op=MPI.MAX)
    square = _farthest(start, now, sums, gradient, 0.5 * (ends[:3] - ends[3:]))
    rest = 2.0 * np.sqrt(comm.allreduce(square, op=MPI.MAX))
    stretch = float(np.abs(np.linalg.svd(np.eye(3) + gradient, compute_uv=False) - 1.0).max())
    if near:
        comm.Allreduce(MPI.IN_PLACE, most, op=MPI.MAX)
        beyond = regions.width - 2.0 * longest
        if rest + stretch * beyond <= beyond - reach:
            rest = min(rest, _largest_range(most.reshape(*regions.count, 6)))
    return rest + stretch * reach


def _largest_range(most: np.ndarray) -> float:
    """Return the largest length of the differences of displacements in neighbouring regions, whose largest ones are
    ``most`` (nx, ny, nz, 6), in positive and in negative directions."""
    for axis in range(3):
        padded = np.pad(most, [(1, 1) if k == axis else (0, 0) for k in range(4)], constant_values=-np.inf)
        n = most.shape[axis]
        most = np.maximum.reduce([padded.take(range(k, k + n), axis=axis) for k in range(3)])
    ways = np.maximum(most[..., :3] + most[..., 3:], 0.0)
    return float(np.sqrt(np.einsum("...i,...i", ways, ways).max(initial=0.0)))


@kernel
def _sum_motion(start, now):
    """Return the sums of positions and displacements (2, 3) of nodes."""
    sums = np.zeros((2, 3))
    for i in range(len(start)):
        for c in range(3):
            sums[0, c] += start[i, c]
            sums[1, c] += now[i, c] - start[i, c]
    return sums


@kernel
def _moments(start, now, means):
    """Return the products of positions with positions and with displacements (2, 3, 3), about their means (2, 3)."""
    moments = np.zeros((2, 3, 3))
    for i in range(len(start)):
        for c in range(3):
            at = start[i, c] - means[0, c]
            for d in range(3):
                moments[0, c, d] += at * (start[i, d] - means[0, d])
                moments[1, c, d] += at * (now[i, d] - start[i, d] - means[1, d])
    return moments


@inlined
def _rest_of(start, now, means, gradient, i, c):
    """Return a component of the displacement of a node beyond an affine map."""
    rest = now[i, c] - start[i, c] - means[1, c]
    for d in range(3):
        rest -= (start[i, d] - means[0, d]) * gradient[d, c]
    return rest


@kernel
def _ranges(start, now, means, gradient, regions, most, ends):
    """Write the largest displacements beyond an affine map, in positive and negative directions, of all nodes, ``ends``
    (6,), and of the regions, ``most`` (k, 6)."""
    for i in range(len(start)):
        for c in range(3):
            rest = _rest_of(start, now, means, gradient, i, c)
            ends[c], ends[3 + c] = max(ends[c], rest), max(ends[3 + c], -rest)
            if len(regions) > 0:
                k = regions[i]
                most[k, c], most[k, 3 + c] = max(most[k, c], rest), max(most[k, 3 + c], -rest)


@kernel
def _farthest(start, now, means, gradient, centre):
    """Return the square of the largest distance of displacements beyond an affine map from a ``centre`` (3,)."""
    farthest = 0.0
    for i in range(len(start)):
        square = 0.0
        for c in range(3):
            rest = _rest_of(start, now, means, gradient, i, c) - centre[c]
            square += rest * rest
        farthest = max(farthest, square)
    return farthest


def _measure(
    comm: MPI.Comm, at: np.ndarray, own: Segments, longest: float, skin: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the lowest and highest corner of the box around all segments (2, 3), how far their pieces reach from their
    middles (3,) [m], and sums (3,), see :func:`_measure_segments`. Collective."""
    most, sums = np.empty(9), np.empty(3)
    _measure_segments(at, own, longest, skin, most, sums)
    comm.Allreduce(MPI.IN_PLACE, most, op=MPI.MAX)
    comm.Allreduce(MPI.IN_PLACE, sums, op=MPI.SUM)
    return np.stack([-most[:3], most[3:6]]), most[6:], sums


def _make_grid(
    comm: MPI.Comm, low: np.ndarray, high: np.ndarray, extents: np.ndarray, longest: float, skin: float
) -> _Grid:
    """Return the cells for segments in a box whose pieces reach at most ``extents`` (3,) [m] from their middles."""
    edges = np.maximum(2.0 * extents, 0.25 * extents.max()) * (1.0 + 1e-8)
    count = np.minimum((high - low) / edges, float(_CELLS)).astype(np.int64) + 1
    planes, rows, along = (int(axis) for axis in np.argsort(-count, kind="stable"))
    axes, ranks = (planes, rows, along), (comm.size, comm.rank)
    return _Grid(low, 1.0 / edges, count, axes, extents, float(edges.max()), longest, skin, ranks)


def _hold(comm: MPI.Comm, grid: _Grid, points: Points, own: Segments) -> tuple[Points, Segments]:
    """Send segments to the ranks of their cells and of the neighbouring ones; return those that this rank has then.
    Collective."""
    none, seen = np.empty(0, np.int64), np.full(comm.size, -1, np.int64)
    count = _list_ranks(points.at, own, grid, seen, (none, none))
    ranks, rows = np.empty(count, np.int64), np.empty(count, np.int64)
    seen[:] = -1
    _list_ranks(points.at, own, grid, seen, (ranks, rows))
    router = Router(comm, ranks, rows)
    ends = router.send(points.at[own.points])
    before = router.send(points.before[own.points]) if len(points.before) else points.before
    names = router.send(points.names[own.points])
    kind = router.send(own.kind) if comm.allreduce(len(own.kind)) else own.kind
    at = np.arange(2 * len(ends), dtype=np.int32).reshape(-1, 2)
    return (
        Points(ends.reshape(-1, 3), names.reshape(-1), before.reshape(-1, 3)),
        Segments(router.send(own.ids), at, router.send(own.margin), kind),
    )


class _Planes(NamedTuple):
    """Rows of segments, sorted by planes of cells: ``rows`` (m,) int32 from ``starts`` (planes + 1,) on; their pieces
    ``parts`` (m,) int32, or (0,) if all are whole; ``marks`` (p,) int32 of points, equal where their names are."""

    starts: np.ndarray
    rows: np.ndarray
    parts: np.ndarray
    marks: np.ndarray


class _Work(NamedTuple):
    """Room for two planes of at most m pieces, sorted.

    ``keys`` of cells (3, m) and ``rows`` (3, m), of which the last are for sorting, as are the numbers of ``digits``;
    ``parts``, numbers of pieces (2, m); ``lines`` (2 m, 8): middle, way from end to end, margin and length; ``boxes``
    (2, 6, m + lanes); marks of the ``ends`` (2, 2, m + lanes); which ones are ``near``, as bytes and as ``words`` of
    the same memory; ``hits``, those of both planes, the second after m; ``bounds`` (5, 4) of ranges of cells.
    """

    keys: np.ndarray
    rows: np.ndarray
    parts: np.ndarray
    lines: np.ndarray
    boxes: np.ndarray
    ends: np.ndarray
    digits: np.ndarray
    near: np.ndarray
    words: np.ndarray
    hits: np.ndarray
    bounds: np.ndarray


class _Found(NamedTuple):
    """Room for rows of pairs (m, 2) int32, where they are closest (m, 2), and the gap (1,) [m]."""

    rows: np.ndarray
    at: np.ndarray
    gap: np.ndarray


def _make_work(m: int) -> _Work:
    near = np.empty(2 * (-(-m // 8) * 8 + _LANES), np.uint8)
    return _Work(
        np.empty((3, m), np.int64),
        np.empty((3, m), np.int32),
        np.empty((2, m), np.int32),
        np.empty((2 * m, 8), np.float32),
        np.zeros((2, 6, m + _LANES), np.float32),
        np.zeros((2, 2, m + _LANES), np.int32),
        np.empty((1 << _DIGIT) + 1, np.int64),
        near,
        near.view(np.uint64),
        np.empty(2 * m + 8, np.int32),
        np.empty((5, 4), np.int64),
    )


def _compare(grid: _Grid, points: Points, held: Segments, factor: float, most: float) -> tuple[Pairs, float]:
    """Return the pairs among the segments that are held, and the number of comparisons, which end beyond the most."""
    planes = _make_planes(grid, points, held)
    work = _make_work(int(np.diff(planes.starts).max(initial=1)))
    room, state, gap = _ROOM, np.zeros(3, np.int64), np.full(1, np.inf)
    rows, at = [np.empty((0, 2), np.int32)], [np.empty((0, 2))]
    while state[0] < len(planes.starts) - 1 and state[2] <= most:
        out = _Found(np.empty((room, 2), np.int32), np.empty((room, 2)), gap)
        count = _compare_planes(state, planes, points, held, grid, (factor, most), work, out)
        rows.append(out.rows[:count])
        at.append(out.at[:count])
        room = max(room, int(state[1]))
    found = np.concatenate(rows)
    ids = held.ids[found].astype(np.int64)
    names = points.names[held.points[found]].astype(np.int64)
    return Pairs(ids, names, np.concatenate(at), float(gap[0])), float(state[2])


def _make_planes(grid: _Grid, points: Points, held: Segments) -> _Planes:
    """Return the segments sorted by planes."""
    starts, none = np.zeros(int(grid.count[grid.axes[0]]) + 2, np.int64), np.empty(0, np.int32)
    long = _sort_planes(points.at, held, grid, starts[1:], (none, none))
    np.cumsum(starts, out=starts)
    rows = np.empty(starts[-1], np.int32)
    parts = np.empty(len(rows) if long else 0, np.int32)
    _sort_planes(points.at, held, grid, starts[:-1].copy(), (rows, parts))
    marks = points.names
    if int(marks.max(initial=0)) > np.iinfo(np.int32).max:
        marks = np.unique(marks, return_inverse=True)[1]
    return _Planes(starts[:-1], rows, parts, marks.astype(np.int32))


@inlined
def _pieces(at, segments, n, longest, skin):
    """Return the number of pieces of a segment: not longer than ``longest``, or four times as long as thick."""
    a, b = segments.points[n, 0], segments.points[n, 1]
    x, y, z = at[b, 0] - at[a, 0], at[b, 1] - at[a, 1], at[b, 2] - at[a, 2]
    square, most = x * x + y * y + z * z, max(longest, 4.0 * (segments.margin[n] + 0.5 * skin))
    return 1 if square <= most * most else int(np.sqrt(square) / most) + 1


@kernel
def _measure_segments(at, segments, longest, skin, most, sums):
    """Write the largest coordinates, with both signs, and how far pieces with their margins reach from their middles
    along x, y and z (9,); and the numbers of segments longer than zero, the sum of their lengths with margins, and the
    number of pieces (3,)."""
    x0 = y0 = z0 = x1 = y1 = z1 = -np.inf
    x = y = z = number = total = every = 0.0
    for n in range(len(segments.ids)):
        a, b = segments.points[n, 0], segments.points[n, 1]
        ax, ay, az, bx, by, bz = at[a, 0], at[a, 1], at[a, 2], at[b, 0], at[b, 1], at[b, 2]
        x0, y0, z0 = max(x0, -ax, -bx), max(y0, -ay, -by), max(z0, -az, -bz)
        x1, y1, z1 = max(x1, ax, bx), max(y1, ay, by), max(z1, az, bz)
        square = (bx - ax) ** 2 + (by - ay) ** 2 + (bz - az) ** 2
        number += square > 0.0
        total += np.sqrt(square) + 2.0 * segments.margin[n]
        pieces = _pieces(at, segments, n, longest, skin)
        part, margin = 0.5 / pieces, segments.margin[n] + 0.5 * skin
        x, y, z = (
            max(x, part * abs(bx - ax) + margin),
            max(y, part * abs(by - ay) + margin),
            max(z, part * abs(bz - az) + margin),
        )
        every += pieces
    most[0], most[1], most[2], most[3], most[4], most[5], most[6], most[7], most[8] = x0, y0, z0, x1, y1, z1, x, y, z
    sums[0], sums[1], sums[2] = number, total, every


@inlined
def _cell(at, segments, n, part, pieces, grid, c):
    """Return the number of the cell of the middle of a piece along an axis. It grows with the coordinate, by no more
    than one over the edge of a cell."""
    a, b = segments.points[n, 0], segments.points[n, 1]
    middle = at[a, c] + (part + 0.5) / pieces * (at[b, c] - at[a, c])
    return int(min(max((middle - grid.low[c]) * grid.inverse[c], 0.0), grid.count[c] - 1.0))


@inlined
def _holder(i, j, k, ranks):
    """Return the rank of a cell."""
    key = np.uint64((((i // _BLOCK) << 42) | ((j // _BLOCK) << 21) | (k // _BLOCK)) + 1)
    return np.int64((key * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(33)) % ranks


@kernel
def _list_ranks(at, segments, grid, seen, listed):
    """List the ranks to which each segment goes, and its row; without arrays for the list they are counted. ``seen``
    (ranks,): the last segment that went to each. Returns the length of the list."""
    ranks, rows = listed
    count = 0
    first, last = np.empty(3, np.int64), np.empty(3, np.int64)
    for n in range(len(segments.ids)):
        pieces = _pieces(at, segments, n, grid.longest, grid.skin)
        for part in range(pieces):
            for c in range(3):
                cell = _cell(at, segments, n, part, pieces, grid, c)
                first[c], last[c] = max(cell - 1, 0) // _BLOCK, (cell + 1) // _BLOCK
            for i in range(first[0], last[0] + 1):
                for j in range(first[1], last[1] + 1):
                    for k in range(first[2], last[2] + 1):
                        holder = _holder(i * _BLOCK, j * _BLOCK, k * _BLOCK, grid.ranks[0])
                        if seen[holder] == n:
                            continue
                        seen[holder] = n
                        if len(rows):
                            ranks[count] = holder
                            rows[count] = n
                        count += 1
    return count


@kernel
def _sort_planes(at, segments, grid, starts, listed):
    """Write the rows of segments, and their pieces if some have several, to the places of their planes, ``starts``
    (planes,), which move on; without arrays, they are counted. Returns whether some segments have several pieces."""
    rows, parts = listed
    long = False
    for n in range(len(segments.ids)):
        pieces = _pieces(at, segments, n, grid.longest, grid.skin)
        long |= pieces > 1
        for part in range(pieces):
            plane = _cell(at, segments, n, part, pieces, grid, grid.axes[0])
            if len(rows) == 0:
                starts[plane] += 1
                continue
            rows[starts[plane]] = n
            if len(parts) > 0:
                parts[starts[plane]] = part
            starts[plane] += 1
    return long


@inlined
def _sort(work, which, count, most):
    """Sort ``count`` keys, from 0 to ``most``, and places of a plane, stably."""
    keys, order, other_keys, other_order = work.keys[which], work.rows[which], work.keys[2], work.rows[2]
    places = work.digits
    bits = 0
    while most >> bits:
        bits += 1
    passes = -(-bits // _DIGIT)
    for turn in range(passes):
        width = -(-bits // passes)
        shift, mask = turn * width, (1 << width) - 1
        for digit in range(mask + 2):
            places[digit] = 0
        for i in range(count):
            places[((keys[i] >> shift) & mask) + 1] += 1
        for digit in range(mask + 1):
            places[digit + 1] += places[digit]
        for i in range(count):
            digit = (keys[i] >> shift) & mask
            other_keys[places[digit]] = keys[i]
            other_order[places[digit]] = order[i]
            places[digit] += 1
        for i in range(count):
            keys[i] = other_keys[i]
            order[i] = other_order[i]


@inlined
def _load(plane, planes, points, held, grid, work, which):
    """Sort the pieces of a plane by rows and cells; write their keys, rows, pieces, boxes and the marks of their ends.
    Returns how many."""
    at, rows, parts = points.at, planes.rows, planes.parts
    first, count = planes.starts[plane], planes.starts[plane + 1] - planes.starts[plane]
    keys, places, some = work.keys[which], work.rows[which], work.parts[which]
    boxes, lines, ends = work.boxes, work.lines, work.ends
    wide = grid.count[grid.axes[2]] + 2
    most = np.int64(0)
    for i in range(count):
        n = rows[first + i]
        part = parts[first + i] if len(parts) > 0 else 0
        pieces = _pieces(at, held, n, grid.longest, grid.skin)
        row = _cell(at, held, n, part, pieces, grid, grid.axes[1]) + 1
        keys[i] = row * wide + _cell(at, held, n, part, pieces, grid, grid.axes[2]) + 1
        most = max(most, keys[i])
        places[i] = first + i
    _sort(work, which, count, most)
    for i in range(count):
        place = places[i]
        n = rows[place]
        part = parts[place] if len(parts) > 0 else 0
        pieces = _pieces(at, held, n, grid.longest, grid.skin)
        a, b = held.points[n, 0], held.points[n, 1]
        places[i] = n
        some[i] = part
        ends[which, 0, i], ends[which, 1, i] = planes.marks[a], planes.marks[b]
        slack, at_line = 0.0, which * work.rows.shape[1] + i
        margin = (held.margin[n] + 0.5 * grid.skin) / grid.unit
        square = 0.0
        for c in range(3):
            way = (at[b, c] - at[a, c]) / pieces / grid.unit
            p = (at[a, c] - grid.low[c]) / grid.unit + part * way
            q = p + way
            # in single precision, boxes are rounded outwards
            slack = max(slack, 2e-7 * (max(abs(p), abs(q)) + 1.0))
            boxes[which, c, i] = min(p, q) - margin - slack
            boxes[which, 3 + c, i] = max(p, q) + margin + slack
            lines[at_line, c], lines[at_line, 3 + c] = 0.5 * (p + q), way
            square += way * way
        lines[at_line, 6], lines[at_line, 7] = margin + slack, np.sqrt(square)
    return count


@inlined
def _meet(boxes, ends, which, first, count, box, one, other, near):
    """Write to ``near`` which of the boxes from ``first`` on meet a ``box`` of six numbers and share no end with it."""
    low_x, low_y, low_z = boxes[which, 0, first:], boxes[which, 1, first:], boxes[which, 2, first:]
    high_x, high_y, high_z = boxes[which, 3, first:], boxes[which, 4, first:], boxes[which, 5, first:]
    a, b = ends[which, 0, first:], ends[which, 1, first:]
    for i in range(count):
        meets = (low_x[i] <= box[3]) & (low_y[i] <= box[4]) & (low_z[i] <= box[5])
        meets &= (high_x[i] >= box[0]) & (high_y[i] >= box[1]) & (high_z[i] >= box[2])
        meets &= (a[i] != one) & (a[i] != other) & (b[i] != one) & (b[i] != other)
        near[i] = meets


@inlined
def clip(value):
    """Return a number from 0 to 1; one within may be complex."""
    return 0.0 if value.real < 0.0 else 1.0 if value.real > 1.0 else value


@inlined
def _closest(at, points, a, b):
    """Return the parameters from 0 to 1 of the closest points of segments ``a`` and ``b``.

    Source: Ericson, Real-time collision detection (2005), 5.1.9.
    """
    aa = 0.0
    bb = 0.0
    ab = 0.0
    ar = 0.0
    br = 0.0
    for c in range(3):
        u = at[points[a, 1], c] - at[points[a, 0], c]
        v = at[points[b, 1], c] - at[points[b, 0], c]
        w = at[points[a, 0], c] - at[points[b, 0], c]
        aa += u * u
        bb += v * v
        ab += u * v
        ar += u * w
        br += v * w
    if aa.real <= 0.0:
        return 0.0, clip(br / bb) if bb.real > 0.0 else 0.0
    if bb.real <= 0.0:
        return clip(-ar / aa), 0.0
    across = aa * bb - ab * ab
    s = clip((ab * br - ar * bb) / across) if across.real > 1e-14 * (aa * bb).real else 0.0
    t = (ab * s + br) / bb
    if t.real < 0.0:
        return clip(-ar / aa), 0.0
    if t.real > 1.0:
        return clip((ab - ar) / aa), 1.0
    return s, t


@inlined
def segment_distance(at, points, a, b):
    """Return the distance of segments ``a`` and ``b`` [m], and where they are closest; positions may be complex."""
    s, t = _closest(at, points, a, b)
    square = 0.0
    for c in range(3):
        first = at[points[a, 0], c] + s * (at[points[a, 1], c] - at[points[a, 0], c])
        way = at[points[b, 0], c] + t * (at[points[b, 1], c] - at[points[b, 0], c]) - first
        square += way * way
    return np.sqrt(square), s, t


@inlined
def _compare_lines(lines, this, hits, count, near):
    """Write to ``near`` whether a piece ``this`` may be close to each of ``count`` others, ``hits``; all in ``lines``.

    Otherwise they are certainly apart: along the normal of both, along one of them, or across one of them in the plane
    of both (separating axes). In single precision and without divisions.
    """
    x, y, z = lines[this, 0], lines[this, 1], lines[this, 2]
    ux, uy, uz = lines[this, 3], lines[this, 4], lines[this, 5]
    margin, u = lines[this, 6] + _SLACK, lines[this, 7]
    for k in range(count):
        hit = hits[k]
        wx, wy, wz = lines[hit, 0] - x, lines[hit, 1] - y, lines[hit, 2] - z
        vx, vy, vz = lines[hit, 3], lines[hit, 4], lines[hit, 5]
        reach, v = margin + lines[hit, 6], lines[hit, 7]
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        square = nx * nx + ny * ny + nz * nz
        n = np.sqrt(square)
        uv, uw, vw = ux * vx + uy * vy + uz * vz, ux * wx + uy * wy + uz * wz, vx * wx + vy * wy + vz * wz
        rounding = _SLACK * u * v
        close = abs(nx * wx + ny * wy + nz * wz) <= reach * n + rounding
        close &= abs(uw) <= _HALF * (u * u + abs(uv)) + reach * u
        close &= abs(vw) <= _HALF * (v * v + abs(uv)) + reach * v
        close &= abs(u * u * vw - uv * uw) <= _HALF * square + (reach * n + rounding) * u
        close &= abs(v * v * uw - uv * vw) <= _HALF * square + (reach * n + rounding) * v
        near[k] = close | (u * v < _TINY)


@inlined
def _examine(points, held, grid, factor, one, two, found, out):
    """Return 1 if two pieces, (row, piece) each, are those of a pair, which is written if there is room for it."""
    # rounding must not depend on the order of the segments, which depends on the ranks
    forth = held.ids[one[0]] < held.ids[two[0]]
    if len(held.kind) > 0:
        kind, other = held.kind[one[0]], held.kind[two[0]]
        if kind == other and kind > 0:
            return 0
        forth = forth if kind == other else kind < other
    (i, part_i), (j, part_j) = (one, two) if forth else (two, one)
    if i == j:
        return 0
    reach = held.margin[i] + held.margin[j]
    distance, s, t = segment_distance(points.at, held.points, i, j)
    beyond = distance - reach
    if beyond > grid.skin:
        return 0
    out.gap[0] = min(out.gap[0], abs(beyond))
    if not beyond < 0.0:
        return 0
    pieces = _pieces(points.at, held, i, grid.longest, grid.skin)
    others = _pieces(points.at, held, j, grid.longest, grid.skin)
    if min(int(s * pieces), pieces - 1) != part_i or min(int(t * others), others - 1) != part_j:
        return 0  # of other pieces
    if len(points.before) > 0:
        distance, _, _ = segment_distance(points.before, held.points, i, j)
        if distance < factor * reach:
            return 0
    if found < len(out.rows):
        out.rows[found, 0], out.rows[found, 1] = i, j
        out.at[found, 0], out.at[found, 1] = s, t
    return 1


@inlined
def _find_ranges(work, key, wide, this, here, other, there):
    """Move the ranges of the cells around a cell: behind it in its row, in the next row, and in three rows of the next
    plane; in each row the cell before, beside, and after it, as four bounds."""
    for j in range(5):
        which, most = (this, here) if j < 2 else (other, there)
        middle = key + (j if j < 2 else j - 3) * wide
        for bound in range(4):
            at = work.bounds[j, bound]
            while at < most and work.keys[which, at] < middle - 1 + bound:
                at += 1
            work.bounds[j, bound] = at


@inlined
def _pick(words, count, place, hits, found, places, numbers):
    """Append the places of the bytes that are 1, of ``count`` in ``words``, to those ``found``; return how many."""
    for word in range((count + 7) // 8):
        bits = np.int64((words[word] * np.uint64(0x0102040810204080)) >> np.uint64(56))
        if 8 * word + 8 > count:
            bits &= (1 << (count - 8 * word)) - 1
        for k in range(8):
            hits[found + k] = place + places[bits, k]
        found += numbers[bits]
        place += 8
    return found


@inlined
def _collect(work, i, this, sides):
    """Write the places of pieces that are not certainly apart from a piece ``i`` of ``this`` plane to ``work.hits``;
    return how many. ``sides``: whether it reaches the next plane, the row before and after, the cell before and after.
    Without branches that depend on single boxes, which cost more than the comparisons."""
    boxes, hits, near, width = work.boxes, work.hits, work.near, work.rows.shape[1]
    box = (
        boxes[this, 0, i],
        boxes[this, 1, i],
        boxes[this, 2, i],
        boxes[this, 3, i],
        boxes[this, 4, i],
        boxes[this, 5, i],
    )
    one, other = work.ends[this, 0, i], work.ends[this, 1, i]
    ahead, before, after, low, high = sides
    found = 0
    for j in range(5):
        if (j > 1 and not ahead) or (j == 2 and not before) or ((j == 1 or j == 4) and not after):
            continue
        which = this if j < 2 else 1 - this
        start = work.bounds[j, 0 if low else 1] if j > 0 else i + 1
        count = work.bounds[j, 3 if high else 2] - start
        if count <= 0:
            continue
        _meet(boxes, work.ends, which, start, (count + _LANES - 1) // _LANES * _LANES, box, one, other, near)
        found = _pick(work.words, count, which * width + start, hits, found, _PLACES, _NUMBERS)
    _compare_lines(work.lines, this * width + i, hits, found, near)
    count, found = found, 0
    for k in range(count):
        hits[found] = hits[k]
        found += near[k]
    return found


@kernel
def _compare_planes(state, planes, points, held, grid, options, work, out):
    """Write the rows of segments that are pairs, and where they are closest; return how many.

    ``options``: the factor of margins before, and the most comparisons.
    ``state`` (3,): the plane to start at, and where to go on after the arrays are full; the pairs for which there must
    be room then; the number of comparisons.
    """
    starts, bounds, boxes = planes.starts, work.bounds, work.boxes
    across, rows, along = grid.axes
    wide, width = grid.count[along] + 2, work.rows.shape[1]
    loaded = -1
    found = 0
    here = there = 0
    for plane in range(state[0], len(starts) - 1):
        if starts[plane + 1] == starts[plane]:
            continue
        begun, before = found, state[2]
        this, other = plane % 2, (plane + 1) % 2
        here = there if loaded == plane else _load(plane, planes, points, held, grid, work, this)
        there = 0
        if plane + 2 < len(starts):
            there = _load(plane + 1, planes, points, held, grid, work, other)
        loaded = plane + 1
        bounds[:] = 0
        first = 0
        while first < here:
            key = work.keys[this, first]
            begin = first
            while first < here and work.keys[this, first] == key:
                first += 1
            row, cell = key // wide - 1, key % wide - 1
            _find_ranges(work, key, wide, this, here, other, there)
            if grid.ranks[0] > 1 and not _is_here(plane, row, cell, grid):
                continue
            state[2] += (first - begin) * (first - begin - 1) // 2 + (first - begin) * (bounds[0, 3] - first)
            for j in range(1, 5):
                state[2] += (first - begin) * (bounds[j, 3] - bounds[j, 0])
            if state[2] > options[1]:
                return found
            for i in range(begin, first):
                sides = (
                    _reaches(boxes[this, 3 + across, i], plane, 1, grid, across),
                    _reaches(boxes[this, rows, i], row, 0, grid, rows),
                    _reaches(boxes[this, 3 + rows, i], row, 1, grid, rows),
                    _reaches(boxes[this, along, i], cell, 0, grid, along),
                    _reaches(boxes[this, 3 + along, i], cell, 1, grid, along),
                )
                for hit in range(_collect(work, i, this, sides)):
                    which = work.hits[hit] // width
                    place = work.hits[hit] - which * width
                    one = work.rows[this, i], work.parts[this, i]
                    two = work.rows[which, place], work.parts[which, place]
                    found += _examine(points, held, grid, options[0], one, two, found, out)
        if found > len(out.rows):
            state[0], state[1], state[2] = plane, 2 * (found - begun), before
            return begun
    state[0] = len(starts) - 1
    return found


@inlined
def _reaches(side, cell, upper, grid, axis):
    """Return whether a box with a ``side`` may meet pieces of the cell before or, if ``upper``, after its own."""
    border = (cell + upper) / (grid.inverse[axis] * grid.unit)
    reach = grid.extents[axis] / grid.unit * (1.0 + 1e-6) + 1e-3 + 1e-6 * border
    return side + reach >= border if upper else side - reach <= border


@inlined
def _is_here(plane, row, along, grid):
    """Return whether a cell belongs to this rank."""
    i = j = k = np.int64(0)
    for axis, number in ((grid.axes[0], plane), (grid.axes[1], row), (grid.axes[2], along)):
        if axis == 0:
            i = number
        elif axis == 1:
            j = number
        else:
            k = number
    return _holder(i, j, k, grid.ranks[0]) == grid.ranks[1]

"""Pairs of line segments that are close to each other, among segments of all ranks.

Segments, or pieces of long ones, are sorted by the cells of their middles. Cells are as wide as two of them can be
apart and still be close: then they are in the same cell or in neighbouring ones. Where cells are many more than pieces,
they are folded: several that are far from each other have one place. The pieces of a cell are compared with those of it
and of half of its neighbours, by vectors of boxes in single precision. On several ranks, blocks of cells belong to the
rank that has most segments there. Points are segments whose ends coincide.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from mpi4py import MPI

from ..columns import STATUS
from ..mechanics.compiled import inlined, kernel
from ..mesh.exchange import Router
from ..mesh.slab import slab_of
from ..parallel.heap import returning_freed_memory
from .rotations import along, cross, dot, minus, vector

# Limits for each segment: pieces, and comparisons.
_PIECES, _COMPARISONS = 8.0, 2000.0

_BLOCK = 8  # cells along the edges of blocks, of which each belongs to one rank
_BLOCKS = 1 << 14  # different blocks; those with the same hash belong to the same rank

_CELLS = (1 << 21) - 2  # along an axis; those beyond belong to the last one
_ROOM = 1 << 12  # pairs for which there is room at first
_LANES = 32  # boxes compared at once, at most
# In single precision and cells: rounding, a half, and a product of lengths below which squares vanish.
_SLACK, _HALF, _TINY = np.float32(1e-3), np.float32(0.5), np.float32(1e-15)


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
    """Cells: their lowest corner (3,) [m], inverse edges (3,) [1/m] and numbers (3,) int64 along x, y and z; the unit
    of single-precision numbers [m], the longest piece of a segment [m], the skin [m], the factor of margins before; the
    ranks of blocks, and this one."""

    low: np.ndarray
    inverse: np.ndarray
    count: np.ndarray
    unit: float
    longest: float
    skin: float
    factor: float
    owners: np.ndarray
    rank: int


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
    sums = _measure(comm, points.at, own, np.inf, 0.0)[1]
    mean = float(sums[1]) / max(float(sums[0]), 1.0)
    skin, longest, pieces = skin * mean, 2.0 * mean or 1.0, 0.0
    while number:
        most, sums = _measure(comm, points.at, own, longest, skin)
        before, pieces = pieces, float(sums[2])
        if pieces == before or pieces > _PIECES * number:  # shorter pieces are no better, or too many
            return None
        edges = np.maximum(2.0 * most[6:], 0.5 * most[6:].max()) * (1.0 + 1e-8)
        count = np.minimum((most[3:6] + most[:3]) / edges, float(_CELLS)).astype(np.int64) + 1
        owners = np.zeros(_BLOCKS, np.int64)
        grid = _Grid(-most[:3], 1.0 / edges, count, float(edges.max()), longest, skin, factor, owners, comm.rank)
        held = (points, own) if comm.size == 1 else _hold(comm, grid, points, own)
        found, comparisons = _compare(grid, *held, _COMPARISONS * number)
        if comm.allreduce(comparisons) <= _COMPARISONS * number:
            return found._replace(gap=comm.allreduce(min(found.gap, skin), op=MPI.MIN))
        longest *= 0.5
    return Pairs(np.empty((0, 2), np.int64), np.empty((0, 2, 2), np.int64), np.empty((0, 2)), np.inf)


def largest_change(comm: MPI.Comm, motion: tuple[np.ndarray, np.ndarray], n_nodes: int, reach: float) -> float:
    """Return by how much distances up to ``reach`` between any bars may have changed [m]; infinite for positions that
    are not finite. Collective.

    An affine map, the fit of all displacements, takes nodes to within r of where they are. With its singular values s,
    a distance d has become one between s_min d - 2 r and s_max d + 2 r: a body that spins has not changed.

    Parameters
    ----------
    motion : positions (owned, 3) before and now [m]
    n_nodes : of all ranks
    """
    at, moved = motion[0], motion[1] - motion[0]
    middle, way = comm.allreduce(np.stack([at.sum(axis=0), moved.sum(axis=0)])) / n_nodes
    at, moved = at - middle, moved - way
    moments = comm.allreduce(np.hstack([at.T @ at, at.T @ moved]))
    if not np.isfinite(moments).all():
        return np.inf
    gradient = np.linalg.pinv(moments[:, :3], rcond=1e-9, hermitian=True) @ moments[:, 3:]
    rest = moved - at @ gradient
    ends = np.stack([rest.max(axis=0, initial=-np.inf), -rest.min(axis=0, initial=np.inf)])
    comm.Allreduce(MPI.IN_PLACE, ends, op=MPI.MAX)
    rest -= 0.5 * (ends[0] - ends[1])
    square = comm.allreduce(float(np.einsum("ij,ij->i", rest, rest).max(initial=0.0)), op=MPI.MAX)
    stretch = float(np.abs(np.linalg.svd(np.eye(3) + gradient, compute_uv=False) - 1.0).max())
    return 2.0 * np.sqrt(square) + stretch * reach


def _measure(
    comm: MPI.Comm, at: np.ndarray, own: Segments, longest: float, skin: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return extremes (9,) and sums (3,) of all segments, see :func:`_measure_segments`. Collective."""
    most, sums = _measure_segments(at, own, longest, skin)
    comm.Allreduce(MPI.IN_PLACE, most, op=MPI.MAX)
    comm.Allreduce(MPI.IN_PLACE, sums, op=MPI.SUM)
    return most, sums


def _hold(comm: MPI.Comm, grid: _Grid, points: Points, own: Segments) -> tuple[Points, Segments]:
    """Give blocks to ranks, and send segments to those of their cells and of the neighbouring ones; return those that
    this rank has then. Collective."""
    votes = np.zeros(_BLOCKS, np.int64)
    _count_blocks(points.at, own, grid, votes)
    votes = votes * comm.size + (np.arange(_BLOCKS) + comm.rank) % comm.size  # of equal ones, by turns
    comm.Allreduce(MPI.IN_PLACE, votes, op=MPI.MAX)
    grid.owners[:] = (votes - np.arange(_BLOCKS)) % comm.size
    router = Router(comm, *_list_ranks(points.at, own, grid, comm.size))
    ends = router.send(points.at[own.points])
    before = router.send(points.before[own.points]) if len(points.before) else points.before
    names = router.send(points.names[own.points])
    kind = router.send(own.kind) if comm.allreduce(len(own.kind)) else own.kind
    at = np.arange(2 * len(ends), dtype=np.int32).reshape(-1, 2)
    return (
        Points(ends.reshape(-1, 3), names.reshape(-1), before.reshape(-1, 3)),
        Segments(router.send(own.ids), at, router.send(own.margin), kind),
    )


class _Pieces(NamedTuple):
    """Pieces of segments, sorted by places of cells: ``rows`` (m,) int32 of segments, from ``starts`` on; numbers of
    the pieces, ``parts`` (m,) int32; middles and half extents with margins, ``boxes`` (m, 6); ways from end to end and
    margins, ``ways`` (m, 4); ``ends`` (m, 2) int32, equal where names are; and whether their cells are those of this
    rank, ``here`` (m,) bool."""

    starts: np.ndarray
    rows: np.ndarray
    parts: np.ndarray
    boxes: np.ndarray
    ways: np.ndarray
    ends: np.ndarray
    here: np.ndarray


def _compare(grid: _Grid, points: Points, held: Segments, most: float) -> tuple[Pairs, float]:
    """Return the pairs among the segments that are held, and the number of comparisons, which end beyond the most."""
    folded = grid.count + 1  # the last cell, which is empty, is after the others and before the first
    while folded.prod() > 2 * len(held.ids) + 64:
        axis = folded.argmax()
        folded[axis] = max(3, (folded[axis] + 1) // 2)
    marks = points.names
    if int(marks.max(initial=0)) > np.iinfo(np.int32).max:
        marks = np.unique(marks, return_inverse=True)[1]
    pieces = _sort_pieces(points.at, held, grid, folded, marks.astype(np.int32))
    rows, at, gap, comparisons = _compare_rows(pieces, points, held, grid, folded, most)
    ids = held.ids[rows].astype(np.int64)
    return Pairs(ids, points.names[held.points[rows]].astype(np.int64), at, gap), comparisons


@inlined
def _pieces(at, segments, n, longest, skin):
    """Return the first end of a segment, the way to the other, its margin with half of the skin, and the number of its
    pieces: not longer than ``longest``, or four times as long as thick."""
    first, margin = vector(at, segments.points[n, 0]), segments.margin[n] + 0.5 * skin
    way = minus(vector(at, segments.points[n, 1]), first)
    square, most = dot(way, way), max(longest, 4.0 * margin)
    return first, way, margin, 1 if square <= most * most else int(np.sqrt(square) / most) + 1


@kernel
def _measure_segments(at, segments, longest, skin):
    """Return the largest coordinates, with the negative sign and without, and how far pieces with their margins reach
    from their middles along x, y and z (9,); and the numbers of segments longer than zero, the sum of their lengths
    with margins, and the number of pieces (3,)."""
    most, sums = np.full(9, -np.inf), np.zeros(3)
    number = total = every = 0.0
    for n in range(len(segments.ids)):
        first, way, margin, pieces = _pieces(at, segments, n, longest, skin)
        part, square = 0.5 / pieces, dot(way, way)
        for c in range(3):
            last = first[c] + way[c]
            most[c] = max(most[c], -first[c], -last)
            most[3 + c] = max(most[3 + c], first[c], last)
            most[6 + c] = max(most[6 + c], part * abs(way[c]) + margin)
        number += square > 0.0
        total += np.sqrt(square) + 2.0 * segments.margin[n]
        every += pieces
    sums[0], sums[1], sums[2] = number, total, every
    return most, sums


@inlined
def _cell(first, way, part, pieces, grid):
    """Return the numbers of the cell of the middle of a piece along the axes. They grow with the coordinates, by no
    more than one over the edge of a cell."""
    x, y, z = minus(along(first, (part + 0.5) / pieces, way), grid.low)
    i = int(min(max(x * grid.inverse[0], 0.0), grid.count[0] - 1.0))
    j = int(min(max(y * grid.inverse[1], 0.0), grid.count[1] - 1.0))
    return i, j, int(min(max(z * grid.inverse[2], 0.0), grid.count[2] - 1.0))


@inlined
def _block(i, j, k):
    """Return the number of a block of cells."""
    key = np.uint64(((i << 42) | (j << 21) | k) + 1)
    return np.int64((key * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(33)) % _BLOCKS


@kernel
def _count_blocks(at, segments, grid, votes):
    """Count the pieces in each block."""
    for n in range(len(segments.ids)):
        first, way, _, pieces = _pieces(at, segments, n, grid.longest, grid.skin)
        for part in range(pieces):
            i, j, k = _cell(first, way, part, pieces, grid)
            votes[_block(i // _BLOCK, j // _BLOCK, k // _BLOCK)] += 1


@kernel
def _list_ranks(at, segments, grid, size):
    """Return the ranks to which each segment goes, and its row, for each."""
    seen, count = np.full(size, -1, np.int64), 0
    ranks, rows = np.empty(_ROOM, np.int64), np.empty(_ROOM, np.int64)
    for n in range(len(segments.ids)):
        first, way, _, pieces = _pieces(at, segments, n, grid.longest, grid.skin)
        if count + size > len(rows):
            ranks, rows = _longer(ranks, size), _longer(rows, size)
        for part in range(pieces):
            x, y, z = _cell(first, way, part, pieces, grid)
            for i in range(max(x - 1, 0) // _BLOCK, (x + 1) // _BLOCK + 1):
                for j in range(max(y - 1, 0) // _BLOCK, (y + 1) // _BLOCK + 1):
                    for k in range(max(z - 1, 0) // _BLOCK, (z + 1) // _BLOCK + 1):
                        owner = grid.owners[_block(i, j, k)]
                        if seen[owner] < n:
                            seen[owner], ranks[count], rows[count] = n, owner, n
                            count += 1
    return ranks[:count], rows[:count]


@inlined
def _longer(array, more):
    """Return a copy of an array that has room for twice as many rows, and some more."""
    copy = np.empty((2 * len(array) + more, *array.shape[1:]), array.dtype)
    copy[: len(array)] = array
    return copy


@inlined
def _fold(i, count):
    """Return the place of a cell along an axis with some places; divisions are slow."""
    return i if i < count else i % count


@kernel
def _sort_pieces(at, segments, grid, folded, marks):
    """Return the pieces of segments, sorted by cells; ``folded`` (3,): places of cells along the axes; ``marks`` (p,)
    int32 of points, equal where their names are."""
    starts, most = np.zeros(folded[0] * folded[1] * folded[2] + 2, np.int32), 0
    for n in range(len(segments.ids)):
        most += _pieces(at, segments, n, grid.longest, grid.skin)[3]
    cells, here, unit, m = np.empty(most, np.int32), np.empty(most, np.bool_), grid.unit, 0
    for n in range(len(segments.ids)):
        first, way, _, pieces = _pieces(at, segments, n, grid.longest, grid.skin)
        for part in range(pieces):
            i, j, k = _cell(first, way, part, pieces, grid)
            cells[m] = (_fold(i, folded[0]) * folded[1] + _fold(j, folded[1])) * folded[2] + _fold(k, folded[2])
            starts[cells[m] + 2] += 1
            m += 1
    for cell in range(len(starts) - 1):
        starts[cell + 1] += starts[cell]
    rows, parts, m = np.empty(most, np.int32), np.empty(most, np.int32), 0
    boxes, ways, ends = np.empty((most, 6), np.float32), np.empty((most, 4), np.float32), np.empty((most, 2), np.int32)
    for n in range(len(segments.ids)):
        first, way, margin, pieces = _pieces(at, segments, n, grid.longest, grid.skin)
        for part in range(pieces):
            place = starts[cells[m] + 1]
            starts[cells[m] + 1] += 1
            m += 1
            i, j, k = _cell(first, way, part, pieces, grid)
            here[place] = grid.owners[_block(i // _BLOCK, j // _BLOCK, k // _BLOCK)] == grid.rank
            rows[place], parts[place] = n, part
            ends[place, 0], ends[place, 1] = marks[segments.points[n, 0]], marks[segments.points[n, 1]]
            middle, slack = minus(along(first, (part + 0.5) / pieces, way), grid.low), 0.0
            for c in range(3):  # in single precision, boxes are rounded outwards
                slack = max(slack, 2e-7 * ((abs(middle[c]) + abs(way[c])) / unit + 1.0))
            ways[place, 3] = margin / unit + slack
            for c in range(3):
                boxes[place, c], ways[place, c] = middle[c] / unit, way[c] / pieces / unit
                boxes[place, 3 + c] = _HALF * abs(ways[place, c]) + ways[place, 3]
    return _Pieces(starts[:-1], rows, parts, boxes, ways, ends, here)


@inlined
def clip(value):
    """Return a number from 0 to 1; one within may be complex."""
    return 0.0 if value.real < 0.0 else 1.0 if value.real > 1.0 else value


@inlined
def closest(u, v, w):
    """Return the parameters from 0 to 1 of the closest points of segments along ``u`` and ``v``, with the way ``w``
    from the start of the second to that of the first.

    Source: Ericson, Real-time collision detection (2005), 5.1.9.
    """
    aa, bb, ab, ar, br = dot(u, u), dot(v, v), dot(u, v), dot(u, w), dot(v, w)
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
    first, second = vector(at, points[a, 0]), vector(at, points[b, 0])
    u, v, w = minus(vector(at, points[a, 1]), first), minus(vector(at, points[b, 1]), second), minus(first, second)
    s, t = closest(u, v, w)
    way = minus(along(second, t, v), along(first, s, u))
    return np.sqrt(dot(way, way)), s, t


@inlined
def _are_apart(near, this, hit, one, two):
    """Return whether two pieces are certainly apart: along the normal of both, along one of them, or across one of them
    in the plane of both or away from it (separating axes). ``one`` and ``two``: ways from end to end, and margins. In
    single precision and without divisions."""
    w = minus(vector(near.boxes.T, hit), vector(near.boxes.T, this))
    n, uu, vv, uv, uw, vw = cross(one, two), dot(one, one), dot(two, two), dot(one, two), dot(one, w), dot(two, w)
    reach, a, b = one[3] + two[3] + _SLACK, np.sqrt(uu), np.sqrt(vv)
    square, off, across, rounding = dot(n, n), uu * dot(w, w) - uw * uw, uu * vw - uv * uw, _SLACK * a * b
    thick = reach * np.sqrt(square) + rounding
    far = abs(dot(n, w)) > thick
    far |= abs(uw) > _HALF * (uu + abs(uv)) + reach * a
    far |= abs(vw) > _HALF * (vv + abs(uv)) + reach * b
    far |= off > _HALF * abs(across) + reach * a * np.sqrt(abs(off))
    far |= abs(across) > _HALF * square + thick * a
    far |= abs(vv * uw - uv * vw) > _HALF * square + thick * b
    return far & (a * b >= _TINY)


@inlined
def _examine(pieces, p, q, points, held, grid):
    """Return the rows of the segments of two pieces, where they are closest, their distance less the margins, and
    whether the pieces are those of a pair."""
    # rounding must not depend on the order of the segments, which depends on the ranks
    i, j = pieces.rows[p], pieces.rows[q]
    forth, alike = held.ids[i] < held.ids[j], False
    if len(held.kind) > 0:
        forth = forth if held.kind[i] == held.kind[j] else held.kind[i] < held.kind[j]
        alike = held.kind[i] == held.kind[j] and held.kind[i] > 0
    if not forth:
        i, j, p, q = j, i, q, p
    if i == j or alike:
        return i, j, 0.0, 0.0, np.inf, False
    reach = held.margin[i] + held.margin[j]
    distance, s, t = segment_distance(points.at, held.points, i, j)
    found = distance < reach
    if found:  # unless they are closest elsewhere
        for n, piece, where in ((i, p, s), (j, q, t)):
            number = _pieces(points.at, held, n, grid.longest, grid.skin)[3]
            found &= min(int(where * number), number - 1) == pieces.parts[piece]
    if found and len(points.before) > 0:
        found = segment_distance(points.before, held.points, i, j)[0] >= grid.factor * reach
    return i, j, s, t, distance - reach, found


class _Near(NamedTuple):
    """Room for m pieces of a row of cells and of half of its neighbours, by columns of cells across the row: their
    ``places``, ``boxes`` (6, m) and ``ends`` (2, m); which ones meet a box, as bytes and as ``words`` of
    the same memory, and their list, the ``hits``. For each column, from that before the first on, where the pieces of
    the row and those of its neighbours begin, ``bounds``; the first cells of these ``lines`` (5,)."""

    places: np.ndarray
    boxes: np.ndarray
    ends: np.ndarray
    meets: np.ndarray
    words: np.ndarray
    hits: np.ndarray
    bounds: np.ndarray
    lines: np.ndarray


@inlined
def _make_near(m, columns):
    """Return room for m pieces and vectors behind them, in some columns and those before and after."""
    boxes, ends = np.zeros((6, m + _LANES), np.float32), np.zeros((2, m + _LANES), np.int32)
    meets, bounds = np.empty(m // 8 * 8 + _LANES, np.uint8), np.empty((columns + 3, 2), np.int64)
    places, hits = np.empty(m, np.int32), np.empty(m + 1, np.int32)
    return _Near(places, boxes, ends, meets, meets.view(np.uint64), hits, bounds, np.empty(5, np.int64))


@inlined
def _gather(pieces, width, near):
    """Copy the pieces of ``near.lines``, a row of cells of a ``width`` and half of its neighbours, to where comparisons
    read them. Of two neighbouring cells, one is after the other."""
    starts, boxes, ends, count = pieces.starts, near.boxes, near.ends, 0
    for column in range(-1, width + 1):
        for step in range(5):
            if step < 2:
                near.bounds[column + 1, step] = count
            cell = near.lines[step] + (column if 0 <= column < width else column % width)
            for p in range(starts[cell], starts[cell + 1]):
                near.places[count], ends[0, count], ends[1, count] = p, pieces.ends[p, 0], pieces.ends[p, 1]
                for c in range(6):
                    boxes[c, count] = pieces.boxes[p, c]
                count += 1
    near.bounds[width + 2, 0] = count


@inlined
def _meet(near, this, begin, end):
    """List the pieces from ``begin`` to ``end`` whose boxes meet that of ``this`` one and that share no end with it;
    return how many. Few branches depend on single ones, which cost more than the comparisons."""
    x, y, z = near.boxes[0, begin:], near.boxes[1, begin:], near.boxes[2, begin:]
    wide, deep, high = near.boxes[3, begin:], near.boxes[4, begin:], near.boxes[5, begin:]
    one, other, meets = near.ends[0, begin:], near.ends[1, begin:], near.meets
    (x0, y0, z0), (x1, y1, z1) = vector(near.boxes[:3].T, this), vector(near.boxes[3:].T, this)
    a, b, found = near.ends[0, this], near.ends[1, this], 0
    for i in range((end - begin + _LANES - 1) // _LANES * _LANES):
        close = (abs(x[i] - x0) <= wide[i] + x1) & (abs(y[i] - y0) <= deep[i] + y1) & (abs(z[i] - z0) <= high[i] + z1)
        meets[i] = close & (one[i] != a) & (one[i] != b) & (other[i] != a) & (other[i] != b)
    for word in range((end - begin + 7) // 8):
        if near.words[word] != 0:
            for i in range(8 * word, min(8 * word + 8, end - begin)):
                near.hits[found] = begin + i
                found += near.meets[i]
    return found


@kernel
def _compare_rows(pieces, points, held, grid, folded, most):
    """Return the rows of segments that are pairs (m, 2), where they are closest (m, 2), the gap, see :class:`Pairs`,
    and the number of comparisons, which end beyond the most."""
    rows, at, gap = np.empty((_ROOM, 2), np.int32), np.empty((_ROOM, 2)), np.inf
    width, found, comparisons = folded[2], 0, 0.0
    begins = pieces.starts[::width]
    near = _make_near(10 * (begins[1:] - begins[:-1]).max(), width)  # five rows, and their first and last cells twice
    for row in range(folded[0] * folded[1]):
        if begins[row] == begins[row + 1]:
            continue
        i, j = row // folded[1], row % folded[1]
        for step in range(5):
            x, y = (i + (step > 1)) % folded[0], (j + (step if step < 2 else step - 3)) % folded[1]
            near.lines[step] = (x * folded[1] + y) * width
        _gather(pieces, width, near)
        for k in range(width):
            begin, end = near.bounds[k, 1], near.bounds[k + 3, 0]
            comparisons += float(near.bounds[k + 1, 1] - near.bounds[k + 1, 0]) * (end - begin)
            if comparisons > most:
                return rows[:0], at[:0], gap, comparisons
            for this in range(near.bounds[k + 1, 0], near.bounds[k + 1, 1]):
                p = near.places[this]
                if not pieces.here[p]:
                    continue
                for hit in range(_meet(near, this, begin, end)):
                    other = near.hits[hit]
                    q = near.places[other]
                    if near.bounds[k + 1, 0] <= other <= this:  # the pieces of its own cell are each compared once
                        continue
                    if _are_apart(near, this, other, pieces.ways[p], pieces.ways[q]):
                        continue
                    one, two, s, t, beyond, close = _examine(pieces, p, q, points, held, grid)
                    gap = min(gap, abs(beyond))
                    if close:
                        if found == len(rows):
                            rows, at = _longer(rows, 0), _longer(at, 0)
                        rows[found, 0], rows[found, 1], at[found, 0], at[found, 1] = one, two, s, t
                        found += 1
    return rows[:found], at[:found], gap, comparisons


STOUT = 0.25
"""Radius of a bar over its length beyond which it has no axis that others could cross."""

# Bars this much closer to each other in the mesh, relative to their radii, touch there: it may be rounding.
_NEAR = 0.01

# Distance between bars up to which the search knows it, over their mean length. No search is needed before it has
# changed.
_SKIN = 0.1

# Coordinate beyond which a node is not searched [m].
_STRAY = 1e100


class Crossing(NamedTuple):
    """Pairs of bars that pass through each other, number of bars among them, and the lowest pair of numbers."""

    pairs: int
    bars: int
    lowest: tuple[int, int]


class CrossingBars:
    """Finds bars that pass through each other and did not in the mesh. Collective, with results for any ranks alike.

    Bars with an end in contact pairs or constraints may meet, by which others of this kind come close: such pairs are
    left out, and so are springs, dashpots, broken bars, and bars that are less than twice as long as thick.

    Attributes
    ----------
    applicable : whether there are bars to be searched
    """

    def __init__(self, model: Any) -> None:
        self._model = model
        mesh = model.mesh
        self._n_bars = mesh.n_bars - mesh.n_connectors
        radius = model.bars.radii()[mesh.counted]
        slender = radius < STOUT * model.bars.mesh_lengths[mesh.counted]
        slender &= mesh.bar_ids[mesh.counted] < self._n_bars
        self._bars = mesh.counted
        if not (isinstance(self._bars, slice) and slender.all()):
            self._bars = np.arange(len(mesh.bars), dtype=np.int32)[self._bars][slender]
        self.applicable = model.comm.allreduce(int(np.count_nonzero(slender))) > 1 and model.self_contact is None
        self._thick = 2.0 * model.comm.allreduce(float(radius[slender].max(initial=0.0)), op=MPI.MAX)
        self._kind = self._linked_bars()
        # the last search: its result, the smallest distance at which that would change [m], positions, and bars
        self._found: Crossing | None = Crossing(0, 0, (-1, -1))  # in the mesh, no bar does
        self._gap, self._before, self._were = 0.0, mesh.points, None

    def _linked_bars(self) -> np.ndarray:
        """Return (bars,) uint8: 1 for those with an end in contact pairs or constraints, else 0; (0,) without any.
        Collective."""
        case, mesh = self._model.case, self._model.mesh
        tables = (*case.contact_pair, *case.constraint)
        if not tables:
            return np.empty(0, np.uint8)
        linked = np.zeros((mesh.n_local, 1))
        for table in tables:
            for value in table.model_dump().values():
                for name in value if isinstance(value, list | tuple) else [value]:
                    if isinstance(name, str) and name in self._model.nodes:
                        linked[self._model.nodes[name]] = 1.0
        mesh.update_ghosts(linked)
        return (linked[mesh.bars[self._bars], 0] > 0.0).any(axis=1).astype(np.uint8)

    def find(self, x: np.ndarray) -> Crossing | None:
        """Return the bars at positions (local, 3) [m] that pass through each other; None if the search would take too
        long, because too many bars are in one place."""
        comm, mesh, intact = self._model.comm, self._model.mesh, self._intact()
        self._were = intact if self._were is None else self._were
        motion = self._before[: mesh.n_owned], x[: mesh.n_owned]
        change = largest_change(comm, motion, mesh.n_nodes, self._thick + self._gap)
        if comm.allreduce(bool((intact != self._were).any()), op=MPI.LOR):
            change = np.inf
        if change > 0.0 and change >= 0.998 * self._gap:
            with returning_freed_memory():
                self._found, self._gap = self._search(x)
            self._before, self._were = x.copy(), intact
        return self._found

    def _intact(self) -> np.ndarray:
        """Return (bars,) bool: those that are not broken; (0,) if none can break."""
        if not self._model.bars.can_break:
            return np.empty(0, dtype=bool)
        return self._model.bars.status()[self._bars] != STATUS.index("broken")

    def _count(self, pairs: np.ndarray) -> Crossing:
        """Return the number of pairs and bars from the pairs (m, 2) that this rank has found. Collective."""
        comm, n = self._model.comm, self._n_bars
        both = np.unique(pairs)
        bars = np.unique(Router(comm, slab_of(both, n, comm.size)).send(both))
        lowest = int((pairs[:, 0] * n + pairs[:, 1]).min(initial=np.iinfo(np.int64).max))
        lowest = comm.allreduce(lowest, op=MPI.MIN)
        return Crossing(comm.allreduce(len(pairs)), comm.allreduce(len(bars)), (lowest // n, lowest % n))

    def _search(self, x: np.ndarray) -> tuple[Crossing | None, float]:
        """Return the pairs at positions (local, 3) [m], and by how much the distance of any two bars differs at least
        from the sum of their radii [m]."""
        comm, mesh, bars = self._model.comm, self._model.mesh, self._model.bars
        ids, ends, radius, kind = mesh.bar_ids[self._bars], mesh.bars[self._bars], bars.radii()[self._bars], self._kind
        # stray nodes may be anywhere, and squares of distances must be finite; a NaN has its own message elsewhere
        near = (np.abs(x) < _STRAY).all(axis=1)
        if bars.can_break or not near.all():
            kept = near[ends].all(axis=1) & (self._intact() if bars.can_break else True)
            ids, ends, radius, kind = ids[kept], ends[kept], radius[kept], kind[kept] if len(kind) else kind
        segments = Segments(ids, ends, radius, kind)
        found = find_pairs(comm, Points(x, mesh.node_ids, mesh.points), segments, _SKIN, 1.0 + _NEAR)
        return (None, 0.0) if found is None else (self._count(found.ids), found.gap)

"""Pairs of line segments that are close to each other, among segments of all ranks.

Space is divided into cells of about a segment. Each rank holds the segments in the cells that a hash assigns to
it, and compares those that share a cell. A pair belongs to the first cell that both have, or, if one is longer than a
cell, to that of a point between the two where they are closest, so that it is found once, by one rank. Points are
segments whose ends coincide.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from mpi4py import MPI

from ..mechanics.compiled import inlined, kernel
from ..mesh.exchange import Router

# Limits of the work for each segment: cells listed, and pairs compared.
_CELLS, _PAIRS = 64.0, 2000.0

# Cells of 8 x 8 x 8 belong to one rank, so that most segments are sent to one or two.
_BLOCK = 8

_CHUNK = 1 << 18  # pairs found at a time
_LONG = 1 << 40  # number of a cell where there is none
_SECOND = 1 << 62  # added to the numbers of the second set of segments


class Segments(NamedTuple):
    """Segments of a rank.

    ids (n,) int64: numbers, unique on all ranks; labels (n, k) int64: those with a common one are no pair; ends
    (n, 2, 3) [m]; margin (n,) [m]: pairs are not farther apart than the sum of theirs
    """

    ids: np.ndarray
    labels: np.ndarray
    ends: np.ndarray
    margin: np.ndarray


class Pairs(NamedTuple):
    """Pairs: their ids (m, 2) and labels (m, 2, k), where they are closest to each other, from 0 at the first end of
    each to 1 at the second (m, 2), their distance there (m,) [m], and the sum of their margins (m,) [m]."""

    ids: np.ndarray
    labels: np.ndarray
    at: np.ndarray
    distance: np.ndarray
    reach: np.ndarray


class NeighbourSearch:
    """Search of close segments. Construction is collective; time and memory are proportional to the segments of a rank.

    Parameters
    ----------
    comm : MPI.Comm
    one, two : Segments of this rank
        Pairs are of a segment of ``one`` with one of ``two``, in this order; without ``two``, of two segments of
        ``one``, that with the lower number first. Coordinates must be finite, and their squares too.

    Attributes
    ----------
    crowded : whether the search would take too long, because too many segments are in one place
    """

    def __init__(self, comm: MPI.Comm, one: Segments, two: Segments | None = None) -> None:
        self._between = two is not None
        if two is not None:
            two = two._replace(ids=two.ids + _SECOND)
            one = Segments(*(np.concatenate(arrays) for arrays in zip(one, two)))
        lengths = np.linalg.norm(one.ends[:, 1] - one.ends[:, 0], axis=1)
        points = one.ends.reshape(-1, 3).T.copy()  # minima along rows are many times faster
        low, high = points.min(axis=1, initial=np.inf), points.max(axis=1, initial=-np.inf)
        comm.Allreduce(MPI.IN_PLACE, low, op=MPI.MIN)
        comm.Allreduce(MPI.IN_PLACE, high, op=MPI.MAX)
        sizes = lengths + 2.0 * one.margin
        number, long, size = comm.allreduce(np.array([len(lengths), np.count_nonzero(lengths), sizes.sum()]))
        self._low, self._cell, self.crowded = low, size / max(long, 1.0), False
        self._held, self._start, change = one, np.zeros(1, np.int64), 1.0
        self._keys, self._rows, self._corners = np.empty(0, np.int64), np.empty(0, np.int32), np.empty((0, 3), np.int64)
        while number:
            cells = ((lengths // self._cell + 1.0) * (2.0 + 2.0 * one.margin / self._cell) ** 3).sum()
            fits = comm.allreduce(float(cells)) <= _CELLS * number and (high - low).max() < 2.0**60 * self._cell
            if fits:
                self._hold(comm, one)
                counts = np.diff(self._start).astype(float)
                if comm.allreduce(float((counts * counts).sum())) <= 2.0 * _PAIRS * number:
                    return
            before, change = change, 0.5 if fits else 2.0
            if before * change == 1.0:  # smaller cells are too many, larger ones too full
                self.crowded = True
                return
            self._cell *= change

    def _hold(self, comm: MPI.Comm, own: Segments) -> None:
        """Send segments to the ranks of their cells, and sort the cells that are held by this one. Collective."""
        none, no_rows, corners = np.empty(0, np.int64), np.empty(0, np.int32), np.empty((len(own.ids), 3), np.int64)
        if comm.size > 1:
            cells = (own.ends, own.margin), (self._low, self._cell), corners
            count = _list_cells(*cells, (comm.size, -1), none, (none, no_rows))
            ranks, rows = np.empty(count, np.int64), np.empty(count, np.int32)
            _list_cells(*cells, (comm.size, -1), none, (ranks, rows))
            each = np.unique(rows.astype(np.int64) * comm.size + ranks)
            router = Router(comm, each % comm.size, each // comm.size)
            own = Segments(*(router.send(array) for array in own))
        self._corners = np.empty((len(own.ids), 3), np.int64)
        cells = (own.ends, own.margin), (self._low, self._cell), self._corners
        counts = np.zeros(1 << (2 * len(own.ids)).bit_length(), np.int64)
        count = _list_cells(*cells, (comm.size, comm.rank), counts, (none, no_rows))
        self._start = np.append(0, np.cumsum(counts))
        self._held, self._keys, self._rows = own, np.empty(count, np.int64), np.empty(count, np.int32)
        _list_cells(*cells, (comm.size, comm.rank), self._start[:-1].copy(), (self._keys, self._rows))

    def pairs(self) -> Iterator[Pairs]:
        """Yield the pairs that this rank finds, a limited number at a time; each is found by one rank."""
        room = max(_CHUNK, int(np.diff(self._start).max(initial=0)))
        found_rows, at, distance = np.empty((room, 2), np.int64), np.empty((room, 2)), np.empty(room)
        buckets, grid = (self._start, self._keys, self._rows, self._corners), (self._low, self._cell, self._between)
        state = np.zeros(2, np.int64)
        while state[0] < len(self._start) - 1:
            found = slice(0, _compare(state, buckets, self._held, grid, (found_rows, at, distance)))
            rows = found_rows[found]
            ids, reach = self._held.ids[rows], self._held.margin[rows].sum(axis=1)
            ids[ids >= _SECOND] -= _SECOND
            if len(rows):
                yield Pairs(ids, self._held.labels[rows], at[found].copy(), distance[found].copy(), reach)


@inlined
def _key(i, j, k):
    """Return a number of a cell from its numbers along the axes, which wrap around after 2^21 cells."""
    mask = (1 << 21) - 1
    return ((i & mask) << 42) | ((j & mask) << 21) | (k & mask)


@inlined
def _mixed(key):
    """Return a number from 0 to 2^31 - 1 that looks random."""
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    return np.int64(mixed >> np.uint64(33))


@kernel
def _list_cells(segments, grid, corners, ranks, buckets, listed):
    """List the cells around segments: the key of the cell and the row of the segment, for cells of ``ranks[1]`` of
    ``ranks[0]``; with -1, the rank of the cell and the row. Each goes to the place that its bucket, if there are any,
    is at, which moves on; without arrays for the list they are counted. ``corners`` (n, 3) are set to
    the first cell of each segment, or far away for those longer than a cell. Returns the length of the list."""
    ends, margins = segments
    low, cell = grid
    keys, rows = listed
    size, rank = ranks
    first = np.empty(3, np.int64)
    last = np.empty(3, np.int64)
    before = np.empty((2, 3), np.int64)
    count = 0
    for n in range(len(ends)):
        way = ends[n, 1] - ends[n, 0]
        length = np.sqrt((way * way).sum())
        margin = margins[n] + 1e-9 * (length + cell)
        pieces = int(length / cell) + 1
        for piece in range(pieces):
            for c in range(3):
                p = ends[n, 0, c] + piece / pieces * way[c]
                q = ends[n, 0, c] + (piece + 1) / pieces * way[c]
                first[c] = int(np.floor((min(p, q) - margin - low[c]) / cell))
                last[c] = int(np.floor((max(p, q) + margin - low[c]) / cell))
            if piece == 0:
                corners[n] = first
            else:
                corners[n, 0] = _LONG
            for i in range(first[0], last[0] + 1):
                for j in range(first[1], last[1] + 1):
                    for k in range(first[2], last[2] + 1):
                        # pieces follow a line, so that a cell of an earlier piece is also one of the last piece
                        if (
                            piece
                            and before[0, 0] <= i <= before[1, 0]
                            and before[0, 1] <= j <= before[1, 1]
                            and before[0, 2] <= k <= before[1, 2]
                        ):
                            continue
                        holder = 0
                        if size > 1:
                            holder = _mixed(_key(i // _BLOCK, j // _BLOCK, k // _BLOCK)) % size
                        if rank >= 0 and holder != rank:
                            continue
                        key = holder if rank < 0 else _key(i, j, k)
                        at = count
                        if len(buckets):
                            bucket = _mixed(key) & (len(buckets) - 1)
                            at = buckets[bucket]
                            buckets[bucket] += 1
                        if len(keys):
                            keys[at] = key
                            rows[at] = n
                        count += 1
            before[0] = first
            before[1] = last
    return count


@inlined
def _clip(value):
    return min(max(value, 0.0), 1.0)


@inlined
def _closest(ends, a, b):
    """Return the parameters from 0 to 1 of the closest points of segments ``a`` and ``b``.

    Source: Ericson, Real-time collision detection (2005), 5.1.9.
    """
    aa = 0.0
    bb = 0.0
    ab = 0.0
    ar = 0.0
    br = 0.0
    for c in range(3):
        u = ends[a, 1, c] - ends[a, 0, c]
        v = ends[b, 1, c] - ends[b, 0, c]
        w = ends[a, 0, c] - ends[b, 0, c]
        aa += u * u
        bb += v * v
        ab += u * v
        ar += u * w
        br += v * w
    if aa <= 0.0:
        return 0.0, _clip(br / bb) if bb > 0.0 else 0.0
    if bb <= 0.0:
        return _clip(-ar / aa), 0.0
    across = aa * bb - ab * ab
    s = _clip((ab * br - ar * bb) / across) if across > 1e-14 * aa * bb else 0.0
    t = (ab * s + br) / bb
    if t < 0.0:
        return _clip(-ar / aa), 0.0
    if t > 1.0:
        return _clip((ab - ar) / aa), 1.0
    return s, t


@inlined
def _meet(keys, boxes, i, near):
    """Write the segments of a bucket behind segment ``i`` whose cell is the same and whose ``boxes`` (6, n), components
    of the lower and the upper corner, meet its own to ``near`` (n,); return how many. Without branches."""
    low_x, low_y, low_z, high_x, high_y, high_z = boxes[:, i]
    count = 0
    for j in range(i + 1, len(keys)):
        near[count] = j
        meets = (boxes[0, j] <= high_x) & (boxes[1, j] <= high_y) & (boxes[2, j] <= high_z)
        meets &= (boxes[3, j] >= low_x) & (boxes[4, j] >= low_y) & (boxes[5, j] >= low_z)
        count += meets & (keys[j] == keys[i])
    return count


@inlined
def _common(labels, a, b):
    common = False
    for m in range(labels.shape[1]):
        for n in range(labels.shape[1]):
            common |= labels[a, m] == labels[b, n]
    return common


@kernel
def _compare(state, buckets, held, grid, out):
    """Write the rows of segments that are pairs, where they are closest, and their distances; return how many.

    Starts at a place of a bucket, ``state`` (2,), and leaves there where it goes on after the arrays are full.
    """
    start, keys, rows, corners = buckets
    ids, labels, ends, margin = held
    low, cell, between = grid
    found_rows, found_at, found_distance = out
    found = 0
    place, first, way = np.empty(3, np.int64), np.empty(3), np.empty(3)
    most = (start[1:] - start[:-1]).max()
    boxes, near = np.empty((6, most)), np.empty(most, np.int64)
    for bucket in range(state[0], len(start) - 1):
        begin, end = start[bucket], start[bucket + 1]
        for p in range(begin, end):
            one = rows[p]
            more = margin[one] + 1e-9 * cell
            for c in range(3):
                boxes[c, p - begin] = min(ends[one, 0, c], ends[one, 1, c]) - more
                boxes[3 + c, p - begin] = max(ends[one, 0, c], ends[one, 1, c]) + more
        for p in range(max(begin, state[1]), end):
            if found + end - p > len(found_rows):
                state[0] = bucket
                state[1] = p
                return found
            key, one = keys[p], rows[p]
            for j in range(_meet(keys[begin:end], boxes, p - begin, near)):
                two = rows[begin + near[j]]
                corner = max(corners[one, 0], corners[two, 0])
                y, z = max(corners[one, 1], corners[two, 1]), max(corners[one, 2], corners[two, 2])
                if corner < _LONG and _key(corner, y, z) != key:
                    continue
                # rounding must not depend on the order of the segments, which depends on the ranks
                a, b = (one, two) if ids[one] < ids[two] else (two, one)
                if between and (ids[a] >= _SECOND or ids[b] < _SECOND):
                    continue
                if _common(labels, a, b):
                    continue
                reach = margin[a] + margin[b]
                s, t = _closest(ends, a, b)
                square = 0.0
                for c in range(3):
                    first[c] = ends[a, 0, c] + s * (ends[a, 1, c] - ends[a, 0, c])
                    way[c] = ends[b, 0, c] + t * (ends[b, 1, c] - ends[b, 0, c]) - first[c]
                    square += way[c] * way[c]
                if square > reach * reach:
                    continue
                if corner == _LONG:
                    part = margin[a] / reach if reach > 0.0 else 0.5
                    for c in range(3):
                        place[c] = int(np.floor((first[c] + way[c] * part - low[c]) / cell))
                    if _key(place[0], place[1], place[2]) != key:
                        continue
                found_rows[found, 0] = a
                found_rows[found, 1] = b
                found_at[found, 0] = s
                found_at[found, 1] = t
                found_distance[found] = np.sqrt(square)
                found += 1
    state[0] = len(start) - 1
    return found

"""Bars that pass through each other: bars do not touch bars, so nothing stops them.

Two bars that share no node pass through each other if their axes are closer than the sum of their radii. Each rank
holds the bars of the cells of space that a hash assigns to it, and compares those that share a cell. A pair belongs to
the cell of a point between the two axes, where they are closest, so that it is found once, by one rank.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from mpi4py import MPI

from ..fields import STATUS
from ..mechanics.compiled import inlined, kernel
from ..mesh.exchange import Router
from ..mesh.slab import slab_of

if TYPE_CHECKING:
    from ..stepping.model import Model

__all__ = ["Crossing", "CrossingBars"]

STOUT = 0.25
"""Radius of a bar over its length beyond which it has no axis that others could cross."""

# Bars this much closer to each other in the mesh, relative to their radii, touch there: it may be rounding.
_NEAR = 0.01

# Distance between bars up to which the search knows it, over their mean length. Until nodes have moved by half of the
# smallest distance, no search is needed.
_SKIN = 0.1

# Coordinate beyond which a node is not searched [m].
_STRAY = 1e100

# Limits of the work: cells listed and pairs compared, both per bar.
_CELLS, _PAIRS = 64.0, 2000.0

# Cells of 8 x 8 x 8 belong to one rank, so that most bars are sent to one or two.
_BLOCK = 8


class Crossing(NamedTuple):
    """Pairs of bars that pass through each other, number of bars among them, and the lowest pair of numbers."""

    pairs: int
    bars: int
    lowest: tuple[int, int]


class _Segments(NamedTuple):
    """Bars: numbers (n,), those of their end nodes (n, 2), ends (n, 2, 3) [m] and radii (n,) [m]."""

    ids: np.ndarray
    nodes: np.ndarray
    ends: np.ndarray
    radius: np.ndarray


class CrossingBars:
    """Finds bars that pass through each other and did not in the mesh. Collective, with results for any ranks alike.

    Bars with an end in contact pairs or constraints may meet, by which others of this kind come close: such pairs are
    left out, and so are springs, dashpots, broken bars, and bars that are less than twice as long as thick.

    Attributes
    ----------
    applicable : whether there are bars to be searched
    """

    def __init__(self, model: Model) -> None:
        self._model = model
        mesh, bars = model.mesh, model.bars
        counted = np.arange(len(mesh.bars))[mesh.counted]
        radius = bars.radii()[counted]
        slender = radius < STOUT * bars.mesh_lengths[counted]
        slender &= mesh.bar_ids[counted] < mesh.n_bars - mesh.n_connectors
        self._bars, self._radius = counted[slender], radius[slender]
        self._n_bars = mesh.n_bars - mesh.n_connectors
        self.applicable = model.comm.allreduce(len(self._bars)) > 1
        self._meeting = self._linked_nodes()
        self._before: np.ndarray | None = None
        self._last: _Search | None = None

    def _linked_nodes(self) -> np.ndarray:
        """Return (local,) 1.0 for nodes in contact pairs and constraints, else 0.0. Collective."""
        case, mesh = self._model.case, self._model.mesh
        linked = np.zeros((mesh.n_local, 1))
        for table in (*case.contact_pair, *case.constraint):
            for value in table.model_dump().values():
                for name in value if isinstance(value, list | tuple) else [value]:
                    if isinstance(name, str) and name in self._model.nodes:
                        linked[self._model.nodes[name]] = 1.0
        mesh.update_ghosts(linked)
        return linked[:, 0]

    def find(self, x: np.ndarray) -> Crossing | None:
        """Return the bars at positions (local, 3) [m] that pass through each other; None if the search would take too
        long, because too many bars are in one place."""
        if self._last is None:
            points = self._model.mesh.points
            self._before, gap = self._pairs(points, 1.0 + _NEAR)
            self._last = _Search(Crossing(0, 0, (-1, -1)), gap, points, self._intact())
        if self._before is None:
            return None
        if self._moved(x) < 0.499 * self._last.gap:
            return self._last.found
        pairs, gap = self._pairs(x, 1.0)
        found = None if pairs is None else self._count(pairs[~np.isin(pairs, self._before)])
        self._last = _Search(found, gap, x.copy(), self._intact())
        return found

    def _intact(self) -> np.ndarray:
        """Return (bars,) bool: those that are not broken."""
        if not self._model.bars.can_break:
            return np.ones(len(self._bars), dtype=bool)
        return self._model.bars.status()[self._bars] != STATUS.index("broken")

    def _moved(self, x: np.ndarray) -> float:
        """Return how far a node has moved relative to the others since the last search [m]; infinite if bars broke."""
        comm, last, owned = self._model.comm, self._last, self._model.mesh.n_owned
        moved = x - last.x
        mean = comm.allreduce(moved[:owned].sum(axis=0)) / self._model.mesh.n_nodes
        moved -= mean
        square = float(np.einsum("ij,ij->i", moved, moved).max(initial=0.0))
        broken = bool((self._intact() != last.intact).any()) or not np.isfinite(square)
        return np.sqrt(comm.allreduce(np.inf if broken else square, op=MPI.MAX))

    def _count(self, new: np.ndarray) -> Crossing:
        """Return the number of pairs and bars from the keys of pairs on this rank. Collective."""
        comm, n = self._model.comm, self._n_bars
        first, second = new // n, new % n
        both = np.unique(np.concatenate([first, second]))
        bars = np.unique(Router(comm, slab_of(both, n, comm.size)).send(both))
        lowest = int(new.min()) if len(new) else np.iinfo(np.int64).max
        lowest = comm.allreduce(lowest, op=MPI.MIN)
        return Crossing(comm.allreduce(len(new)), comm.allreduce(len(bars)), (lowest // n, lowest % n))

    def _pairs(self, x: np.ndarray, factor: float) -> tuple[np.ndarray | None, float]:
        """Return keys of pairs, first number times the number of bars plus second, on the rank of the first, and by how
        much the distance of any two bars differs at least from the sum of their radii [m]; radii are multiplied by a
        factor."""
        comm, mesh = self._model.comm, self._model.mesh
        chosen = self._bars
        kept = self._intact()
        ends = mesh.bars[chosen[kept]]
        # stray nodes may be anywhere, and squares of distances must be finite; a NaN has its own message elsewhere
        fine = (np.abs(x[ends]) < _STRAY).all(axis=(1, 2))
        ends, kept = ends[fine], np.flatnonzero(kept)[fine]
        nodes, points, radius = mesh.node_ids[ends].astype(np.int64), x[ends], factor * self._radius[kept]
        meeting = (self._meeting[ends] > 0.0).any(axis=1)
        turned = nodes[:, 0] > nodes[:, 1]
        nodes[turned], points[turned] = nodes[turned, ::-1], points[turned, ::-1]
        segments = _Segments(mesh.bar_ids[chosen[kept]].astype(np.int64), nodes, points, radius)
        low = np.min(points, axis=(0, 1), initial=np.inf) if len(points) else np.full(3, np.inf)
        comm.Allreduce(MPI.IN_PLACE, low, op=MPI.MIN)
        lengths = np.linalg.norm(points[:, 1] - points[:, 0], axis=1)
        number, size = comm.allreduce(np.array([len(lengths), float((lengths + 4.0 * radius).sum())]))
        if not number:
            return np.empty(0, np.int64), np.inf
        skin = _SKIN * size / number
        cell = 0.5 * size / number
        while True:
            cells = (lengths // cell + 1.0) * (2.0 + (2.0 * radius + skin) / cell) ** 3
            if comm.allreduce(float(cells.sum())) <= _CELLS * number:
                break
            cell *= 2.0
        held = _Held(segments, radius + 0.5 * skin, meeting).sent(comm, low, cell)
        start, keys, rows = _buckets(*held.cells(comm, low, cell))
        counts = np.diff(start).astype(float)
        if comm.allreduce(float((counts * counts).sum())) > 2.0 * _PAIRS * number:
            return None, 0.0
        room = max(1024, len(held.segments.ids))
        while True:
            out = np.empty((room, 2), np.int64)
            found, gap = _compare(start, keys, rows, *held.segments, held.meeting, low, cell, skin, out)
            if found <= room:
                break
            room = found
        one, two = out[:found].min(axis=1), out[:found].max(axis=1)
        keys = Router(comm, slab_of(one, self._n_bars, comm.size)).send(one * self._n_bars + two)
        return keys, comm.allreduce(gap, op=MPI.MIN)


class _Search(NamedTuple):
    """The last search: its result, the smallest distance at which that would change [m], positions (local, 3), and
    which bars were intact."""

    found: Crossing | None
    gap: float
    x: np.ndarray
    intact: np.ndarray


class _Held(NamedTuple):
    """Bars of a rank, the distances around them in which others are searched (n,) [m], and which of them are at links
    (n,) bool."""

    segments: _Segments
    margin: np.ndarray
    meeting: np.ndarray

    def sent(self, comm: MPI.Comm, low: np.ndarray, cell: float) -> _Held:
        """Return the bars that pass cells of this rank. Collective."""
        if comm.size == 1:
            return self
        ends, margin = self.segments.ends, self.margin
        count = _list_cells(ends, margin, low, cell, comm.size, -1, np.empty(0, np.int64), np.empty(0, np.int64))
        ranks, rows = np.empty(count, np.int64), np.empty(count, np.int64)
        _list_cells(ends, margin, low, cell, comm.size, -1, ranks, rows)
        each = np.unique(rows * comm.size + ranks)
        router = Router(comm, each % comm.size, each // comm.size)
        segments = _Segments(*(router.send(array) for array in self.segments))
        return _Held(segments, router.send(self.margin), router.send(self.meeting))

    def cells(self, comm: MPI.Comm, low: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the cells of this rank that each bar passes: a key of the cell and the row of the bar."""
        ends, margin = self.segments.ends, self.margin
        room = 12 * len(margin)
        while True:
            keys, rows = np.empty(room, np.int64), np.empty(room, np.int64)
            count = _list_cells(ends, margin, low, cell, comm.size, comm.rank, keys, rows)
            if count <= room:
                return keys[:count], rows[:count]
            room = count


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


@inlined
def _piece(ends, k, begin, end, margin, low, cell, first, last):
    """Write the first and last cells (3,) of the box around a part of bar ``k`` and a margin [m]."""
    for c in range(3):
        p = ends[k, 0, c] + begin * (ends[k, 1, c] - ends[k, 0, c])
        q = ends[k, 0, c] + end * (ends[k, 1, c] - ends[k, 0, c])
        first[c] = int(np.floor((min(p, q) - margin - low[c]) / cell))
        last[c] = int(np.floor((max(p, q) + margin - low[c]) / cell))


@kernel
def _list_cells(ends, margins, low, cell, size, rank, keys, rows):
    """List the cells around bars, as far as there is room: the cell and the row of the bar, for cells of ``rank``; with
    -1, the rank of the cell and the row. Returns the length of the list."""
    first = np.empty(3, np.int64)
    last = np.empty(3, np.int64)
    before = np.empty((2, 3), np.int64)
    count = 0
    for k in range(len(ends)):
        length = np.sqrt(((ends[k, 1] - ends[k, 0]) ** 2).sum())
        margin = margins[k] + 1e-9 * (length + cell)
        pieces = int(length / cell) + 1
        for piece in range(pieces):
            _piece(ends, k, piece / pieces, (piece + 1) / pieces, margin, low, cell, first, last)
            for i in range(first[0], last[0] + 1):
                for j in range(first[1], last[1] + 1):
                    for m in range(first[2], last[2] + 1):
                        # pieces follow a line, so that a cell of an earlier piece is also one of the last piece
                        if (
                            piece
                            and before[0, 0] <= i <= before[1, 0]
                            and before[0, 1] <= j <= before[1, 1]
                            and before[0, 2] <= m <= before[1, 2]
                        ):
                            continue
                        holder = 0
                        if size > 1:
                            holder = _mixed(_key(i // _BLOCK, j // _BLOCK, m // _BLOCK)) % size
                        if rank >= 0 and holder != rank:
                            continue
                        if count < len(keys):
                            keys[count] = holder if rank < 0 else _key(i, j, m)
                            rows[count] = k
                        count += 1
            before[0] = first
            before[1] = last
    return count


@kernel
def _buckets(keys, rows):
    """Sort a list into buckets of cells: returns the start of each bucket (buckets + 1,), and the sorted list."""
    size = 1
    while size < len(keys):
        size *= 2
    start = np.zeros(size + 1, np.int64)
    for key in keys:
        start[(_mixed(key) & (size - 1)) + 1] += 1
    for b in range(size):
        start[b + 1] += start[b]
    at = start[:size].copy()
    cells = np.empty_like(keys)
    bars = np.empty_like(rows)
    for n in range(len(keys)):
        b = _mixed(keys[n]) & (size - 1)
        cells[at[b]] = keys[n]
        bars[at[b]] = rows[n]
        at[b] += 1
    return start, cells, bars


@inlined
def _clip(value):
    return min(max(value, 0.0), 1.0)


@inlined
def _closest(ends, a, b):
    """Return the parameters from 0 to 1 of the closest points of the axes of bars ``a`` and ``b``.

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


@kernel
def _compare(start, keys, rows, ids, nodes, ends, radius, meeting, low, cell, skin, out):
    """Write the numbers of bars (pairs, 2) that pass through each other, as far as there is room; return how many, and
    by how much a distance differs at least from the sum of radii, at most ``skin`` [m]."""
    found = 0
    gap = skin
    place = np.empty(3, np.int64)
    for bucket in range(len(start) - 1):
        for p in range(start[bucket], start[bucket + 1]):
            for q in range(p + 1, start[bucket + 1]):
                if keys[p] != keys[q]:
                    continue
                # rounding must not depend on the order of the bars, which depends on the ranks
                a = rows[p] if ids[rows[p]] < ids[rows[q]] else rows[q]
                b = rows[q] if a == rows[p] else rows[p]
                if nodes[a, 0] == nodes[b, 0] or nodes[a, 1] == nodes[b, 1]:
                    continue
                if nodes[a, 0] == nodes[b, 1] or nodes[a, 1] == nodes[b, 0]:
                    continue
                if meeting[a] and meeting[b]:
                    continue
                reach = radius[a] + radius[b]
                apart = False
                for c in range(3):
                    apart |= min(ends[a, 0, c], ends[a, 1, c]) - max(ends[b, 0, c], ends[b, 1, c]) > reach + gap
                    apart |= min(ends[b, 0, c], ends[b, 1, c]) - max(ends[a, 0, c], ends[a, 1, c]) > reach + gap
                if apart:
                    continue
                s, t = _closest(ends, a, b)
                square = 0.0
                for c in range(3):
                    one = ends[a, 0, c] + s * (ends[a, 1, c] - ends[a, 0, c])
                    two = ends[b, 0, c] + t * (ends[b, 1, c] - ends[b, 0, c])
                    square += (two - one) * (two - one)
                    place[c] = int(np.floor((one + (two - one) * (radius[a] / reach) - low[c]) / cell))
                gap = min(gap, abs(np.sqrt(square) - reach))
                if square >= reach * reach or _key(place[0], place[1], place[2]) != keys[p]:
                    continue
                if found < len(out):
                    out[found, 0] = ids[a]
                    out[found, 1] = ids[b]
                found += 1
    return found, gap

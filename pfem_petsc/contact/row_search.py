"""Distribution of rows and pairs over ranks: a rank has those of its own nodes and of the nodes coupled with them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..errors import InputError
from ..mesh.exchange import GhostExchange, Router
from ..mesh.slab import slab_of

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..mesh.distribution import DistributedMesh


def owner_starts(mesh: DistributedMesh) -> np.ndarray:
    """Return the first PETSc number owned by each rank, and the end, (ranks + 1,). Collective."""
    return np.concatenate([[0], np.cumsum(mesh.comm.allgather(mesh.n_owned))]).astype(np.int64)


def petsc_numbers(mesh: DistributedMesh, numbers: np.ndarray) -> np.ndarray:
    """Return the PETSc numbers of nodes given by mesh numbers (n,), which any rank may own. Collective."""
    comm, ids = mesh.comm, mesh.node_ids[: mesh.n_owned]
    to_slab = Router(comm, slab_of(ids, mesh.n_nodes, comm.size))
    known, at = to_slab.send(ids), to_slab.send(mesh.first_node + np.arange(mesh.n_owned))
    order = np.argsort(known)
    wanted, place = np.unique(numbers, return_inverse=True)
    asking = Router(comm, slab_of(wanted, mesh.n_nodes, comm.size))
    asked = asking.send(wanted)
    return asking.reply(at[order[np.searchsorted(known[order], asked)]])[place.ravel()]


def once(rows: np.ndarray) -> np.ndarray:
    """Return the rows (r, k) without duplicates, sorted by the first two columns, which identify them."""
    rows = rows[np.lexsort((rows[:, 1], rows[:, 0]))]
    return rows[np.append(True, (np.diff(rows[:, :2], axis=0) != 0).any(axis=1))[: len(rows)]]


def to_owners(rows: np.ndarray, columns: Sequence[int], starts: np.ndarray, comm: MPI.Comm) -> np.ndarray:
    """Return the rows of all ranks with a node of this rank, without duplicates. Collective.

    Parameters
    ----------
    rows : (r, k) int64
    columns : of PETSc numbers of nodes, negative for none
    starts : see :func:`owner_starts`
    comm : MPI.Comm
    """
    owners = np.searchsorted(starts, rows[:, columns], side="right") - 1
    keys = np.arange(len(rows))[:, None] * comm.size + owners
    row, owner = np.divmod(np.unique(keys[owners >= 0]), comm.size)
    return once(Router(comm, owner).send(rows[row]))


def with_groups(rows: np.ndarray, columns: Sequence[int], starts: np.ndarray, comm: MPI.Comm) -> np.ndarray:
    """Add the rows connected with those of this rank through shared nodes, repeated until complete. Collective.

    ``rows`` (r, k) are all rows with a node of this rank; see :func:`to_owners`.
    """
    own = rows
    order = [np.argsort(own[:, at], kind="stable") for at in columns]
    first, last = starts[comm.rank], starts[comm.rank + 1]
    known = np.empty(0, dtype=np.int64)
    while True:
        ends = np.unique(rows[:, columns])
        asked = np.setdiff1d(ends[(ends >= 0) & ((ends < first) | (ends >= last))], known)
        if comm.allreduce(len(asked), op=MPI.MAX) == 0:
            return rows
        known = np.union1d(known, asked)
        asking = Router(comm, np.searchsorted(starts, asked, side="right") - 1)
        wanted = asking.send(np.column_stack([asked, np.full(len(asked), comm.rank)]))
        answers, ranks = [], []
        for column, at in zip(columns, order, strict=True):
            keys = own[at, column]
            begin = np.searchsorted(keys, wanted[:, 0])
            count = np.searchsorted(keys, wanted[:, 0], side="right") - begin
            place = np.arange(count.sum()) + np.repeat(begin - np.cumsum(count) + count, count)
            answers.append(own[at[place]])
            ranks.append(np.repeat(wanted[:, 1], count))
        answer = Router(comm, np.concatenate(ranks)).send(np.concatenate(answers))
        rows = once(np.concatenate([rows, answer]))


_CHUNK = 1 << 21  # candidates compared at once
_BINS = 1 << 12  # of the histogram that divides the strips


def across(points: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return points (n, 3) minus their part along a unit vector, bitwise independent of their index in the array."""
    along = points[:, 0] * normal[0] + points[:, 1] * normal[1] + points[:, 2] * normal[2]
    return points - along[:, None] * normal


def nearest_across(points: np.ndarray, queries: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return indices (m,) of the points (n, 3) nearest to queries (m, 3) in the plane normal to a unit vector; n >= 1.

    Of points at bitwise equal distance the first one is taken.
    """
    return _Grid(across(points, normal), normal).nearest(across(queries, normal))[0]


def nearest_among_ranks(
    comm: MPI.Comm, keys: np.ndarray, points: np.ndarray, queries: np.ndarray, normal: np.ndarray
) -> np.ndarray:
    """Return keys (m, k) of the points nearest to this rank's queries (m, 3) in a plane. Collective.

    Parameters
    ----------
    comm : MPI.Comm
    keys : (n, k) int64
        Keys of this rank's points. Of points at bitwise equal distance, the one with the smallest first key is taken.
    points : (n, 3)
        At least one point on all ranks together.
    queries, normal : (m, 3), (3,)
        Distances are measured in the plane normal to the unit vector ``normal``.
    """
    points, queries = across(points, normal), across(queries, normal)
    along = _along(comm, points, normal)
    strips = Router(comm, _strips(comm, points @ along))
    keys, points = strips.send(keys), strips.send(points)
    order = np.argsort(keys[:, 0])
    keys, points = keys[order], points[order]
    grid = _Grid(points, normal) if len(points) else None

    def answer(ranks: np.ndarray, asking: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        router = Router(comm, ranks)
        asked = router.send(asking)
        at, square = grid.nearest(asked) if len(asked) else (np.empty(0, dtype=np.int64), np.empty(0))
        return router.reply(keys[at]), router.reply(square)

    place = points @ along
    reach = np.array(comm.allgather((place.min(initial=np.inf), place.max(initial=-np.inf))))
    held = np.flatnonzero(reach[:, 0] <= reach[:, 1])  # ranks with points, in the order of their strips
    low, high = reach[held].T
    at = queries @ along
    first = np.maximum(np.searchsorted(low, at, side="right") - 1, 0)
    best, square = answer(held[first], queries)
    margin = np.sqrt(square) * (1.0 + 1e-12) + 1e-12 * np.abs(reach[held]).max()
    begin, end = np.searchsorted(high, at - margin), np.searchsorted(low, at + margin, side="right")
    count = np.maximum(end - begin, 0)
    query = np.repeat(np.arange(len(queries)), count)
    strip = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + np.repeat(begin, count)
    again = strip != first[query]
    query = query[again]
    found, other = answer(held[strip[again]], queries[query])
    # sort each query's answers by distance, then by key
    query, square = np.append(np.arange(len(queries)), query), np.append(square, other)
    best = np.concatenate([best, found])
    order = np.lexsort((best[:, 0], square, query))
    return best[order[np.append(True, np.diff(query[order]) > 0)[: len(order)]]]


def _along(comm: MPI.Comm, points: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return the axis in the plane along which the points (n, 3) of all ranks extend farthest."""
    axes = _axes(normal)
    flat = points @ axes
    ends = np.stack([-flat.min(axis=0, initial=np.inf), flat.max(axis=0, initial=-np.inf)])
    comm.Allreduce(MPI.IN_PLACE, ends, op=MPI.MAX)
    return axes[:, int(np.argmax(ends.sum(axis=0)))].copy()


def _strips(comm: MPI.Comm, place: np.ndarray) -> np.ndarray:
    """Divide points at coordinates (n,) among ranks, in ascending order and about evenly; return ranks (n,)."""
    ends = np.array([-place.min(initial=np.inf), place.max(initial=-np.inf)])
    comm.Allreduce(MPI.IN_PLACE, ends, op=MPI.MAX)
    width = max(float(ends.sum()) / _BINS, 1e-300)
    bins = np.clip(((place + ends[0]) / width).astype(np.int64), 0, _BINS - 1)
    counts = np.bincount(bins, minlength=_BINS)
    comm.Allreduce(MPI.IN_PLACE, counts)
    before = np.cumsum(counts) - counts
    return (before * comm.size // max(int(counts.sum()), 1))[bins]


def _axes(normal: np.ndarray) -> np.ndarray:
    """Return two unit vectors orthogonal to a unit vector and to each other, as columns (3, 2)."""
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first)], axis=1)


class _Grid:
    """Points (n, 3) in a plane through the origin, in square cells."""

    def __init__(self, points: np.ndarray, normal: np.ndarray) -> None:
        self.points = points
        self.axes = _axes(normal)
        flat = points @ self.axes
        self.low, self.high = flat.min(axis=0), flat.max(axis=0)
        extent, n = self.high - self.low, len(points)
        # points on a line span no area
        self.edge = max(float(np.sqrt(extent.prod() / n)), float(extent.max()) / n) or 1.0
        self.rounding = 1e-12 * float(np.abs(flat).max()) + 1e-300
        self.shape = np.floor(extent / self.edge).astype(np.int64) + 1
        cells = self._cells(flat)
        keys = cells[:, 0] * self.shape[1] + cells[:, 1]
        self.order = np.argsort(keys, kind="stable")
        self.keys = keys[self.order]

    def _cells(self, flat: np.ndarray) -> np.ndarray:
        return np.clip(np.floor((flat - self.low) / self.edge).astype(np.int64), 0, self.shape - 1)

    def nearest(self, queries: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return indices (m,) of the points nearest to queries (m, 3) in the plane, and squared distances (m,)."""
        flat = queries @ self.axes
        inside = np.clip(flat, self.low, self.high)
        # the points lie in a box: the distance of p from a query q is at least sqrt(|q - c|^2 + |c - p|^2), with c the
        # point of the box nearest to q
        outside = ((flat - inside) ** 2).sum(axis=1)
        cells = self._cells(inside)
        best, distance = np.full(len(queries), len(self.points)), np.full(len(queries), np.inf)
        left = np.arange(len(queries))
        for ring in range(int(self.shape.max()) + 1):
            for begin, end in self._ranges(cells[left], ring):
                self._look(queries, left, begin, end, best, distance)
            reached = np.maximum(ring * self.edge - self.rounding, 0.0) ** 2 + (1.0 - 1e-12) * outside[left]
            left = left[distance[left] * (1.0 + 1e-12) >= reached]
            if len(left) == 0:
                break
        return best, distance

    def _ranges(self, cells: np.ndarray, ring: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield, for each run of cells of the ring around cells (m, 2), the range (m,), (m,) of its sorted points."""
        for row in range(-ring, ring + 1):
            runs = [(-ring, ring)] if abs(row) == ring else [(-ring, -ring), (ring, ring)]
            at = cells[:, 0] + row
            for first, last in runs:
                low, high = cells[:, 1] + first, cells[:, 1] + last
                there = (at >= 0) & (at < self.shape[0]) & (high >= 0) & (low < self.shape[1])
                key = at * self.shape[1]
                begin = np.searchsorted(self.keys, key + np.maximum(low, 0))
                end = np.searchsorted(self.keys, key + np.minimum(high, self.shape[1] - 1), side="right")
                yield begin, np.where(there, end, begin)

    def _look(
        self,
        queries: np.ndarray,
        left: np.ndarray,
        begin: np.ndarray,
        end: np.ndarray,
        best: np.ndarray,
        distance: np.ndarray,
    ) -> None:
        """Compare queries ``left`` with the sorted points begin..end; update ``best`` and ``distance``."""
        counts = end - begin
        met = np.flatnonzero(counts)
        parts = np.flatnonzero(np.diff(np.cumsum(counts[met]) // _CHUNK)) + 1
        for some in np.split(met, parts):
            if len(some) == 0:
                continue
            count = counts[some]
            starts = np.append(0, np.cumsum(count)[:-1])
            place = np.arange(count.sum()) + np.repeat(begin[some] - starts, count)
            found, query = self.order[place], left[some]
            square = ((self.points[found] - np.repeat(queries[query], count, axis=0)) ** 2).sum(axis=1)
            least = np.minimum.reduceat(square, starts)
            first = np.minimum.reduceat(np.where(square == np.repeat(least, count), found, len(self.points)), starts)
            nearer = (least < distance[query]) | ((least == distance[query]) & (first < best[query]))
            best[query[nearer]], distance[query[nearer]] = first[nearer], least[nearer]


_TAG = 7500  # of the messages between partners, distinct from those of the mesh's ghosts
_TABLE, _SECOND, _SECOND_AT, _FIRST, _FIRST_AT = range(5)  # columns of pairs: mesh and PETSc numbers


@dataclass(frozen=True)
class PairNodes:
    """The pairs of this rank, sorted by table and then by the mesh number of the second node.

    Attributes
    ----------
    table : (p,) index of a pair's table
    numbers : (2, p) mesh numbers of the first and second ends
    where : (2, p) local index of an end that this rank owns, else -1 minus its row among those of other ranks
    owners : (p,) owner of the second end if this rank owns the first, else owner of the first
    partners : exchanges values at ends that other ranks own
    """

    table: np.ndarray
    numbers: np.ndarray
    where: np.ndarray
    owners: np.ndarray
    partners: GhostExchange


def find_pairs(case: Case, nodes: dict[str, np.ndarray], mesh: DistributedMesh) -> PairNodes:
    """Match the tables of a case. Collective.

    Raises
    ------
    InputError
        On all ranks, for sets of unequal size, a node paired with itself, or two nodes paired with the same node.
    """
    comm = mesh.comm
    starts = owner_starts(mesh)
    found = np.concatenate([_match(case, k, nodes, mesh) for k in range(len(case.contact_pair))])
    _refuse_itself(found, case.source, comm)
    # a second node is in one pair of a table: table and second node tell pairs apart
    ends = [_FIRST_AT, _SECOND_AT]
    pairs = with_groups(to_owners(found, ends, starts, comm), ends, starts, comm)
    first, last = starts[comm.rank], starts[comm.rank + 1]
    at = pairs[:, [_FIRST_AT, _SECOND_AT]].T
    mine = (at >= first) & (at < last)
    ghosts = np.unique(at[~mine])
    where = np.where(mine, at - first, -1 - np.searchsorted(ghosts, at))
    numbers = np.ascontiguousarray(pairs[:, [_FIRST, _SECOND]].T)
    owners = np.searchsorted(starts, at, side="right") - 1
    partners = GhostExchange(comm, starts, ghosts, _TAG)
    return PairNodes(pairs[:, _TABLE].copy(), numbers, where, np.where(mine[0], owners[1], owners[0]), partners)


def _match(case: Case, index: int, nodes: dict[str, np.ndarray], mesh: DistributedMesh) -> np.ndarray:
    """Return the pairs of a table (m, 5): each second node of this rank with the first node nearest to it."""
    pair, comm = case.contact_pair[index], mesh.comm
    key = f"{case.source}: contact_pair {pair.name!r}"
    normal = np.array(pair.direction) / np.linalg.norm(pair.direction)
    first, second = nodes[pair.first], nodes[pair.second]
    counts = np.array([len(first), len(second)])
    comm.Allreduce(MPI.IN_PLACE, counts)
    if counts[0] != counts[1]:
        raise InputError(f"{key}: first has {counts[0]} nodes and second {counts[1]}: they cannot be paired")
    if counts[0] == 0:
        return np.empty((0, 5), dtype=np.int64)
    ends = [np.column_stack([mesh.node_ids[some], mesh.first_node + some.astype(np.int64)]) for some in (first, second)]
    nearest = nearest_among_ranks(comm, ends[0], mesh.points[first], mesh.points[second], normal)
    met = np.sort(Router(comm, slab_of(nearest[:, 0], mesh.n_nodes, comm.size)).send(nearest[:, 0]))
    if comm.allreduce(bool((np.diff(met) == 0).any()), op=MPI.LOR):
        raise InputError(f"{key}: two nodes of second are nearest to the same node of first, seen along the direction")
    return np.column_stack([np.full(len(second), index), ends[1], nearest])


def _refuse_itself(pairs: np.ndarray, source: str, comm: MPI.Comm) -> None:
    same = pairs[pairs[:, _FIRST] == pairs[:, _SECOND]]
    lowest = min(comm.allgather(tuple(same[:, [_TABLE, _FIRST]].min(axis=0).tolist()) if len(same) else (np.inf,)))
    if len(lowest) > 1:
        raise InputError(f"{source}: contact_pair: node {lowest[1]} is paired with itself")

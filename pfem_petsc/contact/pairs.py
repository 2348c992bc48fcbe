"""Contact pairs: each second node with the nearest first node, seen along a direction, as a row with that direction."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..errors import InputError
from ..mesh.exchange import Router
from ..mesh.slab import slab_of
from .constraints.base import Constraint

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..case.tables import ContactPair
    from ..mesh.distribution import DistributedMesh


class PairRows(Constraint):
    """The pairs of a table: n . (x_2 - x_1) >= gap.

    Parameters
    ----------
    pair : ContactPair
    nodes : (r, 2) mesh numbers of the first and second nodes; the second ones are different from each other
    """

    fixed = True

    def __init__(self, pair: ContactPair, nodes: np.ndarray) -> None:
        self.nodes, self.data = nodes, np.empty((len(nodes), 0))
        self.ids = nodes[:, 1]
        self.normal = np.array(pair.direction) / np.linalg.norm(pair.direction)
        self.gap = float(pair.gap)

    def values(self, x: np.ndarray) -> np.ndarray:
        n, apart = self.normal, x[:, 1] - x[:, 0]
        return n[0] * apart[:, 0] + n[1] * apart[:, 1] + n[2] * apart[:, 2] - self.gap

    def gradients(self, x: np.ndarray) -> np.ndarray:
        return np.tile(np.stack([-self.normal, self.normal]), (len(x), 1, 1))


def find_pairs(case: Case, index: int, nodes: dict[str, np.ndarray], mesh: DistributedMesh) -> PairRows:
    """Match the nodes of a table of a case. Collective.

    ``nodes``: owned local indices of each node set.

    Raises
    ------
    InputError
        On all ranks, for sets of unequal size, a node paired with itself, or two nodes paired with the same node.
    """
    pair, comm = case.contact_pair[index], mesh.comm
    key = f"{case.source}: contact_pair {pair.name!r}"
    normal = np.array(pair.direction) / np.linalg.norm(pair.direction)
    first, second = nodes[pair.first], nodes[pair.second]
    counts = comm.allreduce(np.array([len(first), len(second)]))
    if counts[0] != counts[1]:
        raise InputError(f"{key}: first has {counts[0]} nodes and second {counts[1]}: they cannot be paired")
    numbers = mesh.node_ids[second].astype(np.int64)
    if counts[0] == 0:
        return PairRows(pair, np.empty((0, 2), dtype=np.int64))
    keys = mesh.node_ids[first].astype(np.int64)[:, None]
    nearest = nearest_among_ranks(comm, keys, mesh.points[first], mesh.points[second], normal)[:, 0]
    met = np.sort(Router(comm, slab_of(nearest, mesh.n_nodes, comm.size)).send(nearest))
    if comm.allreduce(bool((np.diff(met) == 0).any()), op=MPI.LOR):
        raise InputError(f"{key}: two nodes of second are nearest to the same node of first, seen along the direction")
    lowest = comm.allreduce(int(nearest[nearest == numbers].min(initial=mesh.n_nodes)), op=MPI.MIN)
    if lowest < mesh.n_nodes:
        raise InputError(f"{case.source}: contact_pair: node {lowest} is paired with itself")
    return PairRows(pair, np.column_stack([nearest, numbers]))


_CHUNK = 1 << 21  # candidates compared at once
_BINS = 1 << 12  # of the histogram that divides the strips


def across(points: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return points (n, 3) minus their part along a unit vector, bitwise independent of their index in the array."""
    along = points[:, 0] * normal[0] + points[:, 1] * normal[1] + points[:, 2] * normal[2]
    return points - along[:, None] * normal


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

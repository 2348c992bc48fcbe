"""Nodes on bars that they are not connected to, and coincident nodes.

Space is divided into cells of about the length of a bar. A rank holds the nodes of cells that a hash assigns to it, and
sends those of a cell to the ranks whose bars pass it: each rank holds its share of the nodes twice, and those near its
bars.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from mpi4py import MPI

from ..mechanics.compiled import inlined, kernel
from ..mesh.exchange import Router
from ..mesh.slab import slab_of
from .overlaps import ANGLE

if TYPE_CHECKING:
    from ..mesh.distribution import DistributedMesh

__all__ = ["NodesOnBars", "nodes_on_bars"]

_SHOWN = 5

# Maximum work per bar: cells to be searched, and nodes per cell.
_PIECES, _CROWD = 50.0, 200.0

# Number of bars whose cells are listed at a time.
_BARS = 1 << 16
_NONE = np.iinfo(np.int64).max


class NodesOnBars(NamedTuple):
    """Numbers of nodes on bars between their ends and of coinciding nodes, with descriptions of the first ones."""

    between: int
    shown_between: list[str]
    coinciding: int
    shown_coinciding: list[str]


class _Nodes(NamedTuple):
    """Nodes sorted by cell and number: keys of the cells (n,), mesh numbers (n,), and positions (n, 3) [m]."""

    keys: np.ndarray
    numbers: np.ndarray
    points: np.ndarray

    def sorted(self) -> _Nodes:
        """Return them in order, which does not depend on the ranks that they come from."""
        order = np.lexsort((self.numbers, self.keys))
        return _Nodes(self.keys[order], self.numbers[order], self.points[order])

    def sent(self, router: Router) -> _Nodes:
        """Return what arrives from all ranks. Collective."""
        return _Nodes(*(router.send(array) for array in self)).sorted()


class _Bars(NamedTuple):
    """Bars of this rank: positions of its nodes (local, 3) [m], end nodes (m, 2) and lengths (m,) [m] of bars; the
    lowest corner (3,) [m], the size of a cell [m] and the numbers of cells in the three directions (3,)."""

    x: np.ndarray
    ends: np.ndarray
    length: np.ndarray
    low: np.ndarray
    cell: float
    across: np.ndarray


def nodes_on_bars(mesh: DistributedMesh) -> NodesOnBars | None:
    """Find nodes on bars to which they are not connected. Collective.

    Time and memory are proportional to the number of nodes and bars of a rank, if the lengths of bars and the distances
    of nodes do not differ too much.

    Returns
    -------
    NodesOnBars, the same for any number of ranks, or None if this would take too long: lengths that differ too much
    """
    comm, owned = mesh.comm, mesh.n_owned
    counted = np.arange(len(mesh.bars))[mesh.counted]
    counted = counted[mesh.bar_ids[counted] < mesh.n_bars - mesh.n_connectors]
    ends = mesh.bars[counted]
    length = np.sqrt(((mesh.points[ends[:, 1]] - mesh.points[ends[:, 0]]) ** 2).sum(axis=1))
    numbers, points = mesh.node_ids[:owned].astype(np.int64), np.ascontiguousarray(mesh.points[:owned])
    low, high = points.min(axis=0, initial=np.inf), points.max(axis=0, initial=-np.inf)
    comm.Allreduce(MPI.IN_PLACE, low, op=MPI.MIN)
    comm.Allreduce(MPI.IN_PLACE, high, op=MPI.MAX)
    cell = comm.allreduce(float(length.sum())) / mesh.n_bars
    while True:
        # one more cell on each side, for nodes on the border
        shape = np.ceil((high - low) / cell).astype(np.float64) + 3.0
        if comm.allreduce(float((length / cell + 1.0).sum())) > _PIECES * mesh.n_bars or shape.prod() > 2.0**62:
            return None
        places = ((points - low) / cell).astype(np.int64) + 1
        across = shape.astype(np.int64)
        keys = (places[:, 2] * across[1] + places[:, 1]) * across[0] + places[:, 0]
        router = Router(comm, _holder(keys, comm.size))
        _, crowd = np.unique(router.send(keys), return_counts=True)
        if comm.allreduce(float((crowd.astype(float) ** 2).sum())) <= _CROWD * mesh.n_nodes:
            break
        cell *= 0.5
    bars = _Bars(mesh.points, ends, length, low, cell, across)
    held = _Nodes(keys, numbers, points).sent(router)
    near = held if comm.size == 1 else _near(comm, held, _cells(bars))
    return _found(mesh, counted, bars, near)


def _found(mesh: DistributedMesh, counted: np.ndarray, bars: _Bars, near: _Nodes) -> NodesOnBars:
    """Return what this rank's bars ``counted`` and those of the others find among the nodes near them. Collective."""
    comm = mesh.comm
    lowest, pairs = np.full((_SHOWN, 2), _NONE), np.full((_SHOWN, 2), _NONE)
    twins, of_ends = np.zeros(len(near.keys), np.bool_), np.zeros((len(counted), 2), np.bool_)
    between = _look(*near, mesh.node_ids, mesh.bar_ids[counted], *bars, lowest, pairs, twins, of_ends)
    alike = np.unique(np.concatenate([near.numbers[twins], mesh.node_ids[bars.ends[of_ends]]]).astype(np.int64))
    alike = np.unique(Router(comm, slab_of(alike, mesh.n_nodes, comm.size)).send(alike))
    named = []
    for number, node in lowest[lowest[:, 0] != _NONE].tolist():
        a, b = mesh.node_ids[mesh.bars[counted[np.flatnonzero(mesh.bar_ids[counted] == number)[0]]]].tolist()
        named.append((number, node, f"node {node} on bar {number} (nodes {a} and {b})"))
    on_bars = sorted(line for some in comm.allgather(named) for line in some)
    # a pair is found once for each bar of its nodes
    mine = [tuple(pair) for pair in pairs[pairs[:, 0] != _NONE].tolist()]
    together = sorted({pair for some in comm.allgather(mine) for pair in some})
    return NodesOnBars(
        comm.allreduce(between),
        [text for *_, text in on_bars[:_SHOWN]],
        comm.allreduce(len(alike)),
        [f"nodes {a} and {b}" for a, b in together[:_SHOWN]],
    )


def _holder(keys: np.ndarray, size: int) -> np.ndarray:
    """Return the rank that holds the nodes of each cell."""
    mixed = keys.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    return ((mixed >> np.uint64(32)) % np.uint64(size)).astype(np.int64)


def _cells(bars: _Bars) -> np.ndarray:
    """Return the keys of the cells that bars pass, sorted."""
    found = np.empty(0, np.int64)
    for first in range(0, len(bars.ends), _BARS):
        some = bars._replace(ends=bars.ends[first : first + _BARS], length=bars.length[first : first + _BARS])
        keys = np.empty(_list_cells(*some, np.empty(0, np.int64)), np.int64)
        _list_cells(*some, keys)
        found = np.union1d(found, keys)
    return found


def _near(comm: MPI.Comm, held: _Nodes, cells: np.ndarray) -> _Nodes:
    """Return the nodes of some cells, from the ranks that hold them. Collective."""
    asking = Router(comm, _holder(cells, comm.size))
    asked, by = asking.send(cells), asking.send(np.full(len(cells), comm.rank))
    begin, end = (np.searchsorted(held.keys, asked, side) for side in ("left", "right"))
    counts = end - begin
    rows = np.repeat(begin - (np.cumsum(counts) - counts), counts) + np.arange(counts.sum())
    return _Nodes(*(array[rows] for array in held)).sent(Router(comm, np.repeat(by, counts)))


@inlined
def _box(x, a, b, begin, end, length, low, cell, first, last):
    """Write the first and the last cells (3,) of the box around a piece of the bar from node ``a`` to ``b``."""
    tolerance = ANGLE * length
    for i in range(3):
        along = (x[b, i] - x[a, i]) / length
        p = x[a, i] + begin * along
        q = x[a, i] + end * along
        first[i] = int(np.floor((min(p, q) - tolerance - low[i]) / cell)) + 1
        last[i] = int(np.floor((max(p, q) + tolerance - low[i]) / cell)) + 1


@kernel
def _list_cells(x, ends, length, low, cell, across, out):
    """Return the number of cells around all pieces of bars, and write the first ``len(out)`` keys."""
    count = 0
    first = np.empty(3, np.int64)
    last = np.empty(3, np.int64)
    for k in range(len(ends)):
        n = int(np.ceil(length[k] / cell))
        for piece in range(n):
            begin = length[k] * piece / n
            end = length[k] * (piece + 1) / n
            _box(x, ends[k, 0], ends[k, 1], begin, end, length[k], low, cell, first, last)
            for z in range(first[2], last[2] + 1):
                for y in range(first[1], last[1] + 1):
                    row = (z * across[1] + y) * across[0]
                    for key in range(row + first[0], row + last[0] + 1):
                        if count < len(out):
                            out[count] = key
                        count += 1
    return count


@inlined
def _keep(lowest, one, two):
    """Put a pair of numbers among the lowest ones, which are sorted, unless it is there."""
    for i in range(len(lowest)):
        if lowest[i, 0] == one and lowest[i, 1] == two:
            return
        if one < lowest[i, 0] or (one == lowest[i, 0] and two < lowest[i, 1]):
            for j in range(len(lowest) - 1, i, -1):
                lowest[j, 0] = lowest[j - 1, 0]
                lowest[j, 1] = lowest[j - 1, 1]
            lowest[i, 0] = one
            lowest[i, 1] = two
            return


@kernel
def _look(keys, numbers, points, ids, bar_ids, x, ends, length, low, cell, across, lowest, pairs, twins, of_ends):
    """Return the number of nodes between the ends of bars.

    Writes the numbers of the lowest bars with nodes on them, and of these (k, 2); the lowest pairs of coinciding nodes
    (k, 2); and marks coinciding nodes, and ends of bars where such nodes are.
    """
    between = 0
    first = np.empty(3, np.int64)
    last = np.empty(3, np.int64)
    for k in range(len(ends)):
        a = ends[k, 0]
        b = ends[k, 1]
        tolerance = ANGLE * length[k]
        axis = (x[b] - x[a]) / length[k]
        n = int(np.ceil(length[k] / cell))
        for piece in range(n):
            begin = length[k] * piece / n
            end = length[k] * (piece + 1) / n
            _box(x, a, b, begin, end, length[k], low, cell, first, last)
            for z in range(first[2], last[2] + 1):
                for y in range(first[1], last[1] + 1):
                    row = (z * across[1] + y) * across[0]
                    at = np.searchsorted(keys, row + first[0])
                    while at < len(keys) and keys[at] <= row + last[0]:
                        node = at
                        at += 1
                        if numbers[node] == ids[a] or numbers[node] == ids[b]:
                            continue
                        d = points[node] - x[a]
                        along = (d * axis).sum()
                        # a node between two pieces belongs to the first of them
                        if along > end + tolerance * (piece == n - 1) or (along <= begin and piece > 0):
                            continue
                        if along < -tolerance:
                            continue
                        away = d - along * axis
                        if (away * away).sum() > tolerance * tolerance:
                            continue
                        if along <= tolerance or along >= length[k] - tolerance:
                            which = int(along > tolerance)
                            twins[node] = True
                            of_ends[k, which] = True
                            one = np.int64(ids[ends[k, which]])
                            _keep(pairs, min(one, numbers[node]), max(one, numbers[node]))
                        else:
                            between += 1
                            _keep(lowest, np.int64(bar_ids[k]), numbers[node])
    return between

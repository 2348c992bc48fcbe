"""Row sets: rows r(x) >= 0 over several nodes from any sources, on the ranks of their nodes, in groups that share
nodes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from ..errors import SimulationFailure
from ..mechanics.compiled import kernel
from ..mesh.exchange import GhostExchange, Router, swap
from ..mesh.slab import slab_of
from ..parallel.agreement import agreed
from ..parallel.natural import NaturalOrder
from ..tolerances import FREE_PART
from .constraints.base import Constraint
from .plugins import checked
from .projection import JAMMED, Groups, Planes, System, project_groups
from .rotations import along, minus, put, vector
from .sweeps import Pushes, RubbingRows

if TYPE_CHECKING:
    from ..mesh.distribution import DistributedMesh


def owner_starts(mesh: DistributedMesh) -> np.ndarray:
    """Return the first PETSc number owned by each rank, and the end, (ranks + 1,). Collective."""
    return np.concatenate([[0], np.cumsum(mesh.comm.allgather(mesh.n_owned))]).astype(np.int64)


def petsc_numbers(mesh: DistributedMesh, numbers: np.ndarray) -> np.ndarray:
    """Return the PETSc numbers of nodes given by mesh numbers (n,), which any rank may own. Collective."""
    order = PETSc.AO().createMemoryScalable(mesh.node_ids[: mesh.n_owned].astype(PETSc.IntType), comm=mesh.comm)
    found = order.app2petsc(numbers.astype(PETSc.IntType))
    order.destroy()
    return found.astype(np.int64)


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
    own, ends = rows, rows[:, columns].T
    order = np.argsort(ends.ravel(), kind="stable")
    keys, row = ends.ravel()[order], order % max(len(own), 1)
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
        begin = np.searchsorted(keys, wanted[:, 0])
        count = np.searchsorted(keys, wanted[:, 0], side="right") - begin
        place = np.arange(count.sum()) + np.repeat(begin - np.cumsum(count) + count, count)
        answer = Router(comm, np.repeat(wanted[:, 1], count)).send(own[row[place]])
        rows = once(np.concatenate([rows, answer]))


@kernel
def gather_rows(at, array, vectors):
    """Fill vectors (k, 3, r) of rows with nodes ``at`` (r, k) from those of nodes (n, 3)."""
    for r in range(len(at)):
        for k in range(at.shape[1]):
            i = at[r, k]
            for c in range(3):
                vectors[k, c, r] = array[i, c]


@kernel
def find_broken(groups, values, walls, x, tolerances):
    """Find groups with a row below its bound or a node beyond a wall; return their number.

    Parameters
    ----------
    groups : Groups
    values : (r,) of rows; walls : ``plane`` and ``planes`` of a System; x : (n, 3) positions
    tolerances : (groups,) in: a row among several that is violated by at most this counts as satisfied; out: the same,
        or the rounding of the group's positions, of the groups found, and -1 of the others
    """
    starts, rows, node_starts, nodes = groups
    (plane, planes), count = walls, 0
    for g in range(len(starts) - 1):
        least = tolerances[g] if starts[g + 1] - starts[g] > 1 else 0.0
        broken, largest = False, 0.0
        for q in range(starts[g], starts[g + 1]):
            broken = broken or not values[rows[q]] >= -least
        for q in range(node_starts[g], node_starts[g + 1]):
            i = nodes[q]
            largest = max(largest, abs(x[i, 0]), abs(x[i, 1]), abs(x[i, 2]))
            for w in range(planes.gaps.shape[1] if plane[i] >= 0 else 0):
                broken = broken or planes.gaps[plane[i], w] < 0.0
        tolerances[g] = max(tolerances[g], 16.0 * 2.0**-52 * largest) if broken else -1.0
        count += broken
    return count


@kernel
def advance_groups(which, groups, x, moves, at, tolerances, settled):
    """Set nodes of groups (g,) to x + moves (n, 3) in ``at`` (n, 3), and set ``settled`` (g,) if they were there
    already, to the tolerances (groups,)."""
    _, _, node_starts, nodes = groups
    for k in range(len(which)):
        settled[k] = True
        for q in range(node_starts[which[k]], node_starts[which[k] + 1]):
            i = nodes[q]
            place = along(vector(x, i), 1.0, vector(moves, i))
            way = minus(place, vector(at, i))
            settled[k] &= max(abs(way[0]), abs(way[1]), abs(way[2])) <= tolerances[which[k]]
            put(at, i, place)


@kernel
def linearise(which, rows, x, at, own):
    """Extrapolate ``own`` of some RubbingRows (m,) at positions ``at`` (n, 3) to ``x`` (n, 3), into their values."""
    for k in range(len(which)):
        total = 0.0
        for e in range(rows.ends.shape[1]):
            i = rows.ends[which[k], e]
            for c in range(3 if i >= 0 else 0):
                total += rows.gradients[which[k], e, c] * (x[i, c] - at[i, c]) if rows.soft[i, c] > 0.0 else 0.0
        rows.values[which[k]] = own[k] + total


@kernel
def add_forces(ends, gradients, normal, weights, drag, load):
    """Add forces of rows (r,) to those on their nodes (n, 3): ``normal`` (r,) times ``gradients`` (r, k, 3), and
    ``drag`` (r, 3) times ``weights`` (r, k) [N]."""
    for r in range(len(normal)):
        for k in range(ends.shape[1] if normal[r] != 0.0 else 0):
            i = ends[r, k]
            for c in range(3 if i >= 0 else 0):
                load[i, c] += normal[r] * gradients[r, k, c] + weights[r, k] * drag[r, c]


@kernel
def free_positions(where, predictor, u, far, x):
    """Fill positions x (n, 3) from predictor + u (owned, 3), or from ``far`` (m, 3 or more) for nodes of other ranks.

    ``where`` (n,): index of an owned node, else -1 minus the row of ``far``.
    """
    for k in range(len(where)):
        i = where[k]
        for c in range(3):
            x[k, c] = predictor[i, c] + u[i, c] if i >= 0 else far[-1 - i, c]


@kernel
def push_nodes(where, load, free, stiffness, u, contact):
    """Move owned nodes of u (owned, 3) by forces ``load`` (n, 3) of rows, and add these to ``contact`` (owned, 3)."""
    for k in range(len(where)):
        i = where[k]
        for c in range(3 if i >= 0 else 0):
            if load[k, c] != 0.0:
                u[i, c] += load[k, c] * free[k, c] / stiffness[i]
                contact[i, c] += load[k, c]


_ITERATIONS = 300  # linearisations of a problem
_TAG = 7700  # of messages between ranks with nodes of the same rows, distinct from those of ghosts


class FreeNodes(NamedTuple):
    """Nodes (n,) of rows in a step without the rows.

    Attributes
    ----------
    x, stiffness : (n, 3), (n,) positions, and forces for displacements [m], [N/m]
    start : (n, 3) positions at the start of the step, needed by rows that rub or push as there; None if none does
    at_start : whether rows push along their gradients at the start of the step, else at its end
    free : (n, 3) 1.0 where a component may move, else 0.0
    rub : whether rows with friction rub
    """

    x: np.ndarray
    stiffness: np.ndarray
    start: np.ndarray | None
    at_start: bool
    free: np.ndarray
    rub: bool = True


class WallsOfNodes(NamedTuple):
    """Walls that stop nodes of rows: ``planes`` at positions (n, 3), if rows alone move the nodes to others (n, 3); the
    index ``plane`` (n,) of each node there, -1 for none; and those for which they are ``varying`` (n,) with places."""

    plane: np.ndarray
    planes: Callable[[np.ndarray, np.ndarray], Planes]
    varying: np.ndarray


@dataclass(frozen=True)
class Alike:
    """Groups with equal numbers of rows and nodes: rows (g, p), nodes (g, q), and indices (g, p, k) of the rows' nodes
    among these, -1 for none."""

    rows: np.ndarray
    nodes: np.ndarray
    ends: np.ndarray

    def dense(self, values: np.ndarray) -> np.ndarray:
        """Return values (g, p, q, ...) at the nodes of groups from those at the nodes of rows (g, p, k, ...)."""
        dense = np.zeros((*self.rows.shape, self.nodes.shape[1], *values.shape[3:]))
        group, row, end = np.nonzero(self.ends >= 0)
        dense[group, row, self.ends[group, row, end]] = values[group, row, end]
        return dense


class RowSet:
    """The rows of all sources on this rank: those of its nodes, and those of their groups. Construction is collective.

    Attributes
    ----------
    sources : of the rows here
    source, ids : (r,) index of the source of each row, and the row's number there
    fixed : (r,) bool, rows whose gradients never turn
    ends, owners : (r, k) indices of its nodes, padded with -1, and the ranks that own them; last : (r,) position of the
        last node
    numbers : (n,) mesh numbers of the nodes, ascending
    where : (n,) local index of an owned node, else -1 minus its row among those of other ranks
    mine, here : (n,) bool, nodes that this rank owns, and their local indices (m,)
    partners : GhostExchange for values at nodes that other ranks own
    counted : (r,) bool, rows whose last node this rank owns
    fixed_jacobian : (r, k, 3) gradients of fixed rows, zero for others
    table : (r, 2 + k + m) int64: source, number, mesh numbers of the nodes, and the source's data as integers
    free : (n, 3) 1.0 where a component may move, 0.0 where a support prescribes it
    groups : Groups; group_of_row, group_of_node : (r,), (n,)
    weights, friction, restitution : (r, k), (r, 2), (r,) see :class:`~pfem_petsc.contact.constraints.base.Constraint`
    rubs, rebounds : whether any table of rows of the model has friction, restitution
    """

    def __init__(self, sources: Sequence[Constraint], mesh: DistributedMesh, fixed: np.ndarray) -> None:
        self.mesh = mesh
        self._find(sources)
        self.fixed = np.array([source.fixed for source in sources], dtype=bool)[self.source]
        self.mine = self.where >= 0
        self.here = self.where[self.mine]
        self._away = np.flatnonzero(~self.mine)
        self._far = -1 - self.where[self._away]
        self.free = 1.0 - self.gather(fixed)
        nowhere = Planes(np.empty((0, 0, 3)), np.empty((0, 0)), np.empty((0, 0, 2)), np.empty((0, 0, 3)))
        self._no_planes = np.full(len(self.numbers), -1), nowhere
        self.friction = np.array([source.friction for source in sources]).reshape(-1, 2)[self.source]
        self.restitution = np.array([source.restitution for source in sources], dtype=float)[self.source]
        self.rubs = any(source.friction[1] > 0.0 for source in sources)
        self.rebounds = any(source.restitution > 0.0 for source in sources)
        self.weights = np.zeros(self.ends.shape)
        for source, first in zip(self.sources, self._first, strict=False):
            self.weights[first : first + len(source.nodes), : source.nodes.shape[1]] = source.weights()
        self._gather_groups()
        every = np.arange(len(self.ends))
        self.counted = self.mine[self.ends[every, self.last]]
        self.last_nodes = self.where[self.ends[every, self.last]]
        self._last_owners = self.owners[every, self.last]
        self._keys = self.ids * max(len(self.sources), 1) + self.source
        self.fixed_jacobian = np.zeros((*self.ends.shape, 3))
        at = np.flatnonzero(self.fixed)
        with agreed(mesh.comm):
            if len(at):
                self.fixed_jacobian[at] = self.gradients(np.zeros((len(self.numbers), 3)), at)

    def _find(self, sources: Sequence[Constraint]) -> None:
        """Send the rows of all sources to the ranks of their nodes."""
        mesh, comm = self.mesh, self.mesh.comm
        shapes = np.array([[*source.nodes.shape, source.data.shape[1]] for source in sources], dtype=np.int64)
        shapes = shapes.reshape(-1, 3)
        before, largest = np.zeros_like(shapes), shapes.copy()
        comm.Exscan(shapes, before)
        comm.Allreduce(MPI.IN_PLACE, largest, op=MPI.MAX)
        self._widths, self._data = largest[:, 1:].T
        k, m = int(self._widths.max(initial=2)), int(self._data.max(initial=0))
        every = np.concatenate([np.empty(0, dtype=np.int64), *(source.nodes.ravel() for source in sources)])
        at = petsc_numbers(mesh, every) if sources else every
        tables, first = [np.empty((0, 2 + 2 * k + m), dtype=np.int64)], 0
        for s, source in enumerate(sources):
            n, width = len(source.nodes), int(self._widths[s])
            table = np.full((n, 2 + 2 * k + m), -1, dtype=np.int64)
            table[:, 0] = s
            table[:, 1] = (before[s, 0] if comm.rank else 0) + np.arange(n) if source.ids is None else source.ids
            table[:, 2 : 2 + width] = at[first : first + n * width].reshape(n, width)
            table[:, 2 + k : 2 + k + width] = source.nodes.reshape(n, width)
            table[:, 2 + 2 * k : 2 + 2 * k + source.data.shape[1]] = source.data.view(np.int64)
            tables.append(table)
            first += n * width
        starts, columns = owner_starts(mesh), range(2, 2 + k)
        rows = with_groups(to_owners(np.concatenate(tables), columns, starts, comm), columns, starts, comm)
        self.source, self.ids = rows[:, 0].copy(), rows[:, 1].copy()
        self.table = np.delete(rows, slice(2, 2 + k), axis=1)
        self.last = self._widths[self.source] - 1
        at, number = rows[:, 2 : 2 + k], rows[:, 2 + k : 2 + 2 * k]
        some = at >= 0
        self.numbers, which, place = np.unique(number[some], return_index=True, return_inverse=True)
        self.ends = np.full(at.shape, -1)
        self.ends[some] = place.ravel()
        self.owners = np.searchsorted(starts, at, side="right") - 1
        own = at[some][which]
        mine = (own >= starts[comm.rank]) & (own < starts[comm.rank + 1])
        ghosts = np.unique(own[~mine])
        self.where = np.where(mine, own - starts[comm.rank], -1 - np.searchsorted(ghosts, own))
        self.partners = GhostExchange(comm, starts, ghosts, _TAG)
        self._first = np.searchsorted(self.source, np.arange(len(sources) + 1))
        self.sources, self._at = [], []
        for s, source in enumerate(sources):
            part, width = slice(self._first[s], self._first[s + 1]), int(self._widths[s])
            data = np.ascontiguousarray(rows[part, 2 + 2 * k : 2 + 2 * k + int(self._data[s])]).view(np.float64)
            self.sources.append(source.of(number[part, :width].copy(), data))
            self._at.append(np.ascontiguousarray(self.ends[part, :width]))

    def _gather_groups(self) -> None:
        count, self.group_of_node = _connected(self.ends, len(self.numbers))
        self.group_of_row = self.group_of_node[self.ends[:, 0]]
        nodes = np.argsort(self.group_of_node, kind="stable")
        rows = np.argsort(self.group_of_row, kind="stable")
        every = np.arange(count + 1)
        starts = np.searchsorted(self.group_of_row[rows], every)
        self.groups = Groups(starts, rows, np.searchsorted(self.group_of_node[nodes], every), nodes)
        self._turning = np.zeros(count, dtype=bool)
        self._turning[self.group_of_row[~self.fixed]] = True

    @cached_property
    def order(self) -> NaturalOrder:
        """The order of the counted rows over all ranks, by their numbers and sources. Collective at first use."""
        comm, keys = self.mesh.comm, self._keys[self.counted]
        end = comm.allreduce(int(keys.max(initial=0)), op=MPI.MAX) + 1
        router = Router(comm, slab_of(keys, end, comm.size))
        asked = router.send(keys)
        place = np.empty(len(asked), dtype=np.int64)
        place[np.argsort(asked)] = np.arange(len(asked))
        counts = comm.allgather(len(asked))
        return NaturalOrder(comm, router.reply(sum(counts[: comm.rank]) + place), sum(counts))

    @cached_property
    def moving(self) -> np.ndarray:
        """Owned nodes (m,), ascending, of the rows of any rank."""
        return np.union1d(self.here, self.partners.rows)

    @cached_property
    def alike(self) -> list[Alike]:
        """Return all groups, collected by shape."""
        starts, members, node_starts, nodes = self.groups
        shapes, found = np.stack([np.diff(starts), np.diff(node_starts)]), []
        place = np.empty(len(self.numbers), dtype=np.int64)
        place[nodes] = np.arange(len(nodes)) - node_starts[self.group_of_node[nodes]]
        for p, q in np.unique(shapes, axis=1).T:
            groups = np.flatnonzero((shapes[0] == p) & (shapes[1] == q))
            rows = members[starts[groups][:, None] + np.arange(p)]
            own = nodes[node_starts[groups][:, None] + np.arange(q)]
            found.append(Alike(rows, own, np.where(self.ends[rows] < 0, -1, place[self.ends[rows]])))
        return found

    def alike_of(self, which: np.ndarray) -> list[Alike]:
        """Return some of the groups, (groups,) bool, collected by shape."""
        parts = ((each, which[self.group_of_row[each.rows[:, 0]]]) for each in self.alike)
        return [Alike(each.rows[some], each.nodes[some], each.ends[some]) for each, some in parts if some.any()]

    def gather(self, values: np.ndarray) -> np.ndarray:
        """Return float64 values (n, ...) at the nodes from those at owned nodes (owned, ...). Collective."""
        width = int(np.prod(values.shape[1:]))
        every = self.collect(lambda at: values[at].reshape(len(at), width))
        return every.reshape(len(every), *values.shape[1:]).astype(float, copy=False)

    def spread(self, values: np.ndarray, far: np.ndarray) -> np.ndarray:
        """Return values (n, ...) at the nodes from those at owned nodes (owned, ...) and those received (m, ...)."""
        if len(self._away) == 0:
            return values.take(self.where, axis=0)
        every = np.empty((len(self.numbers), *values.shape[1:]))
        every[self.mine] = values[self.here]
        if every.size:
            every[self._away] = far[self._far]
        return every

    def of_counted(self, values: np.ndarray, other: RowSet | None = None) -> np.ndarray:
        """Return values (r, ...) of the rows here from those of the counted rows (c, ...) of this set or of an earlier
        one, zero for rows that it does not have. Collective."""
        other = self if other is None else other
        known = other._keys[other.counted]
        order = np.argsort(known)
        asking = Router(self.mesh.comm, self._last_owners)
        asked = asking.send(self._keys)
        at = np.searchsorted(known[order], asked)
        there = at < len(known)
        there[there] = known[order[at[there]]] == asked[there]
        answer = np.zeros((len(asked), *values.shape[1:]), dtype=values.dtype)
        answer[there] = values[order[at[there]]]
        return asking.reply(answer)

    def _each(self, rows: np.ndarray | None, method: str, *arrays: np.ndarray) -> list[np.ndarray]:
        """Return the results of a method of each source for arrays (n, 3), for some rows, ascending, or all."""
        found = []
        for source, at, first in zip(self.sources, self._at, self._first, strict=False):
            if rows is not None:
                begin, end = np.searchsorted(rows, (first, first + len(at)))
                some = rows[begin:end] - first
                if end - begin < len(at):
                    source, at = source.of(source.nodes[some], source.data[some]), at[some]
            function = checked(getattr(source, method), f"constraint {source.name!r}: {method}")
            found.append(function(*(_of_rows(at, array) for array in arrays)))
        return found

    def values(self, x: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
        """Rows (r,) [m] at positions (n, 3); of some rows, ascending, if they are given, as below."""
        return _joined(self._each(rows, "values", x)) if self.sources else np.empty(0)

    def gradients(self, x: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
        """Gradients (r, k, 3) at positions (n, 3), zero behind the last node of a row."""
        width, parts = self.ends.shape[1], self._each(rows, "gradients", x)
        for s, part in enumerate(parts):
            if part.shape[1] < width:
                parts[s] = np.concatenate([part, np.zeros((len(part), width - part.shape[1], 3))], axis=1)
        return _joined(parts)

    def drift(self, x: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Second derivatives (r,) by time of rows whose nodes at (n, 3) move straight on with v (n, 3) [m/s2]."""
        return np.concatenate(self._each(None, "drift", x, v))

    def along(self, jacobian: np.ndarray, y: np.ndarray) -> np.ndarray:
        """J y (r,) of gradients (r, k, 3) and vectors (n, 3)."""
        vectors = np.where(self.ends[:, :, None] < 0, 0.0, y[self.ends])
        total = np.zeros(len(vectors))
        for products in np.einsum("rki,rki->kr", jacobian, vectors):
            total += products
        return total

    def collect(self, of_nodes: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """Return values (n, m) at the nodes; ``of_nodes`` gives (k, m) at owned nodes (k,). Collective."""
        own = of_nodes(self.here)
        if len(self._away) == 0 and self.partners.alone:
            return own
        every = np.empty((len(self.numbers), own.shape[1]))
        if own.shape[1]:
            every[self.mine] = own
            every[self._away] = self.partners.bring(of_nodes(self.partners.rows))[self._far]
        return every

    def slips(self, y: np.ndarray) -> np.ndarray:
        """Return sums of weights times vectors (n, 3) of nodes, (r, 3)."""
        return np.einsum("rk,rki->ri", self.weights, y[self.ends])

    def forces(self, jacobian: np.ndarray, force: np.ndarray, drag: np.ndarray | None = None) -> np.ndarray:
        """Return J^T f (n, 3) [N] for the forces (r,) of the rows, and their drags (r, 3) times weights [N]."""
        total, drag = np.zeros((len(self.numbers), 3)), np.zeros((len(force), 3)) if drag is None else drag
        add_forces(self.ends, jacobian, force, self.weights, drag, total)
        return total

    def usable(self, jacobian: np.ndarray) -> np.ndarray:
        """Return (r,) bool: rows with free components, which can be satisfied."""
        return self.along(jacobian**2, self.free) > FREE_PART

    def system(
        self,
        jacobian: np.ndarray,
        values: np.ndarray,
        nodes: FreeNodes,
        plane: np.ndarray,
        planes: Planes,
    ) -> System:
        """Return rows (r,) with gradients (r, k, 3), and planes of walls at nodes, for :meth:`solve`."""
        slips, friction = np.zeros((len(values), 3)), self.friction
        if self.rubs and nodes.rub:
            slips = self.slips(nodes.x - nodes.start)
        elif self.rubs:
            friction = np.zeros_like(friction)
        soft, room = nodes.free / nodes.stiffness[:, None], np.empty((0, 2))
        rows = RubbingRows(self.ends, self.weights, jacobian, slips[:0], values, slips, friction, soft, room)
        return System(rows, plane, planes)

    def gather_of(self, at: np.ndarray, of_nodes: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """Return values (2, m, n) at the first two nodes of rows ``at`` (m,); ``of_nodes`` gives (k, n) at owned nodes.

        Ranks that own one of the two nodes must request the row at the same time; only these two communicate.
        """
        where = self.where[self.ends[at, :2]].T
        mine = where >= 0
        own = of_nodes(where[mine])
        data = np.zeros((*where.shape, own.shape[1]))
        data[mine] = own
        cut = np.flatnonzero(mine[0] != mine[1])
        if len(cut):
            end = np.where(mine[0, cut], 0, 1)
            data[1 - end, cut] = swap(self.mesh.comm, self.owners[at[cut], 1 - end], data[end, cut])
        return data

    def solve(self, system: System, tolerance: float, size: float) -> Pushes:
        """Return the forces that satisfy linear rows; those violated by at most the tolerance count as satisfied;
        ``size``: largest value of what moves the rows.

        Raises
        ------
        SimulationFailure
            On ranks with rows that are infeasible.
        """
        pushes, nowhere = self._no_pushes(), np.zeros((len(self.numbers), 3))
        groups, tolerances = self._broken(system.rows.values, (system.plane, system.planes), nowhere, tolerance)
        self._solve(groups, system, tolerances, size, pushes)
        return pushes

    def _no_pushes(self) -> Pushes:
        return Pushes(np.zeros(len(self.source)), np.zeros((len(self.source), 3)), np.zeros((len(self.numbers), 3)))

    def _broken(
        self, values: np.ndarray, walls: tuple[np.ndarray, Planes], x: np.ndarray, tolerance: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the groups (g,) with rows below their bounds or nodes at (n, 3) beyond walls, and the tolerances of
        all groups."""
        tolerances = np.full(len(self.groups.starts) - 1, tolerance)
        if not find_broken(self.groups, values, walls, x, tolerances):
            return np.empty(0, dtype=np.int64), tolerances
        return np.flatnonzero(~(tolerances < 0.0)), tolerances

    def _solve(self, which: np.ndarray, system: System, tolerances: np.ndarray, size: float, pushes: Pushes) -> None:
        group, why = project_groups(which, self.groups, system, tolerances, size, pushes)
        if group >= 0:
            raise SimulationFailure(self.unsolved(group, why))

    def unsolved(self, group: int, why: int) -> str:
        """Return the message about a group without a solution."""
        shown = self._shown(group)
        if why != JAMMED:
            return f"no positions of nodes {shown} satisfy their contact pairs, constraints, walls and supports"
        return (
            f"the friction of nodes {shown} in contact pairs and on walls did not converge: they may be "
            "jammed between walls and supports; reduce the friction, free the nodes, or reduce time.step"
        )

    def _shown(self, group: int) -> str:
        _, _, starts, nodes = self.groups
        return ", ".join(str(number) for number in self.numbers[nodes[starts[group] : starts[group + 1]]][:6])

    def project(
        self, nodes: FreeNodes, tolerance: float, walls: WallsOfNodes | None = None, lift: np.ndarray | float = 0.0
    ) -> tuple[Pushes, np.ndarray]:
        """Return the forces that satisfy the rows, and the gradients (r, k, 3) along which they act.

        Parameters
        ----------
        nodes : FreeNodes
        tolerance : [m]
        walls : at the nodes, if there are any
        lift : (r,) by how much the bounds of rows are above zero [m]

        Raises
        ------
        SimulationFailure
            On ranks with rows that are infeasible.
        """
        x, jacobian, pushes = nodes.x, self.fixed_jacobian, self._no_pushes()
        values, planes = self.values(x) - lift, self._no_planes
        if walls is not None:
            planes = walls.plane, walls.planes(x, x)
        groups, tolerances = self._broken(values, planes, x, tolerance)
        if len(groups) == 0:
            return pushes, jacobian
        size, again = float(np.abs(x).max()), self._turning
        if walls is not None:
            again = again.copy()
            again[self.group_of_node[walls.varying]] = True
        if not again[groups].any():
            self._solve(groups, self.system(jacobian, values, nodes, *planes), tolerances, size, pushes)
            return pushes, jacobian
        jacobian, at, rows, chosen = jacobian.copy(), x.copy(), None, np.empty(len(again), dtype=bool)
        system = self.system(jacobian, values, nodes, *planes)
        lift, pushed = np.broadcast_to(lift, len(self.source)), x.copy()
        for _ in range(_ITERATIONS):
            chosen[:] = False
            chosen[groups] = True
            fewer = np.flatnonzero(chosen[self.group_of_row])
            turned = fewer[~self.fixed[fewer]]
            if rows is None or not nodes.at_start:
                jacobian[turned] = self.gradients(nodes.start if nodes.at_start else at, turned)
            if rows is not None:
                linearise(fewer, system.rows, x, at, self.values(at, fewer) - lift[fewer])
                if walls is not None:
                    load = self.forces(jacobian, pushes.normal, pushes.drag) * nodes.free
                    pushed += 0.5 * (x + load / nodes.stiffness[:, None] - pushed)  # or walls may alternate
                    system = system._replace(planes=walls.planes(at, pushed))
            rows = fewer
            self._solve(groups, system, tolerances, size, pushes)
            settled = np.empty(len(groups), dtype=bool)
            advance_groups(groups, self.groups, x, pushes.moves, at, tolerances, settled)
            groups = groups[~settled & again[groups]]
            if len(groups) == 0:
                return pushes, jacobian
        raise SimulationFailure(
            f"the positions of nodes {self._shown(int(groups[0]))} on their constraints and walls did not converge in "
            f"{_ITERATIONS} iterations; reduce time.step"
        )


class TwoNodeRows:
    """The rows of a set over two nodes with opposite gradients that never turn. Construction is collective.

    Attributes
    ----------
    rows : RowSet
    at : (p,) which rows of the set
    every : whether these are all rows of the set on this rank, no two of them with a common node
    ends, nodes : (2, p) nodes of the rows among those of the set, and their local indices, negative at other ranks
    normals, least : (p, 3) unit directions; (p,) bounds [m], of rows n . (x_2 - x_1) >= least
    along : (2, p) squared lengths of the free parts of the directions
    counted : (p,) bool, rows whose second node this rank owns
    restitution : (p,) coefficients
    """

    def __init__(self, rows: RowSet) -> None:
        self.rows, gradients = rows, rows.fixed_jacobian
        opposite = (gradients[:, 0] == -gradients[:, 1]).all(axis=1)
        self.at = np.flatnonzero(rows.fixed & (rows.last == 1) & opposite)
        self.every = len(self.at) == len(rows.source) and len(rows.numbers) == 2 * len(self.at)
        self.ends = np.ascontiguousarray(rows.ends[self.at, :2].T)
        self.nodes = rows.where[self.ends]
        self.counted = rows.counted[self.at]
        mine = self.nodes >= 0
        self._cut = np.flatnonzero(mine[0] != mine[1])
        self._others = rows.owners[self.at[self._cut], np.where(mine[0, self._cut], 1, 0)]
        self.normals = np.ascontiguousarray(gradients[self.at, 1])
        self.least = np.empty(0)
        if len(self.at):
            self.least = 0.0 - rows.values(np.zeros((len(rows.numbers), 3)))[self.at]
        self._free = rows.free[self.ends]
        self.along = (self._free * self.normals**2).sum(axis=2)
        self.restitution = rows.restitution[self.at]

    def agree(self, force: np.ndarray) -> None:
        """Replace forces (r,) of the set's rows, where two ranks have them, by those of the rank of the second node: if
        they differed by rounding, a row could be closed on one rank only. Collective."""
        if len(self._cut):
            at = self.at[self._cut]
            theirs = swap(self.rows.mesh.comm, self._others, force[at, None])[:, 0]
            force[at] = np.where(self.counted[self._cut], force[at], theirs)

    def gather(self, values: np.ndarray) -> np.ndarray:
        """Return values (2, p, ...) at the nodes of rows from those at owned nodes (owned, ...). Collective."""
        return self.rows.gather(values)[self.ends]

    def apart(self, ends: np.ndarray) -> np.ndarray:
        """Return n . (y_2 - y_1) (p,) of vectors (2, p, 3)."""
        return np.einsum("pi,pi->p", self.normals, ends[1] - ends[0])

    def pressed(self, force: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return owned nodes (m,) of rows with positive forces (p,), and the directions of their rows (m, 3)."""
        end, row = np.nonzero((self.nodes >= 0) & (force > 0.0))
        return self.nodes[end, row], self.normals[row]

    def together(
        self, values: np.ndarray, mass: np.ndarray, which: np.ndarray, rates: np.ndarray | float = 0.0
    ) -> np.ndarray:
        """Return velocities or accelerations (owned, 3) at which the nodes of rows ``which`` (p,) bool separate at
        ``rates`` (p,), with the same momentum; the rows share no nodes. Collective."""
        ends, masses = self.gather(values), self.gather(mass)
        gives = (self.along / masses).sum(axis=0)
        force = np.where(which & (gives > 0.0), rates - self.apart(ends), 0.0) / np.maximum(gives, 1e-300)
        end, row = np.nonzero((self.nodes >= 0) & (force != 0.0))
        push = (np.where(end == 1, force[row], -force[row])[:, None] * self.normals[row]) * self._free[end, row]
        same = values.copy()
        same[self.nodes[end, row]] += push / masses[end, row, None]
        return same

    def reduced_mass(self, mass: np.ndarray) -> np.ndarray:
        """Return 1/(1/m_1 + 1/m_2) (p,) [kg] along the directions, from masses of owned nodes (owned,). Collective."""
        gives = (self.along / self.gather(mass)).sum(axis=0)
        return 1.0 / np.maximum(gives, 1e-300)

    def close(self, at: np.ndarray, force: np.ndarray, ends: np.ndarray, slack: float) -> tuple[np.ndarray, float]:
        """Return which rows are closed (m,), and the energy [J] that those lose which close and whose second nodes this
        rank owns, see :mod:`~pfem_petsc.stepping.impact`.

        Parameters
        ----------
        at : (m,) rows whose force begins or ends; force : (m,) theirs
        ends : (2, m, 10) position, velocity and acceleration without contact, and mass of their nodes
        slack : distance at which a row has opened [m]
        """
        apart = (ends[1] - ends[0])[:, :9].reshape(-1, 3, 3)
        distance, speed, pull = np.einsum("mi,mki->km", self.normals[at], apart)
        distance, fresh = distance - self.least[at], force > 0.0
        square = np.maximum(speed * speed - 2.0 * pull * np.maximum(distance, 0.0), 0.0)
        gives = (self.along[:, at] / ends[:, :, 9]).sum(axis=0)
        lost = 0.5 * square / np.maximum(gives, 1e-300) * (1.0 - self.restitution[at] ** 2)
        return fresh | (distance <= slack), float(lost[fresh & (speed < 0.0) & self.counted[at]].sum())


def _connected(ends: np.ndarray, n: int) -> tuple[int, np.ndarray]:
    """Return how many groups of nodes rows (r, k) connect, and the group of each node (n,); lowest nodes first."""
    if n == 0:
        return 0, np.empty(0, dtype=np.int64)
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    row, end = np.nonzero(ends >= 0)
    graph = coo_matrix((np.ones(len(row)), (ends[row, 0], ends[row, end])), (n, n))
    return connected_components(graph, directed=False)


def _of_rows(at: np.ndarray, array: np.ndarray) -> np.ndarray:
    """Vectors (r, k, 3) of rows with nodes ``at`` (r, k), from those of nodes (n, 3); rows are next to each other in
    memory, so that sums and differences over their nodes and components are as fast as they can be."""
    vectors = np.empty((at.shape[1], 3, len(at)))
    gather_rows(at, array, vectors)
    return vectors.transpose(2, 0, 1)


def _joined(parts: list[np.ndarray]) -> np.ndarray:
    return np.ascontiguousarray(parts[0]) if len(parts) == 1 else np.concatenate(parts)

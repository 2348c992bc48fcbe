"""Rows over several nodes, r(x) >= 0, from any source: layout, groups that share nodes, and their explicit solution."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..errors import SimulationFailure
from ..mechanics.compiled import kernel
from ..mesh.exchange import GhostExchange, Router
from ..parallel.natural import NaturalOrder
from ..tolerances import FREE_PART
from .constraints.base import Constraint
from .projection import find_multipliers
from .row_search import owner_starts, petsc_numbers, to_owners, with_groups

if TYPE_CHECKING:
    from ..mesh.distribution import DistributedMesh


@kernel
def _root(parent, i):
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@kernel
def group_rows(ends, n, label):
    """Label nodes (n,) with the lowest node to which rows (r, k) connect them."""
    for i in range(n):
        label[i] = i
    for r in range(len(ends)):
        for k in range(1, ends.shape[1]):
            if ends[r, k] < 0:
                continue
            a, b = _root(label, ends[r, 0]), _root(label, ends[r, k])
            if a < b:
                label[b] = a
            else:
                label[a] = b
    for i in range(n):
        label[i] = _root(label, i)


@kernel
def leaving_nodes(rows, predictor, u, stiffness, start, leaving):
    """Write predictor + u and stiffness of owned nodes (m,) into ``leaving`` (m, 4...), and initial positions unless
    these are (0, 3)."""
    started = len(start) > 0
    for k in range(len(rows)):
        i = rows[k]
        for c in range(3):
            leaving[k, c] = predictor[i, c] + u[i, c]
            if started:
                leaving[k, 4 + c] = start[i, c]
        leaving[k, 3] = stiffness[i]


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
def free_stiffness(where, stiffness, far, hard):
    """Fill the stiffness (n,) of the same nodes from owned nodes (owned,) and ``far`` (m, 4 or more)."""
    for k in range(len(where)):
        hard[k] = stiffness[where[k]] if where[k] >= 0 else far[-1 - where[k], 3]


@kernel
def gather_rows(at, array, vectors):
    """Fill vectors (k, 3, r) of rows with nodes ``at`` (r, k) from those of nodes (n, 3)."""
    for r in range(len(at)):
        for k in range(at.shape[1]):
            i = at[r, k]
            for c in range(3):
                vectors[k, c, r] = array[i, c]


@kernel
def broken_groups(starts, rows, node_starts, nodes, values, x, near, tolerance, chosen, tolerances):
    """Mark groups with a row below its bound, or with nodes near walls; return their number.

    Parameters
    ----------
    starts, rows, node_starts, nodes : rows and nodes of each group: rows[starts[g] : starts[g + 1]]
    values : (r,) rows; x : (n, 3) positions; near : (n,) bool, (0,) for none
    tolerance : a row violated by at most this, or by rounding of the group's positions, counts as satisfied
    chosen, tolerances : (groups,) output; tolerances of chosen groups only
    """
    count = 0
    walled = len(near) > 0
    for g in range(len(starts) - 1):
        broken = False
        for q in range(starts[g], starts[g + 1]):
            broken = broken or not values[rows[q]] >= -tolerance
        if walled and not broken:
            for q in range(node_starts[g], node_starts[g + 1]):
                broken = broken or near[nodes[q]]
        chosen[g] = broken
        if broken:
            largest = 0.0
            for q in range(node_starts[g], node_starts[g + 1]):
                for c in range(3):
                    largest = max(largest, abs(x[nodes[q], c]))
            tolerances[g] = max(tolerance, 16.0 * 2.0**-52 * largest)
            count += 1
    return count


@kernel
def advance_groups(groups, node_starts, nodes, x, moves, at, tolerances, settled):
    """Set nodes of groups (g,) to x + moves (n, 3) in ``at`` (n, 3), and set ``settled`` (g,) if they were there
    already, to the tolerances (groups,)."""
    for k in range(len(groups)):
        g = groups[k]
        same = True
        for q in range(node_starts[g], node_starts[g + 1]):
            i = nodes[q]
            for c in range(3):
                place = x[i, c] + moves[i, c]
                same = same and abs(place - at[i, c]) <= tolerances[g]
                at[i, c] = place
        settled[k] = same


@kernel
def linearise(rows, ends, gradients, free, x, at, own, values):
    """Write ``own`` of rows (m,) at positions ``at`` (n, 3), extrapolated to ``x`` (n, 3), into ``values`` (r,)."""
    for k in range(len(rows)):
        r = rows[k]
        total = 0.0
        for e in range(ends.shape[1]):
            i = ends[r, e]
            if i >= 0:
                for c in range(3):
                    total += gradients[r, e, c] * free[i, c] * (x[i, c] - at[i, c])
        values[r] = own[k] + total


@kernel
def last_forces(counted, source, last, gradients, force, totals):
    """Add the forces of counted rows on their last nodes to the totals (sources, 3)."""
    for r in range(len(force)):
        if force[r] != 0.0 and counted[r]:
            for c in range(3):
                totals[source[r], c] += force[r] * gradients[r, last[r], c]


@kernel
def add_forces(ends, gradients, force, load):
    """Add the forces (r,) of rows to those on their nodes (n, 3)."""
    for r in range(len(force)):
        if force[r] == 0.0:
            continue
        for k in range(ends.shape[1]):
            i = ends[r, k]
            if i >= 0:
                for c in range(3):
                    load[i, c] += force[r] * gradients[r, k, c]


@kernel
def push_nodes(where, load, free, stiffness, u, contact):
    """Move owned nodes of u (owned, 3) by forces ``load`` (n, 3) of rows, and add these to ``contact`` (owned, 3)."""
    for k in range(len(where)):
        i = where[k]
        if i < 0:
            continue
        for c in range(3):
            if load[k, c] != 0.0:
                u[i, c] += load[k, c] * free[k, c] / stiffness[i]
                contact[i, c] += load[k, c]


@kernel
def mark_pressed(ends, where, force, held):
    """Mark owned nodes (owned,) with active rows; return the number of marks."""
    count = 0
    for r in range(len(force)):
        if force[r] > 0.0:
            for k in range(ends.shape[1]):
                if ends[r, k] >= 0 and where[ends[r, k]] >= 0:
                    held[where[ends[r, k]]] = True
                    count += 1
    return count


_TAG = 7700  # of messages between ranks with nodes of the same rows, distinct from those of ghosts and pairs


@dataclass(frozen=True)
class Alike:
    """Groups with equal numbers of rows and nodes: rows (g, p), nodes (g, q), and indices (g, p, k) of the rows' nodes
    among these, -1 for none."""

    rows: np.ndarray
    nodes: np.ndarray
    ends: np.ndarray

    def dense(self, gradients: np.ndarray) -> np.ndarray:
        """Return gradients (g, p, 3 q) from those of rows (g, p, k, 3)."""
        dense = np.zeros((*self.rows.shape, self.nodes.shape[1], 3))
        group, row, end = np.nonzero(self.ends >= 0)
        dense[group, row, self.ends[group, row, end]] = gradients[group, row, end]
        return dense.reshape(*self.rows.shape, -1)


class RowLayout:
    """The rows of all sources on this rank: those of its nodes, and those of their groups. Construction is collective.

    Attributes
    ----------
    sources : of the rows here
    source, ids : (r,) index of the source of each row, and the row's number there
    ends : (r, k) indices of its nodes, padded with -1; last : (r,) position of the last node
    numbers : (n,) mesh numbers of the nodes, ascending
    where : (n,) local index of an owned node, else -1 minus its row among those of other ranks
    mine, here : (n,) bool, nodes that this rank owns, and their local indices (m,)
    partners : GhostExchange for values at nodes that other ranks own
    counted : (r,) bool, rows whose last node this rank owns; order : their numbering over all ranks
    last_owners : (r,) rank that owns the last node of each row
    free : (n, 3) 1.0 where a component may move, 0.0 where a support prescribes it
    starts, members, node_starts, nodes : rows and nodes of each group: members[starts[g] : starts[g + 1]]
    """

    def __init__(self, sources: Sequence[Constraint], mesh: DistributedMesh, fixed: np.ndarray) -> None:
        self.mesh = mesh
        self._find(sources)
        self.mine = self.where >= 0
        self.here = self.where[self.mine]
        self._away = np.flatnonzero(~self.mine)
        self._far = -1 - self.where[self._away]
        self.free = self.gather(np.where(fixed, 0.0, 1.0))
        self._gather_groups()
        self.counted = self.mine[self.ends[np.arange(len(self.ends)), self.last]]
        counts = mesh.comm.allreduce(np.bincount(self.source[self.counted], minlength=len(self.sources)))
        numbers = (np.cumsum(counts) - counts)[self.source] + self.ids
        self.order = NaturalOrder(mesh.comm, numbers[self.counted], int(counts.sum()))

    def _find(self, sources: Sequence[Constraint]) -> None:
        """Send the rows of all sources to the ranks of their nodes."""
        mesh, comm = self.mesh, self.mesh.comm
        shapes = np.array([[*source.nodes.shape, source.data.shape[1]] for source in sources])
        before, largest = np.zeros_like(shapes), shapes.copy()
        comm.Exscan(shapes, before)
        comm.Allreduce(MPI.IN_PLACE, largest, op=MPI.MAX)
        self._widths, self._data = largest[:, 1:].T
        k, m = int(self._widths.max()), int(self._data.max())
        every = np.concatenate([source.nodes.ravel() for source in sources]).astype(np.int64)
        at = petsc_numbers(mesh, every)
        tables, first = [], 0
        for s, source in enumerate(sources):
            n, width = len(source.nodes), int(self._widths[s])
            table = np.full((n, 2 + 2 * k + m), -1, dtype=np.int64)
            table[:, 0], table[:, 1] = s, (before[s, 0] if comm.rank else 0) + np.arange(n)
            table[:, 2 : 2 + width] = at[first : first + n * width].reshape(n, width)
            table[:, 2 + k : 2 + k + width] = source.nodes.reshape(n, width)
            table[:, 2 + 2 * k : 2 + 2 * k + source.data.shape[1]] = source.data.view(np.int64)
            tables.append(table)
            first += n * width
        starts, columns = owner_starts(mesh), range(2, 2 + k)
        rows = with_groups(to_owners(np.concatenate(tables), columns, starts, comm), columns, starts, comm)
        self.source, self.ids = rows[:, 0].copy(), rows[:, 1].copy()
        self.last = self._widths[self.source] - 1
        at, number = rows[:, 2 : 2 + k], rows[:, 2 + k : 2 + 2 * k]
        some = at >= 0
        self.numbers, which, place = np.unique(number[some], return_index=True, return_inverse=True)
        self.ends = np.full(at.shape, -1)
        self.ends[some] = place.ravel()
        own = at[some][which]
        mine = (own >= starts[comm.rank]) & (own < starts[comm.rank + 1])
        ghosts = np.unique(own[~mine])
        self.where = np.where(mine, own - starts[comm.rank], -1 - np.searchsorted(ghosts, own))
        self.partners = GhostExchange(comm, starts, ghosts, _TAG)
        end = at[np.arange(len(at)), self.last]
        self.last_owners = np.searchsorted(starts, end, side="right") - 1
        self._first = np.searchsorted(self.source, np.arange(len(sources) + 1))
        self.sources, self._at = [], []
        for s, source in enumerate(sources):
            part, width = slice(self._first[s], self._first[s + 1]), int(self._widths[s])
            data = np.ascontiguousarray(rows[part, 2 + 2 * k : 2 + 2 * k + int(self._data[s])]).view(np.float64)
            self.sources.append(source.of(number[part, :width].copy(), data))
            self._at.append(np.ascontiguousarray(self.ends[part, :width]))

    def _gather_groups(self) -> None:
        label = np.empty(len(self.numbers), dtype=np.int64)
        group_rows(self.ends, len(label), label)
        labels, self.group_of_node = np.unique(label, return_inverse=True)
        self.group_of_row = self.group_of_node[self.ends[:, 0]]
        self.nodes = np.argsort(self.group_of_node, kind="stable")
        self.members = np.argsort(self.group_of_row, kind="stable")
        every = np.arange(len(labels) + 1)
        self.node_starts = np.searchsorted(self.group_of_node[self.nodes], every)
        self.starts = np.searchsorted(self.group_of_row[self.members], every)

    @cached_property
    def alike(self) -> list[Alike]:
        """Return all groups, collected by shape."""
        shapes, found = np.stack([np.diff(self.starts), np.diff(self.node_starts)]), []
        place = np.empty(len(self.numbers), dtype=np.int64)
        place[self.nodes] = np.arange(len(self.nodes)) - self.node_starts[self.group_of_node[self.nodes]]
        for p, q in np.unique(shapes, axis=1).T:
            groups = np.flatnonzero((shapes[0] == p) & (shapes[1] == q))
            rows = self.members[self.starts[groups][:, None] + np.arange(p)]
            nodes = self.nodes[self.node_starts[groups][:, None] + np.arange(q)]
            found.append(Alike(rows, nodes, np.where(self.ends[rows] < 0, -1, place[self.ends[rows]])))
        return found

    def gather(self, values: np.ndarray) -> np.ndarray:
        """Return values (n, ...) at the nodes from those at owned nodes (owned, ...). Collective."""
        values = np.asarray(values, dtype=float)
        width = int(np.prod(values.shape[1:]))
        far = self.partners.bring(values[self.partners.rows].reshape(-1, width)) if width else np.empty((0, 0))
        return self.spread(values, far.reshape(len(far), *values.shape[1:]))

    def spread(self, values: np.ndarray, far: np.ndarray) -> np.ndarray:
        """Return values (n, ...) at the nodes from those at owned nodes (owned, ...) and those received (m, ...)."""
        if len(self._away) == 0:
            return values.take(self.where, axis=0)
        every = np.empty((len(self.numbers), *values.shape[1:]))
        every[self.mine] = values[self.here]
        if every.size:
            every[self._away] = far[self._far]
        return every

    def of_counted(self, values: np.ndarray) -> np.ndarray:
        """Return values (r, ...) of this rank's rows from those of counted rows (c, ...). Collective."""
        comm, shape = self.mesh.comm, values.shape[1:]
        owners = self.last_owners
        asking = Router(comm, owners)
        asked = asking.send(self.source * (1 << 40) + self.ids)
        own = self.source[self.counted] * (1 << 40) + self.ids[self.counted]
        return asking.reply(values[np.searchsorted(own, asked)].reshape(len(asked), *shape))


@kernel
def solve_row_groups(
    groups, starts, rows, node_starts, nodes, ends, gradients, values, stiffness, free, planes, tolerances, force, moves
):
    """Solve for the forces of the rows of some groups and the displacements of their nodes, with their walls.

    Parameters
    ----------
    groups : (g,) which groups; starts, rows, node_starts, nodes :
        see :func:`~pfem_petsc.contact.rows.broken_groups`
    ends, gradients, values : (r, k), (r, k, 3), (r,) at the free positions; infinite for rows that do not apply
    stiffness, free : (n,), (n, 3) of nodes; ``free`` is 0.0 where supports prescribe
    planes : (first (n,), normals (m, w, 3), gaps (m, w)): index of a node among the planes, -1 for none, and distances
        from walls at the free positions, infinite where a wall does not apply
    tolerances : (groups,) a row violated by at most this counts as satisfied
    force, moves : (r,), (n, 3) output; written for these groups only

    Returns
    -------
    int
        First of the groups with infeasible rows, else -1.
    """
    first_plane, normals, gaps = planes
    walls = gaps.shape[1]
    width = ends.shape[1]
    for group in groups:
        begin, end = starts[group], starts[group + 1]
        tolerance = tolerances[group]
        n_walled = 0
        for q in range(node_starts[group], node_starts[group + 1]):
            i = nodes[q]
            for c in range(3):
                moves[i, c] = 0.0
            if first_plane[i] >= 0:
                for k in range(walls):
                    if gaps[first_plane[i], k] < math.inf:
                        n_walled += 1
        if end - begin == 1 and n_walled == 0:  # a single row
            r = rows[begin]
            force[r] = 0.0
            square, gram = 0.0, 0.0
            for k in range(width):
                i = ends[r, k]
                if i < 0:
                    continue
                for c in range(3):
                    part = gradients[r, k, c] * free[i, c]
                    square += part * part
                    gram += part * part / stiffness[i]
            if values[r] < math.inf and square > FREE_PART and not values[r] >= -tolerance:
                strength = -values[r] / gram
                if not strength < math.inf:
                    return group
                force[r] = strength
                for k in range(width):
                    i = ends[r, k]
                    if i < 0:
                        continue
                    for c in range(3):
                        moves[i, c] += strength * (gradients[r, k, c] * free[i, c]) / stiffness[i]
            continue
        size = end - begin + n_walled
        node, vector = np.full((size, width), -1), np.zeros((size, width, 3))
        value, row = np.empty(size), np.full(size, -1)
        n = 0
        for q in range(begin, end):
            r = rows[q]
            force[r] = 0.0
            square = 0.0
            if not values[r] < math.inf and values[r] == values[r]:
                continue
            for k in range(width):
                i = ends[r, k]
                node[n, k] = i
                for c in range(3):
                    vector[n, k, c] = gradients[r, k, c] * free[i, c] if i >= 0 else 0.0
                    square += vector[n, k, c] * vector[n, k, c]
            if square > FREE_PART:
                value[n], row[n] = values[r], r
                n += 1
        for q in range(node_starts[group], node_starts[group + 1]):
            i = nodes[q]
            at = first_plane[i]
            for w in range(walls):
                if at < 0 or not gaps[at, w] < math.inf:
                    continue
                square = 0.0
                for k in range(width):
                    node[n, k] = -1
                node[n, 0], row[n], value[n] = i, -1, gaps[at, w]
                for c in range(3):
                    vector[n, 0, c] = normals[at, w, c] * free[i, c]
                    square += vector[n, 0, c] * vector[n, 0, c]
                if square > FREE_PART:
                    n += 1
        gram = np.zeros((n, n))
        for a in range(n):
            for b in range(a, n):
                s = 0.0
                for d in range(width):
                    i = node[a, d]
                    if i < 0:
                        continue
                    for e in range(width):
                        if node[b, e] == i:
                            for c in range(3):
                                s += vector[a, d, c] * vector[b, e, c] / stiffness[i]
                gram[a, b] = gram[b, a] = s
        z = np.zeros(n)
        if not find_multipliers(gram, value[:n], tolerance, z):
            return group
        for a in range(n):
            if row[a] >= 0:
                force[row[a]] = z[a]
            for k in range(width):
                i = node[a, k]
                if i >= 0:
                    for c in range(3):
                        moves[i, c] += z[a] * vector[a, k, c] / stiffness[i]
    return -1


_ITERATIONS = 100  # linearisations of a problem

Planes = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Walls at nodes: place of each node among the planes (n,), -1 for none; normals (m, w, 3), and distances (m, w) [m] at
the free positions, infinite for no concern."""


class Rows(RowLayout):
    """The rows of all sources that this rank has, and what they are at positions of their nodes."""

    def _each(self, rows: np.ndarray | None, method: str, *arrays: np.ndarray) -> list[np.ndarray]:
        """Return the results of a method of each source for arrays (n, 3), for some rows, ascending, or all."""
        found = []
        for source, at, first in zip(self.sources, self._at, self._first, strict=False):
            if rows is not None:
                begin, end = np.searchsorted(rows, (first, first + len(at)))
                some = rows[begin:end] - first
                if end - begin < len(at):
                    source, at = source.of(source.nodes[some], source.data[some]), at[some]
            found.append(getattr(source, method)(*(_of_rows(at, array) for array in arrays)))
        return found

    def values(self, x: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
        """Rows (r,) [m] at positions (n, 3); of some rows, ascending, if they are given, as below."""
        return _joined(self._each(rows, "values", x))

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

    def forces(self, jacobian: np.ndarray, force: np.ndarray) -> np.ndarray:
        """Return J^T f (n, 3) [N] for the forces (r,) of the rows [N]."""
        total = np.zeros((len(self.numbers), 3))
        add_forces(self.ends, jacobian, force, total)
        return total

    def usable(self, jacobian: np.ndarray) -> np.ndarray:
        """Return (r,) bool: rows with free components, which can be satisfied."""
        return self.along(jacobian**2, self.free) > FREE_PART

    def solve(
        self, jacobian: np.ndarray, values: np.ndarray, stiffness: np.ndarray, planes: Planes, tolerance: float
    ) -> np.ndarray:
        """Forces (r,) [N] of the rows.

        Parameters
        ----------
        jacobian, values : (r, k, 3) gradients, (r,) rows at the free positions; infinite for rows that do not apply
        stiffness : (n,) force for a displacement of a node [N/m]
        planes : see :data:`Planes`
        tolerance : rows broken by no more count as kept [m]

        Raises
        ------
        SimulationFailure
            On ranks that have such rows: nothing keeps all of them.
        """
        place, _, gaps = planes
        near = place >= 0
        near[near] = (gaps[place[near]] < -tolerance).any(axis=1)
        nowhere, force = np.zeros((len(self.numbers), 3)), np.zeros(len(values))
        groups, tolerances = self._broken(values, nowhere, near, tolerance)
        self._solve(groups, jacobian, values, stiffness, planes, tolerances, force, np.empty_like(nowhere))
        return force

    def _broken(
        self, values: np.ndarray, x: np.ndarray, near: np.ndarray, tolerance: float
    ) -> tuple[np.ndarray, np.ndarray]:
        groups = len(self.starts) - 1
        chosen, tolerances = np.empty(groups, dtype=bool), np.empty(groups)
        arrays = self.starts, self.members, self.node_starts, self.nodes
        if not broken_groups(*arrays, values, x, near, tolerance, chosen, tolerances):
            return np.empty(0, dtype=np.int64), tolerances
        return np.flatnonzero(chosen), tolerances

    def _solve(
        self,
        groups: np.ndarray,
        jacobian: np.ndarray,
        values: np.ndarray,
        stiffness: np.ndarray,
        planes: Planes,
        tolerances: np.ndarray,
        force: np.ndarray,
        moves: np.ndarray,
    ) -> None:
        arrays = self.starts, self.members, self.node_starts, self.nodes, self.ends
        given = jacobian, values, stiffness, self.free, planes, tolerances
        infeasible = solve_row_groups(groups, *arrays, *given, force, moves)
        if infeasible >= 0:
            raise SimulationFailure(
                f"no positions of nodes {self._shown(infeasible)} satisfy their constraints, walls and supports"
            )

    def _shown(self, group: int) -> str:
        nodes = self.nodes[self.node_starts[group] : self.node_starts[group + 1]]
        return ", ".join(str(number) for number in self.numbers[nodes][:6])

    def project(
        self,
        x: np.ndarray,
        tolerance: float,
        near: np.ndarray,
        given: Callable[[], tuple[np.ndarray, np.ndarray | None, Planes]],
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return forces (r,) [N] that satisfy the rows, and the gradients (r, k, 3) along which they act.

        Parameters
        ----------
        x : (n, 3) positions without rows [m]
        tolerance : [m]
        near : (n,) bool, nodes that may be beyond walls; (0,) for none
        given : asked where groups are to be solved; gives the stiffness (n,) of the nodes [N/m], places (n, 3) where
            the forces act, None: at the solution, and planes

        Raises
        ------
        SimulationFailure
            On ranks that have such rows.
        """
        values = self.values(x)
        force, jacobian = np.zeros(len(values)), np.zeros((*self.ends.shape, 3))
        groups, tolerances = self._broken(values, x, near, tolerance)
        if len(groups) == 0:
            return force, jacobian
        stiffness, start, planes = given()
        at, moves = x.copy(), np.empty_like(x)
        chosen = np.zeros(len(self.starts) - 1, dtype=bool)
        rows = None
        for _ in range(_ITERATIONS):
            chosen[:] = False
            chosen[groups] = True
            fewer = np.flatnonzero(chosen[self.group_of_row])
            if rows is None or start is None:
                jacobian[fewer] = self.gradients(at if start is None else start, fewer)
            if rows is not None:
                linearise(fewer, self.ends, jacobian, self.free, x, at, self.values(at, fewer), values)
            rows = fewer
            self._solve(groups, jacobian, values, stiffness, planes, tolerances, force, moves)
            settled = np.empty(len(groups), dtype=bool)
            advance_groups(groups, self.node_starts, self.nodes, x, moves, at, tolerances, settled)
            groups = groups[~settled]
            if len(groups) == 0:
                return force, jacobian
        raise SimulationFailure(
            f"the positions of nodes {self._shown(int(groups[0]))} on their constraints did not converge in "
            f"{_ITERATIONS} iterations; reduce time.step"
        )


def _of_rows(at: np.ndarray, array: np.ndarray) -> np.ndarray:
    """Vectors (r, k, 3) of rows with nodes ``at`` (r, k), from those of nodes (n, 3); rows are next to each other in
    memory, so that sums and differences over their nodes and components are as fast as they can be."""
    vectors = np.empty((at.shape[1], 3, len(at)))
    gather_rows(at, array, vectors)
    return vectors.transpose(2, 0, 1)


def _joined(parts: list[np.ndarray]) -> np.ndarray:
    return np.ascontiguousarray(parts[0]) if len(parts) == 1 else np.concatenate(parts)

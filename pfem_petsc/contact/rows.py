"""Rows over several nodes, r(x) >= 0, whatever made them, and the explicit solution of small problems of them.

With J the rows' gradients and K the nodes' stiffnesses, the positions nearest to free ones x_f with rows linearised at
x are x_f + K^-1 J^T f, where

    0 <= f   complementary to   r(x) + J (x_f + K^-1 J^T f - x) >= 0.

Repeated until x is the solution, this keeps the rows themselves. Gradients are those of the solution, or those of the
places where the forces of the balance act, which may be other ones. Rows that share nodes make one problem, a *group*;
planes of walls that stop the same nodes are rows of it. Each group is repeated on its own account, so that it does not
matter which other groups a rank has. All ranks that own a node of a group have it, and solve the same problem.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..errors import SimulationFailure
from ..mesh.exchange import GhostExchange, Router
from ..parallel.natural import NaturalOrder
from ..tolerances import FREE_PART
from .constraints.base import Constraint
from .row_loops import add_forces, advance_groups, broken_groups, gather_rows, group_rows, linearise, solve_row_groups
from .row_search import owner_starts, petsc_numbers, to_owners, with_groups

if TYPE_CHECKING:
    from ..mesh.distribution import DistributedMesh

__all__ = ["Alike", "Planes", "Rows"]

_ITERATIONS = 100  # of rows and positions
_TAG = 7700  # of messages between ranks that have nodes of the same rows, apart from those of ghosts and pairs

Planes = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Walls at nodes: place of each node among the planes (n,), -1 for none; normals (m, w, 3), and distances (m, w) [m] at
the free positions, infinite for no concern."""


@dataclass(frozen=True)
class Alike:
    """Groups of the same numbers of rows and nodes: rows (g, p), nodes (g, q), and which of these rows have, (g, p, k),
    -1 for none."""

    rows: np.ndarray
    nodes: np.ndarray
    ends: np.ndarray

    def dense(self, gradients: np.ndarray) -> np.ndarray:
        """Gradients (g, p, 3 q) from those of rows (g, p, k, 3)."""
        dense = np.zeros((*self.rows.shape, self.nodes.shape[1], 3))
        group, row, end = np.nonzero(self.ends >= 0)
        dense[group, row, self.ends[group, row, end]] = gradients[group, row, end]
        return dense.reshape(*self.rows.shape, -1)


class Rows:
    """The rows of all sources that this rank has: those of its nodes, and of the groups of these. Construction is
    collective.

    Attributes
    ----------
    sources : of the rows here
    source, ids : (r,) index of the source of each row, and the row's number there
    ends : (r, k) indices of its nodes, -1 behind the last one; last : (r,) place of the last one
    numbers : (n,) mesh numbers of the nodes, ascending
    where : (n,) local index of an owned node, else -1 less its row among those that others own
    mine, here : (n,) bool, nodes that this rank owns, and their local indices (m,)
    partners : GhostExchange that brings values of nodes that others own
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
        """Bring the rows of all sources to the ranks of their nodes."""
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
        """All groups, those of the same shape together."""
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
        """Values (n, ...) of the nodes from those of owned nodes (owned, ...). Collective."""
        values = np.asarray(values, dtype=float)
        width = int(np.prod(values.shape[1:]))
        far = self.partners.bring(values[self.partners.rows].reshape(-1, width)) if width else np.empty((0, 0))
        return self.spread(values, far.reshape(len(far), *values.shape[1:]))

    def spread(self, values: np.ndarray, far: np.ndarray) -> np.ndarray:
        """Values (n, ...) of the nodes from those of owned nodes (owned, ...) and those that partners sent (m, ...)."""
        if len(self._away) == 0:
            return values.take(self.where, axis=0)
        every = np.empty((len(self.numbers), *values.shape[1:]))
        every[self.mine] = values[self.here]
        if every.size:
            every[self._away] = far[self._far]
        return every

    def of_counted(self, values: np.ndarray) -> np.ndarray:
        """Values (r, ...) of the rows here from those of counted rows (c, ...). Collective."""
        comm, shape = self.mesh.comm, values.shape[1:]
        owners = self.last_owners
        asking = Router(comm, owners)
        asked = asking.send(self.source * (1 << 40) + self.ids)
        own = self.source[self.counted] * (1 << 40) + self.ids[self.counted]
        return asking.reply(values[np.searchsorted(own, asked)].reshape(len(asked), *shape))

    def _each(self, rows: np.ndarray | None, method: str, *arrays: np.ndarray) -> list[np.ndarray]:
        """What a method of each source makes of arrays (n, 3), for some rows, ascending, or all."""
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
        """J^T f (n, 3) of the forces (r,) of the rows [N]."""
        total = np.zeros((len(self.numbers), 3))
        add_forces(self.ends, jacobian, force, total)
        return total

    def usable(self, jacobian: np.ndarray) -> np.ndarray:
        """(r,) bool: rows whose nodes supports leave free to keep them."""
        return self.along(jacobian**2, self.free) > FREE_PART

    def solve(
        self, jacobian: np.ndarray, values: np.ndarray, stiffness: np.ndarray, planes: Planes, tolerance: float
    ) -> np.ndarray:
        """Forces (r,) [N] of the rows.

        Parameters
        ----------
        jacobian, values : (r, k, 3) gradients and (r,) rows at the free positions; infinite for rows that are no concern
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
        """Forces (r,) [N] that keep the rows, and the gradients (r, k, 3) along which they act, where there are forces.

        Parameters
        ----------
        x : (n, 3) positions without rows [m]
        tolerance : [m]
        near : (n,) bool, nodes that may be beyond walls; (0,) for none
        given : asked where groups are to be solved; gives the stiffness (n,) of the nodes [N/m], places (n, 3) where the
            forces act, None: at the solution, and planes

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

"""Rows over several nodes, r(x) >= 0, from any source, and the explicit solution of small problems with them.

With J the rows' gradients and K the nodes' stiffnesses, the positions nearest to free ones x_f with rows linearised at
x are x_f + K^-1 J^T f, where

    0 <= f   complementary to   r(x) + J (x_f + K^-1 J^T f - x) >= 0.

This is repeated until x is the solution, which then satisfies the nonlinear rows. The gradients of the forces are taken
at the solution, or at the positions where the forces of the balance act if these differ. Rows that share nodes form one
problem; planes of walls that stop the same nodes are further rows of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..errors import SimulationFailure
from ..tolerances import FREE_PART
from .constraints.base import Constraint
from .coupled import complementary

if TYPE_CHECKING:
    from ..mesh.distribution import DistributedMesh

__all__ = ["Group", "Rows"]

_ITERATIONS = 100  # linearisations of a problem


class Group:
    """Rows connected by shared nodes.

    Attributes
    ----------
    rows, nodes : (p,), (q,) indices among all rows and nodes
    entries : (e,) indices among all entries of the Jacobian
    """

    def __init__(self, rows: np.ndarray, nodes: np.ndarray, entries: np.ndarray, every: Rows) -> None:
        self.rows, self.nodes, self.entries = rows, nodes, entries
        self._row = np.searchsorted(rows, every.entry_row[entries])
        self._node = np.searchsorted(nodes, every.entry_node[entries])

    def dense(self, jacobian: np.ndarray) -> np.ndarray:
        """Return the gradients (p, q, 3) of the group from the entries (e, 3) of the Jacobian."""
        dense = np.zeros((len(self.rows), len(self.nodes), 3))
        np.add.at(dense, (self._row, self._node), jacobian[self.entries])
        return dense


class Rows:
    """The rows of all sources. All ranks know all rows and their nodes. Construction is collective.

    Attributes
    ----------
    source : (r,) index of the source of each row
    numbers : (n,) mesh numbers of the nodes
    mine, here : (n,) bool, nodes that this rank owns; (m,) their owned local indices
    free : (n, 3) 1.0 where a component may move, 0.0 where a support prescribes it
    entry_row, entry_node : (e,) row and node of each entry of the Jacobian; last : (r,) the last entry of each row
    groups : rows that share nodes
    """

    def __init__(self, sources: Sequence[Constraint], mesh: DistributedMesh, fixed: np.ndarray) -> None:
        self.sources, self.mesh = list(sources), mesh
        counts = [len(source.nodes) for source in self.sources]
        self.source = np.repeat(np.arange(len(counts)), counts)
        every = np.concatenate([np.empty(0, dtype=np.int64), *(source.nodes.ravel() for source in self.sources)])
        self.numbers, places = np.unique(every, return_inverse=True)
        self.entry_node = places.ravel()
        widths = np.repeat([source.nodes.shape[1] for source in self.sources], counts)
        self.entry_row = np.repeat(np.arange(len(self.source)), widths)
        self.last = np.cumsum(widths) - 1
        ids = mesh.node_ids[: mesh.n_owned]
        order = np.argsort(ids)
        place = np.searchsorted(ids[order], self.numbers)
        self.mine = np.zeros(len(self.numbers), dtype=bool)
        inside = place < len(ids)
        self.mine[inside] = ids[order][place[inside]] == self.numbers[inside]
        self.here = order[place[self.mine]]
        self.free = self.gather(np.where(fixed, 0.0, 1.0))
        self.groups = self._grouped()

    def _grouped(self) -> list[Group]:
        label = np.arange(len(self.numbers))
        while True:  # propagate the smallest node number through rows until nothing changes
            least = np.full(len(self.source), len(self.numbers))
            np.minimum.at(least, self.entry_row, label[self.entry_node])
            before = label.copy()
            np.minimum.at(label, self.entry_node, least[self.entry_row])
            if (label == before).all():
                break
        of_row = label[self.entry_node[self.last]]
        groups = []
        for number in np.unique(of_row):
            entries = np.flatnonzero(of_row[self.entry_row] == number)
            groups.append(Group(np.flatnonzero(of_row == number), np.flatnonzero(label == number), entries, self))
        return groups

    def gather(self, values: np.ndarray) -> np.ndarray:
        """Return values (n, ...) at the nodes from those at owned nodes (owned, ...), on all ranks. Collective."""
        data = np.zeros((len(self.numbers), *values.shape[1:]))
        data[self.mine] = values[self.here]
        if self.mesh.comm.size > 1:
            self.mesh.comm.Allreduce(MPI.IN_PLACE, data)
        return data

    def _each(self, method: str, *arrays: np.ndarray) -> list[np.ndarray]:
        """Return the results of a method of each source for arrays (n, 3)."""
        found, first = [], 0
        for source in self.sources:
            at = self.entry_node[first : first + source.nodes.size].reshape(source.nodes.shape)
            found.append(getattr(source, method)(*(array[at] for array in arrays)))
            first += source.nodes.size
        return found

    def values(self, x: np.ndarray) -> np.ndarray:
        """Return rows (r,) [m] at positions (n, 3)."""
        return np.concatenate(self._each("values", x))

    def gradients(self, x: np.ndarray) -> np.ndarray:
        """Return entries (e, 3) of the Jacobian at positions (n, 3)."""
        return np.concatenate([part.reshape(-1, 3) for part in self._each("gradients", x)])

    def drift(self, x: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return second time derivatives (r,) of rows [m/s2] for nodes at (n, 3) with constant velocities v (n, 3)."""
        return np.concatenate(self._each("drift", x, v))

    def along(self, jacobian: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return J y (r,) for vectors (n, 3)."""
        products = np.einsum("ei,ei->e", jacobian, y[self.entry_node])
        return np.bincount(self.entry_row, products, minlength=len(self.source))

    def forces(self, jacobian: np.ndarray, force: np.ndarray) -> np.ndarray:
        """Return J^T f (n, 3) [N] for the forces (r,) of the rows [N]."""
        total = np.zeros((len(self.numbers), 3))
        np.add.at(total, self.entry_node, force[self.entry_row, None] * jacobian)
        return total

    def usable(self, jacobian: np.ndarray) -> np.ndarray:
        """Return (r,) bool: rows with free components, which can be satisfied."""
        return self.along(jacobian**2, self.free) > FREE_PART

    def solve(
        self,
        jacobian: np.ndarray,
        values: np.ndarray,
        stiffness: np.ndarray,
        planes: tuple[np.ndarray, np.ndarray],
        tolerance: float,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return forces (r,) [N] of the rows, and displacements (n, 3) [m] of the nodes by rows and planes.

        Parameters
        ----------
        jacobian, values : (e, 3) gradients and (r,) rows at the free positions; infinite for rows that do not apply
        stiffness : (n,) force for a displacement of a node [N/m]
        planes : (n, w, 3), (n, w) normals of walls and distances from them at the free positions, infinite where a wall
            does not apply
        tolerance : rows violated by at most this count as satisfied [m]

        Raises
        ------
        SimulationFailure
            On all ranks, if the rows are infeasible.
        """
        force, moves = np.zeros(len(values)), np.zeros((len(self.numbers), 3))
        normals, gaps = planes
        short = values < -tolerance
        near = (gaps < -tolerance).any(axis=1)
        for group in self.groups:
            if not short[group.rows].any() and not near[group.nodes].any():
                continue
            node, wall = np.nonzero(gaps[group.nodes] < np.inf)
            walls = np.zeros((len(wall), len(group.nodes), 3))
            walls[np.arange(len(wall)), node] = normals[group.nodes[node], wall]
            kept = values[group.rows] < np.inf
            rows = np.concatenate([group.dense(jacobian)[kept], walls]) * self.free[group.nodes]
            at = np.append(values[group.rows[kept]], gaps[group.nodes[node], wall])
            usable = (rows**2).sum(axis=(1, 2)) > FREE_PART
            flat = (rows[usable] / np.sqrt(stiffness[group.nodes])[None, :, None]).reshape(int(usable.sum()), -1)
            found = complementary(flat @ flat.T, at[usable], tolerance)
            if found is None:
                shown = ", ".join(str(number) for number in self.numbers[group.nodes][:6])
                raise SimulationFailure(f"no positions of nodes {shown} satisfy their constraints, walls and supports")
            multipliers = np.zeros(len(rows))
            multipliers[usable] = found
            own = np.zeros(len(group.rows))
            own[kept] = multipliers[: int(kept.sum())]
            force[group.rows] = own
            moves[group.nodes] = np.einsum("r,rni->ni", multipliers, rows) / stiffness[group.nodes, None]
        return force, moves

    def project(
        self,
        free_x: np.ndarray,
        stiffness: np.ndarray,
        start: np.ndarray | None,
        planes: tuple[np.ndarray, np.ndarray],
        tolerance: float,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return forces (r,) [N] that satisfy the rows, and the gradients (e, 3) along which they act.

        Parameters
        ----------
        free_x : (n, 3) positions without rows [m]
        stiffness : (n,) force for a displacement of a node [N/m]
        start : (n, 3) positions at which the forces act [m]; None: at the solution
        planes : (n, w, 3), (n, w) planes n . x >= d of walls at the nodes; offset -inf where a wall does not apply
        tolerance : [m]

        Raises
        ------
        SimulationFailure
            On all ranks.
        """
        tolerance = max(tolerance, 16.0 * np.finfo(float).eps * float(np.abs(free_x).max(initial=0.0)))
        x = free_x
        normals, offsets = planes
        gaps = np.einsum("nwi,ni->nw", normals, free_x) - offsets
        for _ in range(_ITERATIONS):
            jacobian = self.gradients(x if start is None else start)
            values = self.values(x) + self.along(jacobian * self.free[self.entry_node], free_x - x)
            force, moves = self.solve(jacobian, values, stiffness, (normals, gaps), tolerance)
            before, x = x, free_x + moves
            if np.abs(x - before).max(initial=0.0) <= tolerance:
                return force, jacobian
        node = self.numbers[np.abs(x - before).max(axis=1).argmax()]
        raise SimulationFailure(
            f"the position of node {node} on its constraints did not converge in {_ITERATIONS} iterations; reduce "
            "time.step"
        )

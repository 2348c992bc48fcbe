"""Relative coordinates of implicit steps: the position of one node of a row is replaced by the sum of weights times
positions of all its nodes, in which the row is a wall at that node.

The transposed map turns forces: what presses on the relative coordinate acts on all nodes of the row, times their
weights. Bounds, sticking and slipping of a row are then those of a node at a plane wall at rest
(:mod:`~pfem_petsc.contact.frames`, :mod:`~pfem_petsc.contact.friction`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from .frames import RowPlanes

if TYPE_CHECKING:
    from .rows import RowSet


class RelativeCoordinates:
    """Coordinates y of nodes in groups of rows that rub, or whose nodes meet walls other than plain planes.
    Construction is collective.

    y is x, except at the carriers: there it is the sum of weights times positions of a row. Rows of several tables over
    the same nodes share one carrier. A node that a wall stops is no carrier, nor is one whose supports prescribe more
    components than those of the other nodes of the row. Rows for which no node is left have no carrier.

    Parameters
    ----------
    rows : RowSet
    groups : (groups,) bool, those to which this applies
    tables : number of tables of rows in the model

    Attributes
    ----------
    anywhere : whether there are any on any rank
    friction, static : (tables,) coefficients of friction
    carrier : (r,) node of each row among those of the rows, -1 for none
    nodes, at : (m,) owned carriers, ascending, and a row of each
    """

    def __init__(self, rows: RowSet, groups: np.ndarray, tables: int) -> None:
        self.rows, self.groups = rows, groups
        comm = rows.mesh.comm
        self.anywhere = bool(comm.allreduce(bool(self.groups.any()), op=MPI.LOR))
        coefficients = np.zeros((tables, 2))
        coefficients[rows.source] = rows.friction
        comm.Allreduce(MPI.IN_PLACE, coefficients, op=MPI.MAX)
        self.friction, self.static = coefficients.T.copy()
        self._may = self._supported()
        self._take(np.full(len(rows.source), -1))

    def _supported(self) -> np.ndarray:
        """Return (r, k) bool: nodes of rows whose supports let them carry the relative coordinate."""
        rows = self.rows
        part = (rows.weights != 0.0) & rows.fixed[:, None]
        free = (rows.free > 0.0)[rows.ends]
        needed = (free & part[:, :, None]).any(axis=1, keepdims=True)
        return part & (free | ~needed).all(axis=2) & self.groups[rows.group_of_row][:, None]

    def choose(self, stopped: np.ndarray, x: np.ndarray) -> None:
        """Choose the carriers for a solve. Collective.

        Parameters
        ----------
        stopped : (owned,) bool, nodes that walls may stop
        x : (owned, 3) positions, by which rows are left without a carrier if not all can have one [m]
        """
        rows = self.rows
        every = rows.gather(np.column_stack([stopped, x]))
        may = self._may & (every[:, 0] == 0.0)[rows.ends]
        carrier, values = np.full(len(rows.source), -1), None
        width = may.shape[1]
        for groups in rows.alike_of(self.groups):
            if groups.rows.shape[1] == 1:
                some = groups.rows[may[groups.rows[:, 0]].any(axis=1), 0]
                carrier[some] = rows.ends[some, width - 1 - may[some, ::-1].argmax(axis=1)]
                continue
            values = rows.values(every[:, 1:]) if values is None else values
            for several in groups.rows:
                self._share_out(several, may, values, carrier)
        self._take(carrier)

    def _share_out(self, several: np.ndarray, may: np.ndarray, values: np.ndarray, carrier: np.ndarray) -> None:
        """Give the rows (p,) of a group their carriers: in turn one that has a node which no other row needs."""
        rows = self.rows
        alike: dict[tuple, list[int]] = {}
        for row in several:
            same = alike.setdefault((*rows.ends[row], *rows.weights[row]), [])
            if rows.source[row] in rows.source[same]:  # a table has one slot
                same = alike[int(row),] = []
            same.append(int(row))
        left = list(alike.values())
        while left:
            needed = np.concatenate([rows.ends[some[0]][rows.weights[some[0]] != 0.0] for some in left])
            number, count = np.unique(needed, return_counts=True)
            alone = number[count == 1]
            for some in left:
                free = np.flatnonzero(may[some[0]] & np.isin(rows.ends[some[0]], alone))
                if len(free):
                    carrier[some] = rows.ends[some[0], free[-1]]
                    break
            else:  # the row that is farthest from being closed goes without
                some = max(left, key=lambda some: values[some].min())
            left.remove(some)

    def _take(self, carrier: np.ndarray) -> None:
        rows = self.rows
        self.carrier = carrier
        placed = np.flatnonzero(carrier >= 0)
        local = rows.where[carrier[placed]]
        own = local >= 0
        self.nodes, first = np.unique(local[own], return_index=True)
        self.at = placed[own][first]
        self._placed = placed[own]
        self._place = np.searchsorted(self.nodes, local[own])
        self._blocks: list[tuple[np.ndarray, np.ndarray]] = []  # of groups alike: nodes (g, q), x by y (g, q, q)
        for groups in rows.alike_of(self.groups):
            g, q = groups.nodes.shape
            weights = np.tile(np.eye(q), (g, 1, 1))
            group, row = np.nonzero(carrier[groups.rows] >= 0)
            at = groups.rows[group, row]
            where = (groups.nodes[group] == carrier[at][:, None]).argmax(axis=1)
            weights[group, where] = 0.0
            for end in range(rows.ends.shape[1]):
                some = groups.ends[group, row, end] >= 0
                place = groups.ends[group, row, end][some]
                weights[group[some], where[some], place] = rows.weights[at[some], end]
            self._blocks.append((groups.nodes, np.linalg.inv(weights)))

    def carried(self, nodes: np.ndarray) -> np.ndarray:
        """Return (m,) bool: which of owned nodes (m,) are carriers."""
        return np.isin(nodes, self.nodes)

    def transforms(self, inverse: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return unknowns (g, u) of groups alike, and T (g, u, u).

        T maps coordinates w of the nodes' frames, with the inverses (n, 3, 3) of their bases, to the same at nodes
        without a relative coordinate, and to positions at carriers. Prescribed components do not move others: bounds
        account for their motion.
        """
        rows, found = self.rows, []
        basis, fixed = np.linalg.inv(inverse), rows.free.ravel() == 0.0
        basis[self.carrier[self.carrier >= 0]] = np.eye(3)
        for nodes, blocks in self._blocks:
            g, q = nodes.shape
            unknowns = (3 * nodes[:, :, None] + np.arange(3)).reshape(g, 3 * q)
            matrix = np.einsum("gab,gaij,gbjk->gaibk", blocks, basis[nodes], inverse[nodes]).reshape(g, 3 * q, 3 * q)
            at, column = np.nonzero(fixed[unknowns])
            matrix[at, :, column] = 0.0
            matrix[at, column, column] = 1.0
            found.append((unknowns, matrix))
        return found

    def positions(self, x: np.ndarray) -> np.ndarray:
        """Return y (owned, 3) of positions x (owned, 3) [m]. Collective."""
        y = x.copy()
        y[self.nodes] = self.rows.slips(self.rows.gather(x))[self.at]
        return y

    def forces(self, g: np.ndarray) -> np.ndarray:
        """Return the forces (owned, 3) on y of forces g (owned, 3) on x [N]. Collective."""
        every, g = self.rows.gather(g), g.copy()
        turned = every.copy()
        for nodes, blocks in self._blocks:
            turned[nodes] = np.einsum("gab,gai->gbi", blocks, every[nodes])
        g[self.rows.here] = turned[self.rows.mine]
        return g

    def stiffness(self, k: np.ndarray) -> np.ndarray:
        """Return the stiffness (owned,) of y by that of x (owned,) [N/m]: 1/k = sum of w^2/k of the nodes of a row that
        supports let move. Collective."""
        rows, total = self.rows, k.copy()
        soft = np.where(rows.free.any(axis=1), 1.0 / np.maximum(rows.gather(k), 1e-300), 0.0)
        soft = (rows.weights[self.at] ** 2 * soft[rows.ends[self.at]]).sum(axis=1)
        total[self.nodes] = np.where(soft > 0.0, 1.0 / np.maximum(soft, 1e-300), k[self.nodes])
        return total

    def planes(self, x: np.ndarray) -> RowPlanes:
        """Return the rows with carriers at positions (owned, 3) as planes of owned nodes. Collective."""
        rows, every = self.rows, self.rows.gather(x)
        y = rows.slips(every)
        at, place, tables = self._placed, self._place, len(self.friction)
        normals = np.zeros((len(self.nodes), tables, 3))
        offsets = np.full((len(self.nodes), tables), -np.inf)
        if len(at):
            end = np.abs(rows.weights[at]).argmax(axis=1)
            n = rows.fixed_jacobian[at, end] / rows.weights[at, end][:, None]
            normals[place, rows.source[at]] = n
            offsets[place, rows.source[at]] = np.einsum("ri,ri->r", n, y[at]) - rows.values(every)[at]
        return RowPlanes(self.nodes, y[self.at], normals, offsets)

    def of_rows(self, normal: np.ndarray, drag: np.ndarray, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return normal forces (r,) and drags (r, 3) of the rows here from those of nodes ``frames`` (m,) in the slots
        of tables (m, t), (m, t, 3) [N]. Collective."""
        rows, tables = self.rows, len(self.friction)
        own = np.zeros((rows.mesh.n_owned, tables, 4))
        own[frames, :, 0], own[frames, :, 1:] = normal, drag
        every = rows.gather(own.reshape(len(own), -1)).reshape(-1, tables, 4)
        placed = np.flatnonzero(self.carrier >= 0)
        found = np.zeros((len(rows.source), 4))
        found[placed] = every[self.carrier[placed], rows.source[placed]]
        return found[:, 0], found[:, 1:]

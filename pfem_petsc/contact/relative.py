"""Pivots of groups of rows, and relative coordinates of implicit steps: the position of one node of a row is replaced
by the sum of weights times positions of all its nodes, in which the row is a wall at that node.

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
    from .rows import Alike, RowSet

_LEAST = 0.05  # of a pivot below which a row is deferred


def pivots(matrices: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Choose pivots of matrices (g, p, q, d), with d components at each node, by elimination, largest part of a row at
    a node first.

    The coordinates of that node are reflected such that the part has one component. Coordinates without entries are not
    changed. Returns rows and columns (g, p) of the pivots, how many (g,) there are, and the reflections (g, q, d, d).
    """
    (g, p, q, d), left, every = matrices.shape, matrices.copy(), np.arange(len(matrices))
    rows, columns = np.zeros((2, g, p), dtype=np.int64)
    count, going, turns = np.zeros(g, dtype=np.int64), np.ones(g, dtype=bool), np.tile(np.eye(d), (g, q, 1, 1))
    for k in range(p):
        size = np.sqrt(np.einsum("gpqi,gpqi->gpq", left, left))
        at, node = np.divmod(size.reshape(g, -1).argmax(axis=1), q)
        going &= size[every, at, node] > _LEAST
        if not going.any():
            break
        some = np.flatnonzero(going)
        at, node, each = at[some], node[some], np.arange(len(some))
        mirror = -left[some, at, node] / size[some, at, node][:, None]
        slot = np.abs(mirror).argmax(axis=1)
        mirror[each, slot] += 1.0
        square = np.einsum("mi,mi->m", mirror, mirror)
        factor = np.divide(2.0, square, out=np.zeros_like(square), where=square > 0.0)
        turn = np.eye(d) - factor[:, None, None] * mirror[:, :, None] * mirror[:, None, :]
        turns[some, node] = turns[some, node] @ turn
        left[some, :, node] = left[some, :, node] @ turn
        rows[some, k], columns[some, k] = at, d * node + slot
        count[some] += 1
        factors = left[some, :, node, slot] / left[some, at, node, slot][:, None]
        left[some] -= factors[:, :, None, None] * left[some, at][:, None]
        left[some, at] = 0.0
        left[some, :, node, slot] = 0.0
    return rows, columns, count, turns


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
        # the first row over the same nodes, with whose carrier the first ones of other tables have a slot as well
        nodes = np.column_stack([rows.ends, rows.weights])
        _, first, same = np.unique(nodes, axis=0, return_index=True, return_inverse=True)
        self._first, self._slot = first[same.ravel()], np.zeros(len(rows.source), dtype=bool)
        self._slot[np.unique(np.column_stack([self._first, rows.source]), axis=0, return_index=True)[1]] = True
        self._take(np.full(len(rows.source), -1))

    def _supported(self) -> np.ndarray:
        """Return (r, k) bool: nodes of rows whose supports let them carry the relative coordinate."""
        rows = self.rows
        part = (rows.weights != 0.0) & rows.fixed[:, None]
        free = (rows.free > 0.0)[rows.ends]
        needed = (free & part[:, :, None]).any(axis=1, keepdims=True)
        return part & (free | ~needed).all(axis=2) & self.groups[rows.group_of_row][:, None]

    def choose(self, stopped: np.ndarray, x: np.ndarray) -> None:
        """Choose the carriers for a solve, by elimination. Collective.

        Parameters
        ----------
        stopped : (owned,) bool, nodes that walls may stop
        x : (owned, 3) positions, by which rows are left without a carrier if not all can have one [m]
        """
        rows = self.rows
        every = rows.gather(np.column_stack([stopped, x]))
        may = self._may & (every[:, 0] == 0.0)[rows.ends] & (self._first == np.arange(len(self._first)))[:, None]
        carrier, values = np.full(len(rows.source), -1), rows.values(every[:, 1:])
        for groups in rows.alike_of(self.groups):
            order = np.argsort(values[groups.rows], axis=1, kind="stable")
            matrix = groups.dense(np.where(may, rows.weights, 0.0)[groups.rows])
            matrix /= np.maximum(np.abs(matrix).max(axis=2, keepdims=True), 1e-300)
            matrix = np.take_along_axis(matrix, order[:, :, None], axis=1)
            row, column, count, _ = pivots(matrix[:, :, ::-1, None])
            at, k = np.nonzero(np.arange(row.shape[1]) < count[:, None])
            carrier[groups.rows[at, order[at, row[at, k]]]] = groups.nodes[at, -1 - column[at, k]]
        self._take(np.where(self._slot, carrier[self._first], -1))

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
        self._inverse = [(groups.nodes, np.linalg.inv(self.weights(groups))) for groups in rows.alike_of(self.groups)]

    def weights(self, groups: Alike) -> np.ndarray:
        """Return y by x (g, q, q) of groups alike."""
        weights = np.tile(np.eye(groups.nodes.shape[1]), (len(groups.nodes), 1, 1))
        group, row = np.nonzero(self.carrier[groups.rows] >= 0)
        where = groups.nodes[group] == self.carrier[groups.rows[group, row]][:, None]
        weights[group, where.argmax(axis=1)] = groups.dense(self.rows.weights[groups.rows])[group, row]
        return weights

    def positions(self, x: np.ndarray) -> np.ndarray:
        """Return y (owned, 3) of positions x (owned, 3) [m]. Collective."""
        y = x.copy()
        y[self.nodes] = self.rows.slips(self.rows.gather(x))[self.at]
        return y

    def forces(self, g: np.ndarray) -> np.ndarray:
        """Return the forces (owned, 3) on y of forces g (owned, 3) on x [N]. Collective."""
        every, g = self.rows.gather(g), g.copy()
        turned = every.copy()
        for nodes, inverse in self._inverse:
            turned[nodes] = np.einsum("gab,gai->gbi", inverse, every[nodes])
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

"""Coordinates for implicit steps in which every row over several nodes is a bound on one unknown.

With y the coordinates of the nodes, in their frames if walls are near (u = B^-1 y), a row is J y >= d in each solve.
For each group of rows that share nodes, pivots P are chosen, one free component per row, by elimination with complete
pivoting. With s the size of a row's gradient and N all other components,

    w_P = J y / s,   w_N = y_N,   and back   y_P = J_P^-1 (s w_P - J_N w_N),

so that the row is a lower bound on w_P. The gradient transforms accordingly, g_N <- g_N - J_N^T q, g_P <- s q with
q = J_P^-T g_P, and q are the forces of the rows. Prescribed components do not enter J; they move the bound. Nonlinear
rows are linearised again at the solution until it satisfies them and their gradients no longer change.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from petsc4py import PETSc

from ..errors import NotConverged
from ..integrators.base import Balance, State
from ..tolerances import PROJECTED
from .frames import NodalFrames
from .links import BlocksOf

if TYPE_CHECKING:
    from .constraint_link import ConstraintLink

__all__ = ["RowCoordinates"]

_LEAST = 0.05  # of a pivot below which a row is deferred
_TURN = 1e-10  # change of a gradient that counts as zero


class RowCoordinates:
    """See :class:`~pfem_petsc.contact.links.LinkCoordinates`.

    Parameters
    ----------
    link : ConstraintLink
    """

    varies = True

    def __init__(self, link: ConstraintLink) -> None:
        self.link, self.rows = link, link.rows
        n = len(self.rows.numbers)
        self._start: np.ndarray | None = None
        self._place(self.rows.gradients(self._points()), np.tile(np.eye(3), (n, 1, 1)), np.ones((n, 3), dtype=bool))

    def _points(self) -> np.ndarray:
        return self.rows.gather(self.rows.mesh.points[: self.rows.mesh.n_owned])

    def reached(self, state: State, move: np.ndarray, slack: float) -> bool:
        rows = self.rows
        data = rows.gather(np.concatenate([state.position + move, move], axis=1))
        way = np.linalg.norm(data[:, 3:], axis=1)
        reach = 0.5 * np.bincount(rows.entry_row, way[rows.entry_node], minlength=len(rows.source)) + slack
        return bool(((rows.values(data[:, :3]) < reach) | (self.link.force > 0.0)).any())

    def place(self, frames: NodalFrames | None, balance: Balance, state: State, x: np.ndarray) -> None:
        rows, owned = self.rows, self.rows.mesh.n_owned
        data = np.zeros((owned, 12))
        data[:, [0, 4, 8]] = 1.0
        if frames is not None:
            data[frames.nodes, :9] = frames.inverse.reshape(-1, 9)
            data[frames.nodes, 9:] = np.isfinite(frames.lower) | np.isfinite(frames.upper)
        data = rows.gather(data)
        at_start = all(time == state.time for _, time in balance.loads)
        self._start = rows.gather(state.position) if at_start else None
        jacobian = rows.gradients(rows.gather(x) if self._start is None else self._start)
        self._place(jacobian, data[:, :9].reshape(-1, 3, 3), data[:, 9:] == 0.0)

    def _place(self, jacobian: np.ndarray, inverse: np.ndarray, room: np.ndarray) -> None:
        """Choose the pivots.

        ``jacobian`` (e, 3) with respect to x; ``inverse`` (n, 3, 3) of the bases of the nodes' frames; ``room`` (n, 3)
        bool, coordinates that no wall bounds.
        """
        rows = self.rows
        self.jacobian = jacobian
        turned = np.einsum("eji,ej->ei", inverse[rows.entry_node], jacobian) * rows.free[rows.entry_node]
        n, count = 3 * len(rows.numbers), len(rows.source)
        self._pivot = np.full(count, -1)  # unknown of each row among those of all nodes
        self._scale = np.ones(count)
        room = (room & (rows.free > 0.0)).ravel()
        self._blocks: list[tuple[np.ndarray, np.ndarray]] = []  # unknowns of a group and its part of T
        self._inverse_rows, inverses = [], []
        for group in rows.groups:
            unknowns = (3 * group.nodes[:, None] + np.arange(3)).ravel()
            dense = group.dense(turned).reshape(len(group.rows), -1)
            row, column = _pivots(np.where(room[unknowns], dense, 0.0))
            pivots, every = dense[np.ix_(row, column)], np.eye(len(unknowns))
            scale = np.linalg.norm(dense[row], axis=1)
            others = dense[row].copy()
            others[:, column] = 0.0
            transform = every.copy()
            solved = np.linalg.inv(pivots) if len(row) else pivots
            transform[column] = -solved @ others
            transform[np.ix_(column, column)] = solved * scale
            self._blocks.append((unknowns, transform))
            self._pivot[group.rows[row]] = unknowns[column]
            self._scale[group.rows[row]] = scale
            inverses.append((group.rows[row], np.linalg.inv(pivots) if len(row) else pivots))
        self._solved = inverses
        self._turned = turned
        self._placed = np.flatnonzero(self._pivot >= 0)
        self._deferred = np.flatnonzero((self._pivot < 0) & rows.usable(jacobian))
        # entries of T in the rows of pivots
        parts = []
        for unknowns, transform in self._blocks:
            pivot = np.isin(unknowns, self._pivot[self._placed])
            at, column = np.nonzero((transform != 0.0) & pivot[:, None])
            parts.append((unknowns[at], unknowns[column], transform[at, column]))
        self._to, self._from, self._values = (
            np.concatenate([np.empty(0, dtype=kind), *(part[k] for part in parts)])
            for k, kind in ((0, np.int64), (1, np.int64), (2, np.float64))
        )
        self._owner = np.zeros(n, dtype=bool)
        self._owner[self._pivot[self._placed]] = True
        # pivots at this rank's nodes: local node, component, row
        place = np.full(len(rows.numbers), -1)
        place[rows.mine] = rows.here
        local = place[self._pivot[self._placed] // 3]
        here = local >= 0
        self._here = local[here], self._pivot[self._placed][here] % 3, self._placed[here]

    def _all(self, array: np.ndarray) -> np.ndarray:
        """Return the unknowns (3 n,) of all nodes from an array whose first rows are owned nodes. Collective."""
        return self.rows.gather(array[: self.rows.mesh.n_owned]).ravel()

    def feasible(self, predictor: np.ndarray, u: np.ndarray, stiffness: np.ndarray) -> None:
        rows, here = self.rows, self.rows.here
        planes = np.zeros((len(rows.numbers), 0, 3)), np.zeros((len(rows.numbers), 0))
        k = rows.gather(stiffness)
        tolerance = PROJECTED * self.link.contact.length
        force, jacobian = rows.project(rows.gather(predictor + u), k, self._start, planes, tolerance)
        u[here] += (rows.forces(jacobian, force) * rows.free / k[:, None])[rows.mine]

    def forward(self, w: np.ndarray) -> None:
        every = self._all(w)
        pivots = np.bincount(self._to, self._values * every[self._from], minlength=len(every))
        self._write(w, np.where(self._owner, pivots, every))

    def _write(self, array: np.ndarray, every: np.ndarray) -> None:
        array[self.rows.here] = every.reshape(-1, 3)[self.rows.mine]

    def inverse(self, y: np.ndarray) -> None:
        rows, every = self.rows, self._all(y)
        along = rows.along(self._turned, every.reshape(-1, 3)) / self._scale
        every[self._pivot[self._placed]] = along[self._placed]
        self._write(y, every)

    def adjoint(self, g: np.ndarray) -> None:
        every = self._all(g)
        kept = np.where(self._owner, 0.0, every)
        self._write(g, kept + np.bincount(self._from, self._values * every[self._to], minlength=len(every)))

    def diagonal(self, blocks: BlocksOf, diagonal: np.ndarray) -> None:
        rows = self.rows
        full = np.zeros((rows.mesh.n_owned, 3, 3))
        full[rows.here] = blocks(rows.here)
        full, every = rows.gather(full), np.zeros(3 * len(rows.numbers))
        for group, (unknowns, transform) in zip(rows.groups, self._blocks, strict=True):
            parts = transform.reshape(-1, 3, len(unknowns))
            every[unknowns] = np.einsum("nij,nik,nkj->j", parts, full[group.nodes], parts)
        self._write(diagonal, every)

    def matrix(self) -> PETSc.Mat:
        rows, mesh = self.rows, self.rows.mesh
        numbers = rows.gather(np.arange(mesh.first_node, mesh.first_node + mesh.n_owned).astype(float))
        columns: list[np.ndarray] = [np.array([3 * mesh.first_node + k]) for k in range(3 * mesh.n_owned)]
        self._places = []  # for each group: local rows, and the order of its unknowns in PETSc numbering
        local = np.full(len(rows.numbers), -1)
        local[rows.mine] = rows.here
        for group, (unknowns, _) in zip(rows.groups, self._blocks, strict=True):
            wide = (3 * numbers[group.nodes].astype(np.int64)[:, None] + np.arange(3)).ravel()
            order = np.argsort(wide)
            mine = np.flatnonzero(local[unknowns // 3] >= 0)
            at = 3 * local[unknowns[mine] // 3] + unknowns[mine] % 3
            for row in at:
                columns[row] = wide[order]
            self._places.append((mine, at, order))
        pointers = np.append(0, np.cumsum([len(some) for some in columns])).astype(PETSc.IntType)
        indices = np.concatenate([np.empty(0), *columns]).astype(PETSc.IntType)
        self._pattern = pointers, indices
        matrix = PETSc.Mat().create(comm=mesh.comm)
        size = 3 * mesh.n_owned, 3 * mesh.n_nodes
        matrix.setSizes((size, size), bsize=3)
        matrix.setType(PETSc.Mat.Type.AIJ)
        matrix.setPreallocationCSR((pointers, indices))
        self.refresh(matrix)
        return matrix

    def refresh(self, matrix: PETSc.Mat) -> None:
        pointers, indices = self._pattern
        values = np.ones(len(indices))
        for (mine, at, order), (_, transform) in zip(self._places, self._blocks, strict=True):
            for row, k in zip(at, mine, strict=True):
                values[pointers[row] : pointers[row + 1]] = transform[k][order]
        matrix.setValuesCSR(pointers, indices, values)
        matrix.assemble()

    def bound(self, x: np.ndarray, w: np.ndarray, lower: np.ndarray) -> None:
        values = self.rows.values(self.rows.gather(x)) / self._scale
        node, component, row = self._here
        lower[node, component] = w[node, component] - values[row]

    def solve_forces(self, w: np.ndarray, g: np.ndarray, lower: np.ndarray, noise: float) -> None:
        every = self._all(g)
        node, component, row = self._here
        on = np.zeros(w.shape)
        on[node, component] = w[node, component] <= lower[node, component]
        on = self._all(on)
        self.link.release()
        self.link.jacobian = self.jacobian
        for rows, solved in self._solved:
            force = solved.T @ every[self._pivot[rows]]
            pressed = (on[self._pivot[rows]] > 0.0) & (force > noise)
            self.link.force[rows] = np.where(pressed, force, 0.0)

    def push(self, contact: np.ndarray, factor: float = 1.0) -> None:
        self.link.push(contact, factor)

    def kept(self, x: np.ndarray, slack: float) -> bool:
        rows, every = self.rows, self.rows.gather(x)
        values, pressed = rows.values(every), self.link.force > 0.0
        blocked = self._deferred[values[self._deferred] < -slack]
        if len(blocked):
            nodes = rows.numbers[rows.entry_node[rows.entry_row == blocked[0]]]
            raise NotConverged(
                f"walls and other constraints take all directions in which nodes {', '.join(map(str, nodes))} can keep "
                f"constraint {self.link.names[rows.source[blocked[0]]]!r}; use an explicit integrator"
            )
        if (values[self._placed] < -slack).any() or (np.abs(values[pressed]) > slack).any():
            return False
        if self._start is not None:
            return True
        turn = np.abs(rows.gradients(every) - self.jacobian).max(axis=1, initial=0.0)
        return not (turn[pressed[rows.entry_row]] > _TURN).any()

    def broken(self, x: np.ndarray, slack: float) -> bool:
        usable = self.rows.usable(self.jacobian)
        return bool((self.rows.values(self.rows.gather(x))[usable] < -slack).any())

    def release(self) -> None:
        self.link.release()


def _pivots(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows and columns (k,) of the pivots of a matrix (p, q) under complete pivoting, largest first."""
    left, rows, columns = matrix.copy(), [], []
    for _ in range(len(left)):
        at, column = np.unravel_index(np.abs(left).argmax(), left.shape)
        if not abs(left[at, column]) > _LEAST:
            break
        rows.append(at)
        columns.append(column)
        left -= np.outer(left[:, column] / left[at, column], left[at])
        left[at], left[:, column] = 0.0, 0.0
    return np.array(rows, dtype=np.int64), np.array(columns, dtype=np.int64)

"""The coarse matrix of multigrid on a background grid: P^T K P, summed bar by bar without the matrix K.

A bar with stiffness k and weights w of the corners at its ends a and b adds (w_b - w_a) (w_b - w_a)^T k. As a sum of
matrices of rank one (k = c n n^T + g I) it goes to a small dense matrix of its box, which is added to the sparse one
when all bars of the box are done. Components that supports or walls hold do not move with the corners: the
interpolation of these nodes is multiplied by matrices (3, 3).
"""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from ..mesh.exchange import Router
from .background_grid import BackgroundGrid
from .grid_sums import arrange, assemble, neighbours, stabilise
from .matrix import expand_columns

__all__ = ["CoarseMatrix"]

_SHIFT = 1e-8  # of the diagonal: corners that few nodes depend on may have functions that depend on each other


class CoarseMatrix:
    """The pattern of the coarse matrix, from which :meth:`make` makes matrices. Construction is collective."""

    def __init__(self, grid: BackgroundGrid) -> None:
        self.grid = grid
        elements, local = grid.elements, len(grid.numbers)
        flat = elements.corners.ravel()
        order = np.argsort(flat, kind="stable")
        order = order[np.count_nonzero(flat < 0) :]
        starts = np.searchsorted(flat[order], np.arange(local + 1))
        of_corner = (order // 16).astype(np.int32)
        self._ptr = np.zeros(local + 1, np.int64)
        count = neighbours(elements.corners, starts, of_corner, self._ptr, np.empty(0, np.int32))
        self._columns = np.empty(count, np.int32)
        if count:
            neighbours(elements.corners, starts, of_corner, self._ptr, self._columns)
        self._agree()

    def _agree(self) -> None:
        """Send the pattern of other ranks' rows to these. Collective."""
        grid, owned = self.grid, self.grid.n_owned
        rows = np.repeat(np.arange(len(grid.numbers)), np.diff(self._ptr))
        columns = grid.numbers[self._columns]
        self._n_own = int(self._ptr[owned])
        foreign = slice(self._n_own, None)
        self._router = Router(grid.comm, grid.owners[rows[foreign]])
        arrived = self._router.send(np.stack([grid.numbers[rows[foreign]], columns[foreign]], axis=1))
        all_rows = np.concatenate([rows[: self._n_own], arrived[:, 0] - grid.first])
        keys = all_rows * grid.total + np.concatenate([columns[: self._n_own], arrived[:, 1]])
        unique, slots = np.unique(keys, return_inverse=True)
        self._slots = slots.astype(np.int64)
        self._row_of = unique // max(grid.total, 1)
        block_columns = unique - self._row_of * grid.total
        self._block_ptr = np.zeros(owned + 1, np.int64)
        np.cumsum(np.bincount(self._row_of, minlength=owned), out=self._block_ptr[1:])
        self._diagonal = np.flatnonzero(block_columns == self._row_of + grid.first)
        widths = np.repeat(3 * np.diff(self._block_ptr), 3)
        self._pointers = np.concatenate([[0], np.cumsum(widths)]).astype(PETSc.IntType)
        self._scalar_columns = np.empty(int(self._pointers[-1]), PETSc.IntType)
        expand_columns(self._block_ptr, block_columns, self._scalar_columns)

    def make(
        self,
        ends: np.ndarray,
        x: np.ndarray,
        stored: np.ndarray,
        nodal: np.ndarray,
        place: np.ndarray,
        turned: np.ndarray,
        extra: np.ndarray,
    ) -> PETSc.Mat:
        """Return the matrix for bars at ``x`` (local, 3) with ``stored`` (2, b), nodal inertia (owned,), and matrices
        of some local nodes, see :func:`~pfem_petsc.solvers.grid_sums.assemble`. Collective."""
        grid = self.grid
        each = grid.elements
        blocks = np.zeros((len(self._columns), 3, 3))
        assemble(
            grid.t, grid.base, each.boxes, each.corners, each.bars, each.bar_starts, ends, x, stored,
            each.nodes, each.node_starts, nodal, extra, place, turned, self._ptr, self._columns, blocks,
        )  # fmt: skip
        arrived = self._router.send(blocks[self._n_own :].reshape(-1, 9)).reshape(-1, 3, 3)
        values = np.zeros(len(self._scalar_columns))
        own = self._n_own
        arrange(blocks[:own], self._slots[:own], self._block_ptr, self._row_of, values)
        arrange(arrived, self._slots[own:], self._block_ptr, self._row_of, values)
        stabilise(self._block_ptr, self._diagonal, _SHIFT, values)
        size = (3 * grid.n_owned, 3 * grid.total)
        matrix = PETSc.Mat().createAIJ(
            (size, size), bsize=3, csr=(self._pointers, self._scalar_columns, values), comm=grid.comm
        )
        matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        return matrix

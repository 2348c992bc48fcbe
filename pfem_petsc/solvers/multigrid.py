"""Multigrid without a matrix of the truss: polynomial smoothing by products, and a coarse matrix summed bar by bar."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from petsc4py import PETSc
from scipy.sparse import bsr_array, csr_array

from ..mechanics.compiled import kernel
from ..mesh.exchange import Router
from .background_grid import BackgroundGrid, Summands, assemble
from .linear import reproducible_products
from .matrix_free import MatrixFreeHessian, full_blocks

if TYPE_CHECKING:
    from ..stepping.model import Model
    from .matrix import StepProblem


_SHIFT = 1e-8  # of the diagonal: corners that few nodes depend on may have functions that depend on each other


class CoarseMatrix:
    """The pattern of the coarse matrix, from which :meth:`make` makes matrices. Construction is collective."""

    def __init__(self, grid: BackgroundGrid) -> None:
        self.grid = grid
        corners = grid.elements.corners
        starts = np.append(0, np.cumsum((corners >= 0).sum(axis=1)))
        columns = corners[corners >= 0]
        meets = csr_array((np.ones(len(columns)), columns, starts), shape=(len(corners), len(grid.numbers)))
        neighbours = (meets.T @ meets).tocsr()  # in an element
        neighbours.sort_indices()
        self._ptr, self._columns = neighbours.indptr.astype(np.int64), neighbours.indices.astype(np.int32)
        # the pattern of other ranks' rows is sent to these
        owned = grid.n_owned
        rows = np.repeat(np.arange(len(grid.numbers)), np.diff(self._ptr))
        columns = grid.numbers[self._columns]
        self._n_own = int(self._ptr[owned])
        foreign = slice(self._n_own, None)
        self._router = Router(grid.comm, grid.owners[rows[foreign]])
        arrived = self._router.send(np.stack([grid.numbers[rows[foreign]], columns[foreign]], axis=1))
        all_rows = np.concatenate([rows[: self._n_own], arrived[:, 0] - grid.first])
        keys = all_rows * grid.total + np.concatenate([columns[: self._n_own], arrived[:, 1]])
        unique, slots = np.unique(keys, return_inverse=True)
        self._slots = slots
        row_of = unique // max(grid.total, 1)
        self._block_columns = unique - row_of * grid.total
        self._block_ptr = np.append(0, np.cumsum(np.bincount(row_of, minlength=owned)))
        self._diagonal = np.flatnonzero(self._block_columns == row_of + grid.first)

    def make(self, parts: Summands) -> PETSc.Mat:
        """Return the matrix of what it is summed of. Collective."""
        grid = self.grid
        blocks = np.zeros((len(self._columns), 3, 3))
        assemble(grid.t, grid.base, grid.elements, parts, (self._ptr, self._columns), blocks)
        arrived = self._router.send(blocks[self._n_own :].reshape(-1, 9)).reshape(-1, 3, 3)
        values = np.zeros((len(self._block_columns), 3, 3))
        values[self._slots[: self._n_own]] = blocks[: self._n_own]
        np.add.at(values, self._slots[self._n_own :], arrived)
        at = self._diagonal[:, None], np.arange(3), np.arange(3)
        values[at] = np.where(values[at] > 0.0, values[at] * (1.0 + _SHIFT), 1.0)
        size = (3 * grid.n_owned, 3 * grid.total)
        rows = bsr_array((values, self._block_columns, self._block_ptr), shape=size).tocsr()
        pattern = rows.indptr.astype(PETSc.IntType), rows.indices.astype(PETSc.IntType)
        matrix = PETSc.Mat().createAIJ((size, size), bsize=3, csr=(*pattern, rows.data), comm=grid.comm)
        matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        return matrix


@kernel
def invert(blocks):
    """Invert symmetric matrices (n, 6): xx, xy, xz, yy, yz, zz, in place; singular ones become zero."""
    for k in range(len(blocks)):
        a, b, c, d, e, f = blocks[k]
        xx, xy, xz = d * f - e * e, c * e - b * f, b * e - c * d
        determinant = a * xx + b * xy + c * xz
        inverse = 1.0 / determinant if determinant > 0.0 else 0.0
        blocks[k, 0] = xx * inverse
        blocks[k, 1] = xy * inverse
        blocks[k, 2] = xz * inverse
        blocks[k, 3] = (a * f - c * c) * inverse
        blocks[k, 4] = (b * c - a * e) * inverse
        blocks[k, 5] = (a * d - b * b) * inverse


@kernel
def smooth(inverse, product, of_last, of_residual, r, z, x):
    """Subtract the product from the residual r, and make a step z of the polynomial: all (n, 3)."""
    for k in range(len(r)):
        r0 = r[k, 0] - product[k, 0]
        r1 = r[k, 1] - product[k, 1]
        r2 = r[k, 2] - product[k, 2]
        r[k, 0] = r0
        r[k, 1] = r1
        r[k, 2] = r2
        z0 = of_last * z[k, 0] + of_residual * (inverse[k, 0] * r0 + inverse[k, 1] * r1 + inverse[k, 2] * r2)
        z1 = of_last * z[k, 1] + of_residual * (inverse[k, 1] * r0 + inverse[k, 3] * r1 + inverse[k, 4] * r2)
        z2 = of_last * z[k, 2] + of_residual * (inverse[k, 2] * r0 + inverse[k, 4] * r1 + inverse[k, 5] * r2)
        z[k, 0] = z0
        z[k, 1] = z1
        z[k, 2] = z2
        x[k, 0] += z0
        x[k, 1] += z1
        x[k, 2] += z2


_PREFIX = "pfem_coarse_"
_DEGREE = 2  # of the polynomials; 1 takes twice as many iterations, 3 and 4 save few
_LARGEST = 2.0  # bound on the eigenvalues of D^-1 K


class GridMultigrid:
    """Multigrid of the definite part of a Hessian. Construction is collective.

    Unknowns at nodes with frames (oblique walls) are other coordinates of the same displacements. Coordinates of links,
    which join nodes, and friction, with which the Hessian is not symmetric, do not fit: such solves have the diagonal
    as preconditioner.

    Options: prefix ``pfem_coarse_``, for the solver of the coarse matrix.

    Attributes
    ----------
    reduced : whether the last :meth:`make` was for such a solve
    """

    def __init__(self, model: Model) -> None:
        self.model, self.mesh = model, model.mesh
        self.product = MatrixFreeHessian(model)
        self.grid = BackgroundGrid(model.mesh)
        self.pattern = CoarseMatrix(self.grid)
        self.reduced = False
        owned = self.mesh.n_owned
        self._inverse = np.zeros((owned, 6))
        self._r, self._z, self._x, self._e, self._product = (np.zeros((owned, 3)) for _ in range(5))
        self._special = np.empty(0, np.int64)
        self._turned = np.empty((0, 3, 3))
        self._solver: PETSc.PC | None = None
        self._matrix: PETSc.Mat | None = None
        size = (3 * self.grid.n_owned, 3 * self.grid.total)
        self._right = PETSc.Vec().createMPI(size, bsize=3, comm=self.mesh.comm)
        self._left = self._right.duplicate()
        self._new_solver(None)  # reports invalid PETSc options before the first step

    def couple(self, rows: object) -> None:
        """Do nothing: with coordinates of rows the diagonal is the preconditioner."""

    def make(self, problem: StepProblem, held: np.ndarray) -> None:
        """Set up at the positions of a problem; ``held`` (owned, 3) nonzero for active unknowns. Collective."""
        product = self.product
        product.linearise(problem)
        product.make_definite()
        active = held != 0.0
        product.extension.kept = np.flatnonzero(~active) if active.any() else None
        self.reduced = not problem.transform.nodewise
        if self.reduced:
            diagonal = product.diagonal()
            diagonal[active] = problem.scale
            self._diagonal = diagonal
            return
        blocks = product.blocks()
        frames = problem.transform.frames
        at, kept = self._free_parts(active, frames.nodes)
        basis, inverse = np.tile(np.eye(3), (2, len(at), 1, 1))
        basis[np.searchsorted(at, frames.nodes)] = frames.basis
        inverse[np.searchsorted(at, frames.nodes)] = frames.inverse
        to_x = inverse @ kept
        full = np.swapaxes(to_x, 1, 2) @ full_blocks(blocks[at]) @ to_x + problem.scale * (np.eye(3) - kept)
        blocks[at] = full.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]
        invert(blocks)
        self._inverse = blocks
        self._special, self._turned = at, kept @ basis
        place, turned = self.mesh.with_ghosts(at, to_x @ basis)
        self._make_coarse(problem, np.flatnonzero(place >= 0), turned)

    def _free_parts(self, active: np.ndarray, framed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the owned nodes with prescribed or active components or frames (k,), ascending, and the projections
        (k, 3, 3) of their unknowns on those left free."""
        held = np.maximum(self.model.supports.spans(), np.eye(3) * active[:, :, None])
        special = held.any(axis=(1, 2))
        special[framed] = True
        nodes = np.flatnonzero(special)
        return nodes, np.eye(3) - held[nodes]

    def _make_coarse(self, problem: StepProblem, nodes: np.ndarray, turned: np.ndarray) -> None:
        mesh, product = self.mesh, self.product
        extra_nodes, extra = product.extra_blocks()
        every = np.union1d(nodes, extra_nodes)
        place = np.full(mesh.n_local, -1, np.int32)
        place[every] = np.arange(len(every), dtype=np.int32)
        matrices = np.tile(np.eye(3), (len(every), 1, 1))
        matrices[place[nodes]] = turned
        further = np.zeros((len(every), 3, 3))
        further[place[extra_nodes]] = extra
        matrix = self.pattern.make(
            Summands(mesh.bars, product.x, product.stored, problem.nodal, place, matrices, further)
        )
        self._new_solver(matrix)
        self._solver.setCoordinates(self._positions(problem)[: self.grid.n_owned])
        with reproducible_products(mesh.comm):
            self._solver.setUp()

    def _positions(self, problem: StepProblem) -> np.ndarray:
        """Return positions (local corners, 3) of the corners, moved by the affine map that fits the nodes best, with
        origin at the centre. Collective."""
        mesh, owned = self.mesh, self.mesh.n_owned
        x, points = problem.x[:owned], mesh.points[:owned]
        sums = mesh.comm.allreduce(np.stack([x.sum(axis=0), points.sum(axis=0)])) / mesh.n_nodes
        away = points - sums[1]
        moments = mesh.comm.allreduce(np.concatenate([away.T @ away, (x - sums[0]).T @ away]))
        # a plane truss determines the map in its plane only: across it the nodes stay apart as in the mesh
        size = max(float(np.trace(moments[:3])), 1e-300)
        weak = 1e-9 * size * np.eye(3)
        gradient = np.linalg.solve((moments[:3] + weak).T, (moments[3:] + weak).T).T
        return (self.grid.positions - sums[1]) @ gradient.T

    def _new_solver(self, matrix: PETSc.Mat | None) -> None:
        if self._solver is not None:
            self._solver.destroy()
        if self._matrix is not None:
            self._matrix.destroy()
        self._matrix = matrix
        self._solver = PETSc.PC().create(self.mesh.comm)
        self._solver.setOptionsPrefix(_PREFIX)
        if matrix is not None:
            self._solver.setOperators(matrix, matrix)
        self._solver.setType("gamg")
        self._solver.setFromOptions()

    def apply(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Compute one cycle y = P x of all unknowns. Collective."""
        given = x.getArray(readonly=True).reshape(-1, 3)
        if self.reduced:
            y.setArray((given / self._diagonal).ravel())
            return
        r, z, found, product = self._r, self._z, self._x, self._product
        r[:] = given
        z[:] = 0.0
        found[:] = 0.0
        product[:] = 0.0
        self._polynomial()
        self.product.extension.times(z, product)
        r -= product
        product[:] = 0.0
        self._correct()
        self.product.extension.times(self._e, product)
        z[:] = 0.0
        self._polynomial()
        y.setArray(found.ravel())

    def _polynomial(self) -> None:
        """Make the steps of the polynomial; the residual lacks the product at the start, and that of the last step at
        the end."""
        for k in range(1, _DEGREE + 1):
            if k > 1:
                self.product.extension.times(self._z, self._product)
            of_last, of_residual = (2 * k - 3) / (2 * k + 1), (8 * k - 4) / ((2 * k + 1) * _LARGEST)
            smooth(self._inverse, self._product, of_last, of_residual, self._r, self._z, self._x)

    def _correct(self) -> None:
        """Add the coarse correction of the residual to the solution."""
        grid, r = self.grid, self._r
        at = self._special
        if len(at):
            self._e[:] = r
            r = self._e
            r[at] = np.einsum("kji,kj->ki", self._turned, r[at])
        coarse = grid.prolongation.T @ r
        grid.give(coarse)
        self._right.setArray(coarse[: grid.n_owned].ravel())
        self._solver.apply(self._right, self._left)
        coarse[: grid.n_owned] = self._left.getArray(readonly=True).reshape(-1, 3)
        grid.bring(coarse)
        self._e = grid.prolongation @ coarse
        self._e[at] = np.einsum("kij,kj->ki", self._turned, self._e[at])
        self._x += self._e

    def destroy(self) -> None:
        """Free the PETSc objects."""
        for thing in (self._solver, self._matrix, self._right, self._left, self.product, self.grid):
            if thing is not None:
                thing.destroy()

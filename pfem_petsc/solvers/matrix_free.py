"""The Hessian as a matrix-free operator: the stiffness is applied bar by bar and never assembled.

Two numbers per bar are stored instead of 36 matrix entries and their columns, so a product reads a tenth of the memory.
Contact problems use the restriction of the operator to their inactive unknowns.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from petsc4py import PETSc

from ..mechanics.mass import consistent_product
from .outlive import at_exit, outlive
from .product_kernels import add_blocks, add_diagonals, add_products, drop_negative, inertia_products
from .restricted import Context, Extension

if TYPE_CHECKING:
    from ..stepping.model import Model
    from ..stepping.problem import StepProblem

__all__ = ["MatrixFreeHessian", "full_blocks"]


class MatrixFreeHessian:
    """Matrix-free replacement of :class:`~pfem_petsc.solvers.matrix.HessianMatrix` for symmetric schemes.

    Attributes
    ----------
    mat : PETSc matrix of type python
    bounded : the matrix of steps with bounds, equal to ``mat``
    x : (local, 3) positions at the last :meth:`linearise` [m]
    stored : (2, b) data of each bar for the product, see :meth:`~pfem_petsc.mechanics.bars.Bars.stiffnesses`
    """

    _extension: Extension | None = None

    def __init__(self, model: Model) -> None:
        self.model = model
        mesh = model.mesh
        self.mesh = mesh
        local, total = 3 * mesh.n_owned, 3 * mesh.n_nodes
        self.mat = PETSc.Mat().createPython(((local, total), (local, total)), Context(self), comm=mesh.comm)
        self.mat.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        self.mat.setUp()
        at_exit(outlive, self.mat)
        self.bounded = self.mat
        self.stored = np.zeros((2, len(mesh.bars)))
        self.x = np.zeros((mesh.n_local, 3))
        self._u = np.zeros((mesh.n_local, 3))
        self._out = np.zeros((mesh.n_local, 3))
        self._problem = None

    def update(self, problem: StepProblem, w: np.ndarray) -> None:
        """Linearise at ``w``. Collective."""
        problem.place(problem.increment(w))
        self.linearise(problem)
        self.mat.stateIncrease()

    def linearise(self, problem: StepProblem) -> None:
        """As :meth:`update`, at the current positions of the problem."""
        self._problem = problem
        self._left = problem.transform.left()
        self.x[:] = problem.x
        self.model.bars.stiffnesses(self.x, problem.balance.weight, self.stored)

    def put(self, problem: StepProblem, bars: np.ndarray) -> None:
        """Linearise at the predictor of a problem, with the stiffness (5, b) of ``Bars.linearise``. Collective."""
        self.update(problem, np.zeros_like(problem.u))
        self.stored[0], self.stored[1] = bars[3] / self.model.bars.lengths(self.x) ** 2, bars[4]

    def make_definite(self) -> None:
        """Drop negative eigenvalues of the bars' stiffness, due to compression or softening laws."""
        drop_negative(self.mesh.bars, self.x, self.stored)

    @property
    def extension(self) -> Extension:
        """Return the operator with rows and columns of the identity for active unknowns."""
        if self._extension is None:
            self._extension = Extension(self)
        return self._extension

    def mult(self, mat: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Y = H x; called by PETSc."""
        owned = self.mesh.n_owned
        self._u[:owned] = x.getArray(readonly=True).reshape(owned, 3)
        self.apply()
        with y as out:
            out[:] = self._out[:owned].reshape(-1)

    def apply(self) -> None:
        """Apply H to the owned rows of :attr:`_u`, and write those of :attr:`_out`. Collective."""
        problem, owned = self._problem, self.mesh.n_owned
        u, out = self._u, self._out
        supports = self.model.supports
        if supports.any:
            held = problem.scale * supports.get(u)
            supports.clear(u[:owned])
        problem.transform.forward(u)
        self.mesh.update_ghosts(u)
        inertia, bars = self.model.inertia, self.model.bars
        if inertia.consistent:
            out[:] = 0.0
            coefficients = inertia.coefficients(problem.balance.alpha, problem.balance.eta)
            for block, coefficient in zip(bars.blocks, coefficients, strict=True):
                consistent_product(bars.ends, bars.mesh_lengths, block.start, block.stop, 6.0 * coefficient, u, out)
            if inertia.points.any:
                out[:owned] += inertia.points.nodal(problem.balance.alpha, problem.balance.eta)[:, None] * u[:owned]
        else:
            inertia_products(problem.nodal, u, out)
            if inertia.redistribution is not None:
                moved = inertia.redistribution
                out[moved.touched] += problem.balance.alpha * np.einsum("kij,kj->ki", moved.tensors, u[moved.touched])
        for block in bars.blocks:
            add_products(block.sweep, bars.far, self.x, self.stored, u, out)
        if bars.springs is not None:
            bars.springs.add_product(problem.balance.weight, u, out)
        problem.transform.linear(self._left, u, out)
        if supports.any:
            supports.put(out, held)

    @property
    def scale(self) -> float:
        """Return the entry on the diagonal of rows of prescribed components."""
        return self._problem.scale

    def diagonal(self) -> np.ndarray:
        """Return the diagonal of H (owned, 3)."""
        problem, supports = self._problem, self.model.supports
        if problem.transform.identity and supports.inclined is None:
            diagonal = self._plain_diagonal()
        else:
            blocks = self.blocks()
            diagonal = blocks[:, [0, 3, 5]]
            problem.transform.diagonal(self._left, lambda nodes: full_blocks(blocks[nodes]), diagonal)
        if supports.any:
            diagonal[supports.fixed] = problem.scale
        if supports.inclined is not None:
            at, free = supports.inclined.nodes, supports.inclined.free
            full = free @ full_blocks(blocks[at]) @ free + problem.scale * (np.eye(3) - free)
            diagonal[at] = np.einsum("mii->mi", full)
        return diagonal

    def _plain_diagonal(self) -> np.ndarray:
        """Return the diagonal (owned, 3), without supports and transform."""
        owned, bars = self.mesh.n_owned, self.model.bars
        minus, plus = np.zeros((2, self.mesh.n_local, 3))
        for block in bars.blocks:
            add_diagonals(block.sweep, bars.far, self.x, self.stored, minus, plus)
        diagonal = plus[:owned]
        diagonal -= minus[:owned]
        for nodes, extra in self._additions():
            diagonal[nodes] += np.einsum("kii->ki", extra)
        diagonal += self._nodal()[:, None]
        return diagonal

    def blocks(self) -> np.ndarray:
        """Return the blocks on the diagonal of H (owned, 6): xx, xy, xz, yy, yz, zz; without supports and transform."""
        blocks = np.zeros((self.mesh.n_local, 6))
        add_blocks(self.mesh.bars, self.x, self.stored, blocks)
        blocks = blocks[: self.mesh.n_owned]
        for nodes, extra in self._additions():
            blocks[nodes] += extra.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]
        nodal = self._nodal()
        for axis in (0, 3, 5):
            blocks[:, axis] += nodal
        return blocks

    def _nodal(self) -> np.ndarray:
        """Return what inertia adds to the diagonal (owned,)."""
        problem, inertia = self._problem, self.model.inertia
        if not inertia.consistent:
            return problem.nodal
        nodal = 2.0 / 3.0 * problem.nodal  # the diagonal of the bars' consistent mass is two thirds of the lumped one
        if inertia.points.any:
            nodal += inertia.points.nodal(problem.balance.alpha, problem.balance.eta) / 3.0
        return nodal

    def _additions(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return owned nodes (k,) and what they add to their blocks on the diagonal (k, 3, 3), besides bars and
        inertia: springs, and masses that contact has moved."""
        balance, springs, moved = self._problem.balance, self.model.bars.springs, self.model.inertia.redistribution
        found = [] if springs is None else [(springs.nodes, balance.weight * springs.stiffness)]
        return found if moved is None else [*found, (moved.touched, balance.alpha * moved.tensors)]

    def extra_blocks(self) -> tuple[np.ndarray, np.ndarray]:
        """Return owned nodes (k,), ascending, and the sum of what springs and moved masses add to their blocks on the
        diagonal (k, 3, 3)."""
        parts = self._additions()
        nodes = np.unique(np.concatenate([np.empty(0, np.int64), *(nodes for nodes, _ in parts)]))
        total = np.zeros((len(nodes), 3, 3))
        for some, extra in parts:
            total[np.searchsorted(nodes, some)] += extra
        return nodes, total

    def couple(self, links: Iterable) -> None:
        """Do nothing: coordinates of links are applied with the bars."""

    def destroy(self) -> None:
        """Free the PETSc matrices."""
        if self._extension is not None:
            self._extension.mat.destroy()
        self.mat.destroy()


def full_blocks(upper: np.ndarray) -> np.ndarray:
    """Return symmetric matrices (n, 3, 3) from xx, xy, xz, yy, yz, zz (n, 6)."""
    return upper[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)

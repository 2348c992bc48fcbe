"""The Hessian as a matrix-free operator: the stiffness is applied bar by bar and never assembled.

Five numbers per bar are stored (n and the two stiffnesses) instead of 36 matrix entries and their columns, so a product
reads a quarter of the memory. Contact problems use the restriction of the operator to their inactive unknowns.
"""

from __future__ import annotations

import weakref
from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from petsc4py import PETSc

from ..mechanics.compiled import inlined, kernel
from ..mechanics.mass import consistent_product
from ..mechanics.rows import CHUNK
from ..mechanics.strips import add_strips, differences
from .outlive import at_exit, outlive

if TYPE_CHECKING:
    from ..stepping.model import Model
    from ..stepping.problem import StepProblem

__all__ = ["MatrixFreeHessian"]

_2, _3 = 2 * CHUNK, 3 * CHUNK


@kernel
def _product(sweep, far, stored, u, out):
    """Add K u to ``out``, chunk by chunk of a :class:`~pfem_petsc.mechanics.sweep.Sweep`."""
    heads, fars, starts, chunks = sweep.heads, sweep.fars, sweep.starts, sweep.chunks
    # parts of one array, so that the compiler need not check whether they overlap
    work = np.ones(4 * CHUNK)
    dx, dy, dz, one = work[:CHUNK], work[CHUNK:_2], work[_2:_3], work[_3:]
    for chunk in range(len(sweep.diagonal)):
        if not sweep.diagonal[chunk]:
            _stars(chunk, heads, starts, chunks, far, stored, u, out)
            continue
        first = starts[chunks[chunk]]
        n = starts[chunks[chunk + 1]] - first
        for run in range(chunks[chunk], chunks[chunk + 1]):
            at = starts[run]
            differences(u, heads[run], fars[run], starts[run + 1] - at, dx, dy, dz, at - first)
        last = first + n
        nx, ny, nz = stored[0, first:last], stored[1, first:last], stored[2, first:last]
        axial, across = stored[3, first:last], stored[4, first:last]
        for i in range(n):
            along = axial[i] * (nx[i] * dx[i] + ny[i] * dy[i] + nz[i] * dz[i])
            dx[i] = along * nx[i] + across[i] * dx[i]
            dy[i] = along * ny[i] + across[i] * dy[i]
            dz[i] = along * nz[i] + across[i] * dz[i]
        for run in range(chunks[chunk], chunks[chunk + 1]):
            at = starts[run]
            add_strips(out, heads[run], fars[run], starts[run + 1] - at, dx, dy, dz, one, at - first)


@inlined
def _stars(chunk, heads, starts, chunks, far, stored, u, out):
    """Add the products of a chunk whose runs are stars."""
    for run in range(chunks[chunk], chunks[chunk + 1]):
        a = heads[run]
        ux = u[a, 0]
        uy = u[a, 1]
        uz = u[a, 2]
        sx = 0.0
        sy = 0.0
        sz = 0.0
        for k in range(starts[run], starts[run + 1]):
            b = far[k]
            dx = u[b, 0] - ux
            dy = u[b, 1] - uy
            dz = u[b, 2] - uz
            nx = stored[0, k]
            ny = stored[1, k]
            nz = stored[2, k]
            along = stored[3, k] * (nx * dx + ny * dy + nz * dz)
            across = stored[4, k]
            fx = along * nx + across * dx
            fy = along * ny + across * dy
            fz = along * nz + across * dz
            sx += fx
            sy += fy
            sz += fz
            out[b, 0] += fx
            out[b, 1] += fy
            out[b, 2] += fz
        out[a, 0] -= sx
        out[a, 1] -= sy
        out[a, 2] -= sz


@kernel
def _diagonal(bars, stored, blocks):
    """Add the diagonal blocks (local nodes, 6): xx, xy, xz, yy, yz, zz."""
    for k in range(len(bars)):
        c = stored[3, k]
        g = stored[4, k]
        nx = stored[0, k]
        ny = stored[1, k]
        nz = stored[2, k]
        for end in range(2):
            i = bars[k, end]
            blocks[i, 0] += c * nx * nx + g
            blocks[i, 1] += c * nx * ny
            blocks[i, 2] += c * nx * nz
            blocks[i, 3] += c * ny * ny + g
            blocks[i, 4] += c * ny * nz
            blocks[i, 5] += c * nz * nz + g


class _Restriction:
    """H restricted to some of the unknowns of each rank, the inactive set of a contact problem.

    It holds no reference to its PETSc matrix, which refers to it: Python's garbage collector cannot see a cycle through
    PETSc, so it would never be freed.
    """

    def __init__(self, whole: MatrixFreeHessian, kept: np.ndarray) -> None:
        self.whole = whole
        self.kept = kept.astype(np.int64)

    def matrix(self) -> PETSc.Mat:
        """Create a PETSc matrix for it. Collective."""
        n = len(self.kept)
        matrix = PETSc.Mat().createPython(((n, None), (n, None)), self, comm=self.whole.mesh.comm)
        matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        matrix.setUp()
        return matrix

    def mult(self, mat: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Compute y = H x with zeros for the other unknowns; called by PETSc."""
        whole = self.whole
        u = whole._u[: whole.mesh.n_owned].reshape(-1)
        u[:] = 0.0
        u[self.kept] = x.getArray(readonly=True)
        whole.apply()
        y.setArray(whole._out[: whole.mesh.n_owned].reshape(-1)[self.kept])

    def getDiagonal(self, mat: PETSc.Mat, d: PETSc.Vec) -> None:  # noqa: N802 - PETSc's name
        """Write the diagonal of the restriction; called by PETSc."""
        d.setArray(self.whole.diagonal().reshape(-1)[self.kept])


class _Context:
    """Python context of an operator that owns its PETSc matrix; does not keep the operator alive."""

    def __init__(self, operator: _Extension | MatrixFreeHessian) -> None:
        self.operator = weakref.ref(operator)

    def mult(self, mat: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Y = H x; called by PETSc."""
        self.operator().mult(mat, x, y)

    def getDiagonal(self, mat: PETSc.Mat, d: PETSc.Vec) -> None:  # noqa: N802 - PETSc's name
        """Write the diagonal of H; called by PETSc."""
        d.setArray(self.operator().diagonal().ravel())

    def createSubMatrix(  # noqa: N802 - PETSc's name
        self, mat: PETSc.Mat, rows: PETSc.IS, columns: PETSc.IS, out: PETSc.Mat | None = None
    ) -> PETSc.Mat:
        """Return the restriction of H to some unknowns; called by PETSc."""
        whole = self.operator()
        return _Restriction(whole, rows.getIndices() - 3 * whole.mesh.first_node).matrix()


class _Extension:
    """H of all unknowns, with rows and columns of active unknowns replaced by those of a scaled identity."""

    def __init__(self, whole: MatrixFreeHessian) -> None:
        self.whole = whole
        self.kept: np.ndarray | None = None
        local, total = 3 * whole.mesh.n_owned, 3 * whole.mesh.n_nodes
        context = _Context(self)
        self.mat = PETSc.Mat().createPython(((local, total), (local, total)), context, comm=whole.mesh.comm)
        self.mat.setBlockSize(3)
        self.mat.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        self.mat.setUp()
        at_exit(outlive, self.mat)

    def mult(self, mat: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Y = H x; called by PETSc."""
        whole, kept = self.whole, self.kept
        if kept is None:
            whole.mult(mat, x, y)
            return
        given = x.getArray(readonly=True)
        u = whole._u[: whole.mesh.n_owned].reshape(-1)
        u[:] = 0.0
        u[kept] = given[kept]
        whole.apply()
        with y as out:
            out[:] = whole._problem.scale * given
            out[kept] = whole._out[: whole.mesh.n_owned].reshape(-1)[kept]


class MatrixFreeHessian:
    """Matrix-free replacement of :class:`~pfem_petsc.solvers.matrix.HessianMatrix` for symmetric schemes.

    Attributes
    ----------
    mat : PETSc matrix of type python
    bounded : the matrix of steps with bounds, equal to ``mat``
    stored : (5, b) data of each bar for the product, see :meth:`~pfem_petsc.mechanics.bars.Bars.linearise`
    """

    _extension: _Extension | None = None

    def __init__(self, model: Model) -> None:
        self.model = model
        mesh = model.mesh
        self.mesh = mesh
        local, total = 3 * mesh.n_owned, 3 * mesh.n_nodes
        self.mat = PETSc.Mat().createPython(((local, total), (local, total)), _Context(self), comm=mesh.comm)
        self.mat.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        self.mat.setUp()
        at_exit(outlive, self.mat)
        self.bounded = self.mat
        self.stored = np.zeros((5, len(mesh.bars)))
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
        self.model.bars.linearise(problem.x, problem.balance.weight, self.stored)

    def make_definite(self) -> None:
        """Drop negative eigenvalues of the bars' stiffness, due to compression or softening laws."""
        axial = np.maximum(self.stored[3] + self.stored[4], 0.0)
        np.maximum(self.stored[4], 0.0, out=self.stored[4])
        np.subtract(axial, self.stored[4], out=self.stored[3])

    @property
    def extension(self) -> _Extension:
        """Return the operator with rows and columns of the identity for active unknowns."""
        if self._extension is None:
            self._extension = _Extension(self)
        return self._extension

    def mult(self, mat: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Y = H x; called by PETSc."""
        owned = self.mesh.n_owned
        self._u[:owned] = x.getArray(readonly=True).reshape(owned, 3)
        self.apply()
        y.setArray(self._out[:owned].ravel())

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
            np.multiply(problem.nodal[:, None], u[:owned], out=out[:owned])
            out[owned:] = 0.0
            if inertia.redistribution is not None:
                moved = inertia.redistribution
                out[moved.touched] += problem.balance.alpha * np.einsum("kij,kj->ki", moved.tensors, u[moved.touched])
        for block in bars.blocks:
            _product(block.sweep, bars.far, self.stored, u, out)
        if bars.springs is not None:
            bars.springs.add_product(problem.balance.weight, u, out)
        problem.transform.linear(self._left, u, out)
        if supports.any:
            supports.put(out, held)

    def diagonal(self) -> np.ndarray:
        """Return the diagonal of H (owned, 3)."""
        problem, owned = self._problem, self.mesh.n_owned
        blocks = np.zeros((self.mesh.n_local, 6))
        _diagonal(self.mesh.bars, self.stored, blocks)
        springs = self.model.bars.springs
        if springs is not None:
            upper = springs.stiffness.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]
            blocks[springs.nodes] += problem.balance.weight * upper
        if self.model.inertia.redistribution is not None:
            moved = self.model.inertia.redistribution
            upper = moved.tensors.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]
            blocks[moved.touched] += problem.balance.alpha * upper
        inertia, nodal = self.model.inertia, problem.nodal
        if inertia.consistent:  # the diagonal of the bars' consistent mass is two thirds of the lumped one
            nodal = 2.0 / 3.0 * nodal
            if inertia.points.any:
                nodal += inertia.points.nodal(problem.balance.alpha, problem.balance.eta) / 3.0
        diagonal = blocks[:owned][:, [0, 3, 5]] + nodal[:, None]
        problem.transform.diagonal(self._left, lambda nodes: self._blocks(blocks, nodal, nodes), diagonal)
        supports = self.model.supports
        if supports.any:
            diagonal[supports.fixed] = problem.scale
        if supports.inclined is not None:
            at, free = supports.inclined.nodes, supports.inclined.free
            full = free @ self._blocks(blocks, nodal, at) @ free + problem.scale * (np.eye(3) - free)
            diagonal[at] = np.einsum("mii->mi", full)
        return diagonal

    @staticmethod
    def _blocks(stiffness: np.ndarray, nodal: np.ndarray, nodes: np.ndarray) -> np.ndarray:
        """Return the diagonal blocks (k, 3, 3) of H at nodes (k,)."""
        full = stiffness[nodes][:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
        return full + nodal[nodes, None, None] * np.eye(3)

    def couple(self, links: Iterable) -> None:
        """Do nothing: coordinates of links are applied with the bars."""

    def destroy(self) -> None:
        """Free the PETSc matrices."""
        if self._extension is not None:
            self._extension.mat.destroy()
        self.mat.destroy()

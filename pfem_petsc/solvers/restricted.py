"""PETSc matrices of a matrix-free Hessian: of all unknowns, of some of them, and with unit rows for the others."""

from __future__ import annotations

import weakref
from typing import TYPE_CHECKING

import numpy as np
from petsc4py import PETSc

from .outlive import at_exit, outlive

if TYPE_CHECKING:
    from .matrix_free import MatrixFreeHessian

__all__ = ["Context", "Extension", "Restriction"]


class Restriction:
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


class Context:
    """Python context of an operator that owns its PETSc matrix; does not keep the operator alive."""

    def __init__(self, operator: Extension | MatrixFreeHessian) -> None:
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
        return Restriction(whole, rows.getIndices() - 3 * whole.mesh.first_node).matrix()


class Extension:
    """H of all unknowns, with rows and columns of active unknowns replaced by those of a scaled identity."""

    def __init__(self, whole: MatrixFreeHessian) -> None:
        self.whole = whole
        self.kept: np.ndarray | None = None
        local, total = 3 * whole.mesh.n_owned, 3 * whole.mesh.n_nodes
        context = Context(self)
        self.mat = PETSc.Mat().createPython(((local, total), (local, total)), context, comm=whole.mesh.comm)
        self.mat.setBlockSize(3)
        self.mat.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        self.mat.setUp()
        at_exit(outlive, self.mat)

    def mult(self, mat: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Y = H x; called by PETSc."""
        if self.kept is None:
            self.whole.mult(mat, x, y)
            return
        with y as out:
            self.times(x.getArray(readonly=True).reshape(-1, 3), out.reshape(-1, 3))

    def times(self, given: np.ndarray, out: np.ndarray) -> None:
        """Compute ``out`` = H ``given``, both (owned, 3) and contiguous. Collective."""
        whole, kept = self.whole, self.kept
        owned = whole.mesh.n_owned
        if kept is None:
            whole._u[:owned] = given
            whole.apply()
            out[:] = whole._out[:owned]
            return
        u = whole._u[:owned].reshape(-1)
        u[:] = 0.0
        u[kept] = given.reshape(-1)[kept]
        whole.apply()
        np.multiply(whole.scale, given, out=out)
        out.reshape(-1)[kept] = whole._out[:owned].reshape(-1)[kept]

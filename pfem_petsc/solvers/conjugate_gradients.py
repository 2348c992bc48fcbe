"""Conjugate gradients with the diagonal as preconditioner: a linear solver for PETSc with few passes over vectors."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from ..mechanics.chunk_laws import CHUNK
from ..mechanics.compiled import inlined, kernel

if TYPE_CHECKING:
    from .matrix_free import MatrixFreeHessian


@inlined
def _advance_part(length, vectors, first, count, work):
    """Advance solution and residual; add the squares of the residual, and its products with that over the diagonal, to
    rows of a workspace."""
    p, q, inverse, x, r = vectors
    for i in range(count):
        k = np.uint64(first + i)
        x[k] += length * p[k]
        left = r[k] - length * q[k] if inverse[k] != 0.0 else 0.0
        r[k] = left
        work[i] += left * left
        work[CHUNK + i] += left * (inverse[k] * left)


@kernel
def advance(length, vectors):
    """Make a step of a length along p, with ``vectors`` (n,) p, q = A p, the inverse diagonal, solution and residual;
    return the square of the residual and its product with that over the diagonal. The residual is zero where the
    inverse is, which stands for unknowns that are held."""
    work = np.zeros(2 * CHUNK)
    for first in range(0, len(vectors[0]), CHUNK):
        _advance_part(length, vectors, first, min(CHUNK, len(vectors[0]) - first), work)
    return work[:CHUNK].sum(), work[CHUNK:].sum()


@kernel
def turn(share, inverse, r, p, u):
    """Write the next direction to p and u, from ``share`` of the last one and the residual r; all (n,)."""
    for i in range(len(p)):
        p[i] = inverse[i] * r[i] + share * p[i]
        u[i] = p[i]


@kernel
def product(p, q):
    """Return the scalar product of vectors (n,)."""
    work = np.zeros(CHUNK)
    for first in range(0, len(p), CHUNK):
        one, other = p[first : first + CHUNK], q[first : first + CHUNK]
        for i in range(len(one)):
            work[i] += one[i] * other[i]
    return work.sum()


class ConjugateGradients:
    """The method for a matrix-free Hessian or its restriction to inactive unknowns, as PETSc calls it.

    Results are those of PETSc's ``cg`` with ``jacobi`` up to rounding.
    """

    def __init__(self, hessian: MatrixFreeHessian) -> None:
        self.hessian = hessian
        self._p, self._inverse, self._x, self._r = np.zeros((4, 3 * hessian.mesh.n_owned))

    def solve(self, ksp: PETSc.KSP, b: PETSc.Vec, x: PETSc.Vec) -> None:
        """Solve A x = b from x = 0; called by PETSc. Collective."""
        hessian, kept = self.hessian, ksp.getOperators()[0].getPythonContext().kept
        u, q = hessian.vectors
        vectors = p, _, inverse, found, r = self._p, q, self._inverse, self._x, self._r
        chosen = slice(None) if kept is None else kept
        for vector in (inverse, r, found, p):
            vector.fill(0.0)
        r[chosen] = b.getArray(readonly=True)
        ones = x.duplicate()
        ones.set(1.0)
        ksp.getPC().apply(ones, x)
        ones.destroy()
        inverse[chosen] = x.getArray(readonly=True)
        supports, free = hessian.model.supports, hessian.masks
        if free and supports.any:
            found[:] = inverse * r
            inverse.reshape(-1, 3)[supports.fixed] = 0.0
            found[inverse != 0.0] = 0.0
        count, length, last, most = 0, 0.0, 1.0, ksp.getTolerances()[3]
        q.fill(0.0)
        while True:
            sums = np.array(advance(length, vectors))
            hessian.mesh.comm.Allreduce(MPI.IN_PLACE, sums)
            square, size = sums.tolist()
            norm = square**0.5
            ksp.setIterationNumber(count)
            ksp.setResidualNorm(norm)
            ksp.logConvergenceHistory(norm)
            ksp.monitor(count, norm)
            reason = ksp.callConvergenceTest(count, norm)
            if not reason and size < 0.0:
                reason = PETSc.KSP.ConvergedReason.DIVERGED_INDEFINITE_PC
            if not reason and count == most:
                reason = PETSc.KSP.ConvergedReason.DIVERGED_MAX_IT
            if reason:
                break
            turn(size / last if count else 0.0, inverse, r, p, u)
            hessian.apply(free)
            along = hessian.mesh.comm.allreduce(product(p, q))
            if along <= 0.0:
                reason = PETSc.KSP.ConvergedReason.DIVERGED_INDEFINITE_MAT
                break
            length, last = size / along, size
            count += 1
        ksp.setConvergedReason(reason)
        x.setArray(found[chosen])


def pass_less_often(ksp: PETSc.KSP, hessian: MatrixFreeHessian) -> None:
    """Replace PETSc's method by :class:`ConjugateGradients` where that does the same."""
    usual = ksp.getNormType() == PETSc.KSP.NormType.UNPRECONDITIONED
    if usual and ksp.getType() == "cg" and ksp.getPC().getType() == "jacobi":
        ksp.setType("python")
        ksp.setPythonContext(ConjugateGradients(hessian))

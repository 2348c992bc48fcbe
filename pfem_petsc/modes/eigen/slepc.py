"""Krylov-Schur iterations by SLEPc: with a factorisation by MUMPS, for large models with multigrid.

Options: prefix ``pfem_modes_``, of the eigensolver (``eps_...``) and of its linear solver (``st_ksp_...``).
"""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from ...errors import SimulationFailure
from ...solvers.linear import has_mumps
from ..pencil import Pencil

__all__ = ["DIRECT_UP_TO", "Solver"]

DIRECT_UP_TO = 400_000
"""Maximum number of components for which B is factorised."""
_PREFIX = "pfem_modes_"
_TOLERANCE = 1e-11  # relative, of theta; its square is the error of the eigenvalue
_LINEAR = 1e-12  # tolerance of solves with multigrid, which the iterations treat as exact


class Solver:
    """See :mod:`pfem_petsc.modes.eigen`."""

    finds_all = False

    def __init__(self, pencil: Pencil) -> None:
        from slepc4py import SLEPc

        self.pencil, self.iterations = pencil, 0
        self._library = SLEPc
        comm = pencil.b.comm
        size = pencil.b.getSize()[0]
        self.direct = (has_mumps() or comm.size == 1) and size <= DIRECT_UP_TO
        self._eps = eps = SLEPc.EPS().create(comm)
        eps.setOptionsPrefix(_PREFIX)
        eps.setOperators(pencil.a, pencil.b)
        eps.setProblemType(SLEPc.EPS.ProblemType.GHEP)
        eps.setType(SLEPc.EPS.Type.KRYLOVSCHUR)
        eps.setWhichEigenpairs(SLEPc.EPS.Which.LARGEST_REAL)
        eps.setTolerances(_TOLERANCE, 500)
        self._ksp = eps.getST().getKSP()
        self.name = "Krylov-Schur iterations (SLEPc), "
        if self.direct:
            self.name += "factorisation by MUMPS" if has_mumps() else "factorisation"
            self._factorise()
        else:
            self.name += "conjugate gradients with multigrid"
            self._multigrid()
        eps.setFromOptions()
        self.definite: bool | None = self._definite()

    def _factorise(self) -> None:
        self._ksp.setType("preonly")
        pc = self._ksp.getPC()
        pc.setType("cholesky")
        if has_mumps():
            pc.setFactorSolverType("mumps")

    def _multigrid(self) -> None:
        self._ksp.setType("cg")
        self._ksp.setTolerances(rtol=_LINEAR, max_it=2000)
        pc = self._ksp.getPC()
        pc.setType("gamg")
        pc.setOperators(self.pencil.b)
        points = self.pencil.points
        total = self.pencil.b.comm.tompi4py().allreduce(np.append(points.sum(axis=0), float(len(points))))
        pc.setCoordinates(points - total[:3] / total[3])

    def _definite(self) -> bool | None:
        """Return whether B is positive definite, by the signs of its factors (Sylvester's law)."""
        pc = self._ksp.getPC()
        if not self.direct or pc.getType() != "cholesky":
            return None
        self._ksp.setOperators(self.pencil.b)
        if pc.getFactorSolverType() == "mumps":
            pc.setFactorSetUpSolverType()
            factor = pc.getFactorMatrix()
            factor.setMumpsIcntl(24, 1)  # count zero pivots
            factor.setMumpsIcntl(13, 1)  # and signs of pivots of the last front, which several ranks may share
        self._ksp.setUp()
        factor = pc.getFactorMatrix()
        if pc.getFactorSolverType() == "mumps" and factor.getMumpsInfog(1) < 0:
            return False
        negative, zero, _ = factor.getInertia()
        return negative == 0 and zero == 0

    def largest(self, count: int, start: np.ndarray, known: np.ndarray) -> np.ndarray:
        """See :mod:`pfem_petsc.modes.eigen`."""
        eps, b = self._eps, self.pencil.b
        size = b.getSize()[0]
        spaces = [_vector(b, each) for each in known], [_vector(b, start)]
        eps.setDeflationSpace(spaces[0])
        eps.setInitialSpace(spaces[1])
        eps.setDimensions(min(count, size), min(size, 2 * count + 20))
        try:
            eps.solve()
        except PETSc.Error as failure:
            reason = str(failure).strip().splitlines()[-1]
            raise SimulationFailure(
                f"modes: {self.name}: PETSc or SLEPc failed ({reason}); use another modes.solver, or other options "
                f"-{_PREFIX}..."
            ) from failure
        finally:
            for vector in (*spaces[0], *spaces[1]):
                vector.destroy()
        self.iterations += eps.getIterationNumber()
        found = eps.getConverged()
        if found < min(count, size - len(known)):
            raise SimulationFailure(
                f"modes: {found} of {count} eigenvalues converged after {eps.getIterationNumber()} restarts of SLEPc's "
                f"iterations ({self.name}); ask for fewer modes, or give other options -{_PREFIX}eps_..."
            )
        vectors = np.empty((found, len(start)))
        x = b.createVecRight()
        for k in range(found):
            eps.getEigenvector(k, x)
            vectors[k] = x.getArray(readonly=True)
        x.destroy()
        return vectors

    def destroy(self) -> None:
        """Free the SLEPc objects."""
        self._eps.destroy()


def _vector(matrix: PETSc.Mat, values: np.ndarray) -> PETSc.Vec:
    vector = matrix.createVecRight()
    vector.setArray(values)
    return vector

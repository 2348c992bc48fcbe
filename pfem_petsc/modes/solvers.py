"""Solvers of A x = theta B x with B positive definite, for the largest theta.

The class of a solver is constructed from a :class:`~pfem_petsc.modes.pencil.Pencil`, collectively. It has ``name``;
``finds_all``, whether repeated eigenvalues are found with their multiplicity; ``definite``, whether B is positive
definite, None if that is unknown; ``largest(count, start, known)``, which returns vectors (k, owned
components) of at least the ``count`` largest theta in the complement of the vectors ``known``; and ``destroy()``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from petsc4py import PETSc

from ..errors import SimulationFailure
from ..parallel.agreement import on_root
from ..solvers.linear import has_mumps
from ..tolerances import SINGULAR_PIVOT

if TYPE_CHECKING:
    from scipy.sparse import csc_matrix

    from .pencil import Pencil

__all__ = ["SOLVERS", "Dense", "Lanczos", "Slepc"]

_TOLERANCE = 1e-11  # relative, of theta; its square is the error of the eigenvalue


class _OnOneRank:
    """Solves on rank 0, without the held components."""

    def __init__(self, pencil: Pencil) -> None:
        self._comm, self._owned = pencil.a.comm.tompi4py(), pencil.held.size
        self._free = np.flatnonzero(~pencil.held.ravel())
        parts = self._comm.allgather(self._free + pencil.a.getOwnershipRange()[0])
        before = sum(map(len, parts[: self._comm.rank]))
        self._mine = slice(before, before + len(self._free))
        rows = np.concatenate(parts) if self._comm.rank == 0 else self._free[:0]
        self.definite: bool | None = on_root(
            self._comm, self._prepare, self._whole(pencil.a, rows), self._whole(pencil.b, rows)
        )

    def _whole(self, matrix: PETSc.Mat, rows: np.ndarray) -> csc_matrix:
        """Return the given rows and columns of a matrix. Collective."""
        from scipy.sparse import csr_matrix

        chosen = PETSc.IS().createGeneral(rows.astype(PETSc.IntType), comm=matrix.comm)
        part = matrix.createSubMatrix(chosen, chosen)
        pointers, columns, values = part.getValuesCSR()
        whole = csr_matrix((values, columns, pointers), shape=(len(rows), len(rows))).tocsc()
        part.destroy()
        chosen.destroy()
        return whole

    def largest(self, count: int, start: np.ndarray, known: np.ndarray) -> np.ndarray:
        """See :mod:`pfem_petsc.modes.solvers`. Collective."""
        parts = self._comm.gather(np.concatenate([start[None], known])[:, self._free])
        given = np.concatenate(parts, axis=1) if parts is not None else start[None]
        vectors = on_root(self._comm, self._find, count, given[0], given[1:])
        mine = np.zeros((len(vectors), self._owned))
        mine[:, self._free] = vectors[:, self._mine]
        return mine

    def destroy(self) -> None:
        """Free nothing: matrices and factors are Python's."""


class Dense(_OnOneRank):
    """All eigenvalues by LAPACK: for small models."""

    name = "dense matrices (LAPACK)"
    finds_all = True

    def _prepare(self, a: csc_matrix, b: csc_matrix) -> bool:
        from scipy.linalg import eigh

        right = b.toarray()
        try:
            pivots = np.diag(np.linalg.cholesky(right)) ** 2
        except np.linalg.LinAlgError:
            return False
        if pivots.min() <= SINGULAR_PIVOT * right.diagonal().max():
            return False
        self._vectors = eigh(a.toarray(), right)[1].T[::-1]
        return True

    def _find(self, count: int, start: np.ndarray, known: np.ndarray) -> np.ndarray:
        return self._vectors[len(known) : len(known) + count]


class Lanczos(_OnOneRank):
    """Some eigenvalues by SciPy (ARPACK) with a factorisation."""

    name = "Lanczos iterations with a factorisation on one rank (SciPy)"
    finds_all = False

    def _prepare(self, a: csc_matrix, b: csc_matrix) -> bool | None:
        from scipy.sparse.linalg import splu

        self._a, self._b = a, b
        options = {"SymmetricMode": True}
        try:
            self._factor = splu(b, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
        except RuntimeError:
            return False
        if not np.array_equal(self._factor.perm_r, self._factor.perm_c):
            return None
        # L D L^T without row exchanges: by Sylvester's law the signs of D are those of the eigenvalues
        return bool((self._factor.U.diagonal() > SINGULAR_PIVOT * b.diagonal().max()).all())

    def _find(self, count: int, start: np.ndarray, known: np.ndarray) -> np.ndarray:
        from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh

        n = len(start)
        products = self._b @ known.T
        gram = known @ products

        def complement(x: np.ndarray) -> np.ndarray:
            """Remove the component in the span of the known vectors, which are B-orthogonal to all others."""
            return x - known.T @ np.linalg.solve(gram, products.T @ x)

        def applied(x: np.ndarray) -> np.ndarray:
            y = self._a @ complement(x)
            return y - products @ np.linalg.solve(gram, known @ y)

        def operator(function: Any) -> LinearOperator:
            return LinearOperator((n, n), matvec=function, dtype=float)

        options = {
            "M": self._b,
            "which": "LA",
            "v0": complement(start),
            "tol": _TOLERANCE,
            "ncv": min(n, 2 * count + 20),
        }
        try:
            _, vectors = eigsh(operator(applied), min(count, n - 1), Minv=operator(self._factor.solve), **options)
        except ArpackNoConvergence as failure:
            raise SimulationFailure(f"modes: the Lanczos iterations of SciPy did not converge: {failure}") from failure
        return np.ascontiguousarray(complement(vectors).T)


DIRECT_UP_TO = 400_000
"""Maximum number of components for which SLEPc uses a factorisation of B."""
_PREFIX = "pfem_modes_"
_LINEAR = 1e-12  # tolerance of solves with multigrid, which the iterations treat as exact


class Slepc:
    """Krylov-Schur iterations by SLEPc on all ranks: with a factorisation by MUMPS, for large models with multigrid.

    Options: prefix ``pfem_modes_``, of the eigensolver (``eps_...``) and of its linear solver (``st_ksp_...``).
    """

    finds_all = False

    def __init__(self, pencil: Pencil) -> None:
        from slepc4py import SLEPc

        self.pencil = pencil
        self._eps = eps = SLEPc.EPS().create(pencil.b.comm)
        eps.setOptionsPrefix(_PREFIX)
        eps.setOperators(pencil.a, pencil.b)
        eps.setProblemType(SLEPc.EPS.ProblemType.GHEP)
        eps.setType(SLEPc.EPS.Type.KRYLOVSCHUR)
        eps.setWhichEigenpairs(SLEPc.EPS.Which.LARGEST_REAL)
        eps.setTolerances(_TOLERANCE, 500)
        ksp, mumps = eps.getST().getKSP(), has_mumps()
        pc = ksp.getPC()
        self.name = "Krylov-Schur iterations (SLEPc), "
        if (mumps or pencil.b.comm.size == 1) and pencil.b.getSize()[0] <= DIRECT_UP_TO:
            self.name += "factorisation by MUMPS" if mumps else "factorisation"
            ksp.setType("preonly")
            pc.setType("cholesky")
            if mumps:
                pc.setFactorSolverType("mumps")
        else:
            self.name += "conjugate gradients with multigrid"
            ksp.setType("cg")
            ksp.setTolerances(rtol=_LINEAR, max_it=2000)
            pc.setType("gamg")
            pc.setOperators(pencil.b)
            points = pencil.points
            total = pencil.b.comm.tompi4py().allreduce(np.append(points.sum(axis=0), float(len(points))))
            pc.setCoordinates(points - total[:3] / total[3])
        eps.setFromOptions()
        self.definite = self._definite(ksp)

    def _definite(self, ksp: PETSc.KSP) -> bool | None:
        """Return whether B is positive definite, by the signs of its factors (Sylvester's law)."""
        pc = ksp.getPC()
        if pc.getType() != "cholesky":
            return None
        ksp.setOperators(self.pencil.b)
        mumps = pc.getFactorSolverType() == "mumps"
        if mumps:
            pc.setFactorSetUpSolverType()
            factor = pc.getFactorMatrix()
            factor.setMumpsIcntl(24, 1)  # count zero pivots
            factor.setMumpsIcntl(13, 1)  # and signs of pivots of the last front, which several ranks may share
        ksp.setUp()
        factor = pc.getFactorMatrix()
        if mumps and factor.getMumpsInfog(1) < 0:
            return False
        negative, zero, _ = factor.getInertia()
        return negative == 0 and zero == 0

    def largest(self, count: int, start: np.ndarray, known: np.ndarray) -> np.ndarray:
        """See :mod:`pfem_petsc.modes.solvers`. Collective."""
        eps, b = self._eps, self.pencil.b
        size = b.getSize()[0]
        spaces = [b.createVecRight() for _ in range(len(known) + 1)]
        for vector, values in zip(spaces, (*known, start), strict=True):
            vector.setArray(values)
        eps.setDeflationSpace(spaces[:-1])
        eps.setInitialSpace(spaces[-1:])
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
            for vector in spaces:
                vector.destroy()
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


SOLVERS = {"dense": Dense, "scipy": Lanczos, "slepc": Slepc}
"""By the name in ``modes.solver``."""

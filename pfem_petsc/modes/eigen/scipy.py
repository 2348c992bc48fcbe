"""Lanczos iterations by SciPy (ARPACK) with a factorisation, on rank 0."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...errors import SimulationFailure
from ...parallel.agreement import on_root
from ...tolerances import SINGULAR_PIVOT
from ..pencil import Gathered, Pencil

__all__ = ["Solver"]

_TOLERANCE = 1e-11  # relative, of theta


class Solver:
    """See :mod:`pfem_petsc.modes.eigen`."""

    name = "Lanczos iterations with a factorisation on one rank (SciPy)"
    finds_all = False

    def __init__(self, pencil: Pencil) -> None:
        self.iterations = 0
        self._gathered = Gathered(pencil)
        self._comm = self._gathered.comm
        self._a = self._b = self._factor = None
        self.definite: bool | None = on_root(self._comm, self._prepare)

    def _prepare(self) -> bool | None:
        from scipy.sparse import csc_matrix
        from scipy.sparse.linalg import splu

        n = self._gathered.size
        entries = self._gathered.a, self._gathered.b
        self._a, self._b = (csc_matrix((each[2], each[:2]), shape=(n, n)) for each in entries)
        try:
            self._factor = splu(
                self._b,
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )
        except RuntimeError:
            return False
        if not np.array_equal(self._factor.perm_r, self._factor.perm_c):
            return None
        # L D L^T without row exchanges: by Sylvester's law the signs of D are those of the eigenvalues
        return bool((self._factor.U.diagonal() > SINGULAR_PIVOT * self._b.diagonal().max()).all())

    def largest(self, count: int, start: np.ndarray, known: np.ndarray) -> np.ndarray:
        """See :mod:`pfem_petsc.modes.eigen`."""
        whole = self._gathered.whole(np.concatenate([start[None], known]))
        vectors, self.iterations = on_root(self._comm, self._iterate, count, whole)
        return self._gathered.scattered(vectors if self._comm.rank == 0 else None)

    def _iterate(self, count: int, whole: np.ndarray) -> tuple[np.ndarray, int]:
        from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh

        start, known = whole[0], whole[1:]
        n, solves = len(start), [self.iterations]
        products = self._b @ known.T
        gram = known @ products if len(known) else np.eye(0)

        def complement(x: np.ndarray) -> np.ndarray:
            """Remove the component in the span of the known vectors, which are B-orthogonal to all others."""
            return x - known.T @ np.linalg.solve(gram, products.T @ x) if len(known) else x

        def applied(x: np.ndarray) -> np.ndarray:
            y = self._a @ complement(x)
            return y - products @ np.linalg.solve(gram, known @ y) if len(known) else y

        def solved(x: np.ndarray) -> np.ndarray:
            solves[0] += 1
            return self._factor.solve(x)

        def operator(function: Any) -> Any:
            return LinearOperator((n, n), matvec=function, dtype=float)

        try:
            _, vectors = eigsh(
                operator(applied),
                min(count, n - 1),
                M=self._b,
                Minv=operator(solved),
                which="LA",
                v0=complement(start),
                tol=_TOLERANCE,
                ncv=min(n, 2 * count + 20),
            )
        except ArpackNoConvergence as failure:
            raise SimulationFailure(f"modes: the Lanczos iterations of SciPy did not converge: {failure}") from failure
        return np.ascontiguousarray(complement(vectors).T), solves[0]

    def destroy(self) -> None:
        """Free matrices and factors."""
        self._a = self._b = self._factor = None

"""Lanczos iterations by SciPy (ARPACK) with a factorisation, on rank 0."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...errors import SimulationFailure
from ...parallel.agreement import on_root
from ..gathered import gathered_rows, scattered
from ..pencil import Pencil

__all__ = ["Solver"]

_TOLERANCE = 1e-11  # relative, of theta


class Solver:
    """See :mod:`pfem_petsc.modes.eigen`."""

    name = "Lanczos iterations with a factorisation on one rank (SciPy)"
    finds_all = False

    def __init__(self, pencil: Pencil) -> None:
        self.pencil, self.iterations = pencil, 0
        self._comm = pencil.a.comm.tompi4py()
        rows = gathered_rows(pencil.a), gathered_rows(pencil.b)
        self._a = self._b = self._factor = None
        self.definite: bool | None = on_root(self._comm, self._prepare, rows)

    def _prepare(self, rows: tuple) -> bool | None:
        from scipy.sparse import csc_matrix, csr_matrix
        from scipy.sparse.linalg import splu

        n = len(rows[0][0]) - 1
        self._a, self._b = (csr_matrix((each[2], each[1], each[0]), shape=(n, n)) for each in rows)
        try:
            self._factor = splu(
                csc_matrix(self._b),
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )
        except RuntimeError:
            return False
        if not np.array_equal(self._factor.perm_r, self._factor.perm_c):
            return None
        # L D L^T without exchange of rows: by Sylvester's law the signs of D are those of the eigenvalues
        return bool((self._factor.U.diagonal() > 0.0).all())

    def largest(self, count: int, start: np.ndarray, known: np.ndarray) -> np.ndarray:
        """See :mod:`pfem_petsc.modes.eigen`."""
        parts = self._comm.gather((start, known))
        whole = None
        if parts is not None:
            whole = tuple(np.concatenate([part[k] for part in parts], axis=-1) for k in (0, 1))
        vectors, self.iterations = on_root(self._comm, self._iterate, count, whole)
        return scattered(self.pencil.a, vectors)

    def _iterate(self, count: int, whole: tuple) -> tuple[np.ndarray, int]:
        from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh

        start, known = whole
        n, solves = len(start), [self.iterations]
        products = self._b @ known.T
        gram = known @ products if len(known) else np.eye(0)

        def complement(x: np.ndarray) -> np.ndarray:
            """Without the part in the known vectors, which are orthogonal in B to all others."""
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
        """Let go of matrices and factors."""
        self._a = self._b = self._factor = None

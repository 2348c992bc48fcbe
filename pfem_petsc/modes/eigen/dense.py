"""All eigenvalues by NumPy on rank 0: for small models."""

from __future__ import annotations

import numpy as np

from ...tolerances import SINGULAR_PIVOT
from ..pencil import Gathered, Pencil

__all__ = ["Solver"]


class Solver:
    """See :mod:`pfem_petsc.modes.eigen`."""

    name = "dense matrices (NumPy)"
    finds_all = True
    """whether repeated eigenvalues are found with their multiplicity"""

    def __init__(self, pencil: Pencil) -> None:
        self.iterations = 0
        self._gathered = Gathered(pencil)
        self._vectors: np.ndarray | None = None
        definite = None
        if self._gathered.comm.rank == 0:
            definite = self._solve(self._dense(self._gathered.a), self._dense(self._gathered.b))
        self.definite: bool | None = self._gathered.comm.bcast(definite)

    def _solve(self, a: np.ndarray, b: np.ndarray) -> bool:
        try:
            lower = np.linalg.cholesky(b)
        except np.linalg.LinAlgError:
            return False
        pivots = np.diag(lower) ** 2
        if pivots.min() <= SINGULAR_PIVOT * np.diag(b).max():
            return False
        reduced = np.linalg.solve(lower, np.linalg.solve(lower, a).T)
        _, vectors = np.linalg.eigh(0.5 * (reduced + reduced.T))
        self._vectors = np.linalg.solve(lower.T, vectors[:, ::-1]).T
        return True

    def largest(self, count: int, start: np.ndarray, known: np.ndarray) -> np.ndarray:
        """See :mod:`pfem_petsc.modes.eigen`."""
        vectors = None if self._vectors is None else self._vectors[len(known) : len(known) + count]
        return self._gathered.scattered(vectors)

    def destroy(self) -> None:
        """Do nothing: there are no resources to free."""

    def _dense(self, entries: tuple[np.ndarray, ...]) -> np.ndarray:
        full = np.zeros((self._gathered.size,) * 2)
        np.add.at(full, entries[:2], entries[2])
        return full

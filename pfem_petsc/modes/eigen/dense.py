"""All eigenvalues by NumPy on rank 0: for small models."""

from __future__ import annotations

import numpy as np

from ..gathered import gathered_rows, scattered
from ..pencil import Pencil

__all__ = ["Solver"]


class Solver:
    """See :mod:`pfem_petsc.modes.eigen`."""

    name = "dense matrices (NumPy)"
    finds_all = True
    """whether repeated eigenvalues are found as often as they are there"""

    def __init__(self, pencil: Pencil) -> None:
        self.pencil, self.iterations = pencil, 0
        self._comm = pencil.a.comm.tompi4py()
        self._vectors: np.ndarray | None = None
        rows = gathered_rows(pencil.a), gathered_rows(pencil.b)
        definite = None
        if self._comm.rank == 0:
            definite = self._solve(*(_dense(*each) for each in rows))
        self.definite: bool | None = self._comm.bcast(definite)

    def _solve(self, a: np.ndarray, b: np.ndarray) -> bool:
        try:
            lower = np.linalg.cholesky(b)
        except np.linalg.LinAlgError:
            return False
        reduced = np.linalg.solve(lower, np.linalg.solve(lower, a).T)
        _, vectors = np.linalg.eigh(0.5 * (reduced + reduced.T))
        self._vectors = np.linalg.solve(lower.T, vectors[:, ::-1]).T
        return True

    def largest(self, count: int, start: np.ndarray, known: np.ndarray) -> np.ndarray:
        """See :mod:`pfem_petsc.modes.eigen`; nothing but the first call finds any."""
        if len(known):
            return np.empty((0, known.shape[1]))
        vectors = self._vectors[:count] if self._comm.rank == 0 else None
        return scattered(self.pencil.a, vectors)

    def destroy(self) -> None:
        """Nothing to free."""


def _dense(pointers: np.ndarray, columns: np.ndarray, values: np.ndarray) -> np.ndarray:
    n = len(pointers) - 1
    full = np.zeros((n, n))
    full[np.repeat(np.arange(n), np.diff(pointers)), columns] = values
    return full

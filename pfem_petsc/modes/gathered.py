"""Gathers matrices of the free components on rank 0, and scatters vectors to their owners."""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from .pencil import Pencil

__all__ = ["Gathered"]


class Gathered:
    """The matrices of a pencil on rank 0 without held components. Construction is collective.

    Attributes
    ----------
    a, b : on rank 0, rows (m,), columns (m,) and values (m,) of the matrices; None on the others
    size : number of components
    """

    def __init__(self, pencil: Pencil) -> None:
        self.comm = pencil.a.comm.tompi4py()
        self._free = np.flatnonzero(~pencil.held.ravel())
        self._owned = pencil.held.size
        parts = self.comm.gather(~pencil.held.ravel())
        self.size = 0
        self.a = self.b = None
        self._counts: list[int] = []
        number = None
        if parts is not None:
            self._counts = [int(part.sum()) for part in parts]
            free = np.concatenate(parts)
            self.size = int(free.sum())
            number = np.where(free, np.cumsum(free) - 1, -1)
        self.a, self.b = self._rows(pencil.a, number), self._rows(pencil.b, number)

    def _rows(self, matrix: PETSc.Mat, number: np.ndarray | None) -> tuple[np.ndarray, ...] | None:
        parts = self.comm.gather(tuple(np.array(part) for part in matrix.getValuesCSR()))
        if parts is None:
            return None
        rows = np.repeat(number, np.concatenate([np.diff(pointers) for pointers, _, _ in parts]))
        columns = number[np.concatenate([part[1] for part in parts])]
        values = np.concatenate([part[2] for part in parts])
        kept = (rows >= 0) & (columns >= 0)
        return rows[kept], columns[kept], values[kept]

    def whole(self, vectors: np.ndarray) -> np.ndarray | None:
        """Gather vectors (k, size) on rank 0 from each rank's part (k, owned); None on the others. Collective."""
        parts = self.comm.gather(vectors[:, self._free])
        return None if parts is None else np.concatenate(parts, axis=1)

    def scattered(self, vectors: np.ndarray | None) -> np.ndarray:
        """Return this rank's part (k, owned) of vectors (k, size) on rank 0. Collective."""
        parts = None
        if vectors is not None:
            parts = np.split(vectors, np.cumsum(self._counts)[:-1], axis=1)
        mine = self.comm.scatter(parts)
        spread = np.zeros((len(mine), self._owned))
        spread[:, self._free] = mine
        return spread

"""Matrices on rank 0, and vectors back to where they belong."""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

__all__ = ["gathered_rows", "scattered"]


def gathered_rows(matrix: PETSc.Mat) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Row pointers, columns and values of the whole matrix on rank 0, None on the others. Collective."""
    comm = matrix.comm.tompi4py()
    parts = comm.gather(tuple(np.asarray(part) for part in matrix.getValuesCSR()))
    if parts is None:
        return None
    lengths = np.concatenate([np.diff(pointers) for pointers, _, _ in parts])
    pointers = np.concatenate([[0], np.cumsum(lengths)])
    return pointers, np.concatenate([part[1] for part in parts]), np.concatenate([part[2] for part in parts])


def scattered(matrix: PETSc.Mat, vectors: np.ndarray | None) -> np.ndarray:
    """This rank's part (k, owned) of vectors (k, n) that rank 0 has. Collective."""
    comm = matrix.comm.tompi4py()
    first, last = matrix.getOwnershipRange()
    ranges = comm.gather((first, last))
    if comm.rank == 0:
        return comm.scatter([vectors[:, start:stop].copy() for start, stop in ranges])
    return comm.scatter(None)

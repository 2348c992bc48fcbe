"""Arrays between the numbering of a distributed mesh and slabs: contiguous ranges of the mesh's own numbering."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

__all__ = ["NaturalOrder"]


class NaturalOrder:
    """Moves arrays between the rows a rank owns (any order) and its slab of the mesh's own numbering.

    Rank r of p holds the r-th contiguous range of the n rows, the first n mod p ranks one row more (PETSc's split).
    Everything that does not depend on the values is worked out once here; a transfer is then one ``Alltoallv``,
    and on one rank a permutation, or nothing at all where the numberings agree.

    Parameters
    ----------
    comm : MPI.Comm
    ids : (n,) int64
        Mesh numbers of the rows owned by this rank. Over all ranks each number appears exactly once.
    n_global : int
        How many rows there are over all ranks.

    Attributes
    ----------
    first, count : int
        The slab of this rank: mesh numbers first to first + count - 1.
    n_owned, n_global : int

    Raises
    ------
    ValueError
        On all ranks, when a number is missing, owned twice or out of range.
    """

    def __init__(self, comm: MPI.Comm, ids: np.ndarray, n_global: int) -> None:
        self.comm = comm
        self.n_global = int(n_global)
        ids = np.ascontiguousarray(ids, dtype=np.int64)
        self.n_owned = len(ids)
        share, rest = divmod(self.n_global, comm.size)
        self.first = comm.rank * share + min(comm.rank, rest)
        self.count = share + (comm.rank < rest)

        in_range = not len(ids) or (ids.min() >= 0 and ids.max() < self.n_global)
        if not comm.allreduce(bool(in_range), op=MPI.LAND):
            raise ValueError(f"mesh numbers outside 0..{self.n_global - 1}")
        # Sorted by number, rows are also sorted by the rank of their slab.
        self._owned_rows = np.argsort(ids, kind="stable")
        bounds = np.array([r * share + min(r, rest) for r in range(comm.size + 1)])
        self._owned_counts = np.diff(np.searchsorted(ids[self._owned_rows], bounds))
        self._slab_counts = np.empty_like(self._owned_counts)
        comm.Alltoall(self._owned_counts, self._slab_counts)
        self._owned_starts = np.cumsum(self._owned_counts) - self._owned_counts
        self._slab_starts = np.cumsum(self._slab_counts) - self._slab_counts

        self._slab_rows = self._exchange(ids[self._owned_rows], to_slab=True) - self.first
        once = len(self._slab_rows) == self.count and bool(
            (np.bincount(self._slab_rows, minlength=self.count) == 1).all()
        )
        if not comm.allreduce(once, op=MPI.LAND):
            raise ValueError(f"the {self.n_global} mesh numbers are not owned exactly once each")
        self._alone = comm.size == 1
        self._identity = self._alone and bool((ids == np.arange(self.n_global)).all())

    def to_slab(self, array: np.ndarray) -> np.ndarray:
        """Owned rows (n_owned, ...) to this rank's slab (count, ...). Collective.

        On one rank whose rows are in mesh order already the result is ``array`` itself.
        """
        self._check(array, self.n_owned)
        if self._identity:
            return array
        if self._alone:
            slab = np.empty_like(array, order="C")
            slab[self._slab_rows] = array[self._owned_rows]
            return slab
        received = self._exchange(array[self._owned_rows], to_slab=True)
        slab = np.empty_like(received)
        slab[self._slab_rows] = received
        return slab

    def from_slab(self, slab: np.ndarray) -> np.ndarray:
        """This rank's slab (count, ...) to owned rows (n_owned, ...): undoes :meth:`to_slab`. Collective."""
        self._check(slab, self.count)
        if self._identity:
            return slab
        received = slab[self._slab_rows]
        if not self._alone:
            received = self._exchange(received, to_slab=False)
        array = np.empty_like(received)
        array[self._owned_rows] = received
        return array

    def _exchange(self, rows: np.ndarray, to_slab: bool) -> np.ndarray:
        rows = np.ascontiguousarray(rows)
        owned, slab = (self._owned_counts, self._owned_starts), (self._slab_counts, self._slab_starts)
        sending, receiving = (owned, slab) if to_slab else (slab, owned)
        received = np.empty((int(receiving[0].sum()), *rows.shape[1:]), dtype=rows.dtype)
        # Counting in rows, not bytes, keeps the counts within MPI's 32 bits.
        row = MPI.BYTE.Create_contiguous(rows.dtype.itemsize * int(np.prod(rows.shape[1:], dtype=np.int64)))
        row.Commit()
        try:
            self.comm.Alltoallv([rows, sending, row], [received, receiving, row])
        finally:
            row.Free()
        return received

    @staticmethod
    def _check(array: np.ndarray, n_rows: int) -> None:
        if len(array) != n_rows:
            raise ValueError(f"array has {len(array)} rows, expected {n_rows}")

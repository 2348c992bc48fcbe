"""Moves arrays between the numbering of a distributed mesh and slabs, contiguous ranges of the mesh numbering."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from mpi4py import MPI

__all__ = ["NaturalOrder"]

_TAG = 7300


class NaturalOrder:
    """Moves arrays between the rows that a rank owns (any order) and its slab of the mesh numbering.

    Rank r of p has the r-th contiguous range of the n rows; the first n mod p ranks have one more row (as in PETSc).
    Everything that does not depend on the values is computed once. A transfer is then one message between each two
    ranks that share rows, while rows that stay on a rank are copied; on one rank it is a permutation, or nothing if the
    numberings are equal.

    Parameters
    ----------
    comm : MPI.Comm
    ids : (n,) int64
        Mesh numbers of the rows owned by this rank. Each number appears exactly once over all ranks.
    n_global : int
        Total number of rows over all ranks.

    Attributes
    ----------
    first, count : int
        The slab of this rank: mesh numbers first to first + count - 1.
    n_owned, n_global : int
    alone : whether there is one rank

    Raises
    ------
    ValueError
        On all ranks, if a number is missing, owned twice or out of range.
    """

    def __init__(self, comm: MPI.Comm, ids: np.ndarray, n_global: int) -> None:
        self.comm = comm
        self.n_global = int(n_global)
        self.n_owned = len(ids)
        share, rest = divmod(self.n_global, comm.size)
        self.first = comm.rank * share + min(comm.rank, rest)
        self.count = share + (comm.rank < rest)
        self.alone = comm.size == 1
        self._identity = False

        in_range = not len(ids) or (ids.min() >= 0 and ids.max() < self.n_global)
        if not comm.allreduce(bool(in_range), op=MPI.LAND):
            raise ValueError(f"mesh numbers outside 0..{self.n_global - 1}")
        once = self._order_alone(ids) if self.alone else self._order_among_ranks(ids, share, rest)
        if not comm.allreduce(once, op=MPI.LAND):
            raise ValueError(f"the {self.n_global} mesh numbers are not owned exactly once each")

    def _order_alone(self, ids: np.ndarray) -> bool:
        """Store the row of each number on one rank, in the smallest sufficient integer type."""
        kind = np.int32 if self.n_global < 2**31 else np.int64
        self._owned_rows = np.full(self.n_global, -1, dtype=kind)
        self._owned_rows[ids] = np.arange(self.n_owned, dtype=kind)
        once = self.n_owned == self.n_global and (not self.n_global or int(self._owned_rows.min()) >= 0)
        self._identity = once and bool((ids[:-1] < ids[1:]).all())
        return once

    def _order_among_ranks(self, ids: np.ndarray, share: int, rest: int) -> bool:
        comm = self.comm
        ids = np.ascontiguousarray(ids, dtype=np.int64)
        # Sorted by number, rows are also sorted by the rank of their slab.
        rows = np.argsort(ids, kind="stable")
        bounds = np.array([r * share + min(r, rest) for r in range(comm.size + 1)])
        leaving = np.diff(np.searchsorted(ids[rows], bounds))
        arriving = np.empty_like(leaving)
        comm.Alltoall(leaving, arriving)
        self._owned = dict(_parts(rows, leaving))
        # until it is known where rows go to in the slab, they are put in the order of ranks
        self._slab = dict(_parts(np.arange(arriving.sum(), dtype=rows.dtype), arriving))
        places = self._move(ids, int(arriving.sum()), self._owned, self._slab) - self.first
        self._slab = {rank: places[at].astype(rows.dtype) for rank, at in self._slab.items()}
        return len(places) == self.count and bool((np.bincount(places, minlength=self.count) == 1).all())

    def owned_rows(self, first: int, last: int) -> np.ndarray:
        """Return the rows of the numbers first to last - 1; on one rank only."""
        return self._owned_rows[first:last]

    def to_slab(self, array: np.ndarray) -> np.ndarray:
        """Move owned rows (n_owned, ...) to this rank's slab (count, ...). Collective.

        On one rank with rows in mesh order the result is ``array`` itself.
        """
        self._check(array, self.n_owned)
        if self._identity:
            return array
        if self.alone:
            return _rows(array, self._owned_rows)
        return self._move(array, self.count, self._owned, self._slab)

    def from_slab(self, slab: np.ndarray) -> np.ndarray:
        """Move this rank's slab (count, ...) to owned rows (n_owned, ...); inverse of :meth:`to_slab`. Collective."""
        self._check(slab, self.count)
        if self._identity:
            return slab
        if self.alone:
            array = np.empty_like(slab)
            array[self._owned_rows] = slab
            return array
        return self._move(slab, self.n_owned, self._slab, self._owned)

    def _move(
        self, array: np.ndarray, n_rows: int, leaving: dict[int, np.ndarray], arriving: dict[int, np.ndarray]
    ) -> np.ndarray:
        """Return an array of ``n_rows`` rows made of the rows of ``array`` on all ranks; rows by rank."""
        comm = self.comm
        result = np.empty((n_rows, *array.shape[1:]), array.dtype)
        # Counts in rows instead of bytes stay within the 32-bit integers of MPI.
        row = MPI.BYTE.Create_contiguous(array.dtype.itemsize * int(np.prod(array.shape[1:], dtype=np.int64))).Commit()
        try:
            others = [(rank, at) for rank, at in arriving.items() if rank != comm.rank]
            parts = {rank: np.empty((len(at), *array.shape[1:]), array.dtype) for rank, at in others}
            requests = [comm.Irecv([part, len(part), row], rank, _TAG) for rank, part in parts.items()]
            sent = [(rank, _rows(array, at)) for rank, at in leaving.items() if rank != comm.rank]
            requests += [comm.Isend([part, len(part), row], rank, _TAG) for rank, part in sent]
            if comm.rank in leaving:
                result[arriving[comm.rank]] = _rows(array, leaving[comm.rank])
            MPI.Request.Waitall(requests)
        finally:
            row.Free()
        for rank, part in parts.items():
            result[arriving[rank]] = part
        return result

    @staticmethod
    def _check(array: np.ndarray, n_rows: int) -> None:
        if len(array) != n_rows:
            raise ValueError(f"array has {len(array)} rows, expected {n_rows}")


def _rows(array: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return rows of an array; ``at`` is known to be in range, and the check of it would take ten times as long."""
    return array.take(at, axis=0, mode="clip")


def _parts(rows: np.ndarray, counts: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """Divide rows sorted by rank; only ranks with rows."""
    ends = np.cumsum(counts)
    for rank in np.flatnonzero(counts):
        yield int(rank), rows[ends[rank] - counts[rank] : ends[rank]]

"""Checksums of arrays, snapshots, rows and modes, the same for any number of ranks."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence

import h5py
import numpy as np
from mpi4py import MPI

from ..columns import Layout
from ..mechanics.compiled import kernel

BLOCK = 1 << 18
"""Number of words summed at a time."""
COMPILED = 1 << 12
"""Number of words from which a compiled loop sums them."""
_ODD = np.uint64(0x9E3779B97F4A7C15)
_SHIFT, _ONE = np.uint64(29), np.uint64(1)
_WORD = 2**64 - 1


def checksum(comm: MPI.Comm, slab: np.ndarray, first: int) -> int:
    """Return the checksum of an array distributed in slabs, the same for any number of ranks. Collective.

    It is the sum, modulo 2^64, of all numbers as unsigned words, each times an odd factor computed from its index. It
    detects a change of any single number, and numbers that are swapped.

    Parameters
    ----------
    comm : MPI.Comm
    slab : (n, ...)
        Numbers of 1, 2, 4 or 8 bytes.
    first : int
        Global index of the first row of the slab.
    """
    return int(summed(comm, [word_sum(slab, first)])[0])


def summed(comm: MPI.Comm, parts: Sequence[int]) -> np.ndarray:
    """Return the sums over ranks, modulo 2^64, of parts as :func:`word_sum` gives them (n,) uint64. Collective."""
    total = np.array([part & _WORD for part in parts], dtype=np.uint64)
    if comm.size > 1:
        comm.Allreduce(MPI.IN_PLACE, total, op=MPI.SUM)
    return total


def word_sum(slab: np.ndarray, first: int) -> int:
    """Return this process's part of :func:`checksum`; the parts add up, modulo 2^64, to the checksum of the whole."""
    words = np.ascontiguousarray(slab).reshape(-1).view(f"u{slab.dtype.itemsize}")
    start = first * int(np.prod(slab.shape[1:], dtype=np.int64))
    if len(words) >= COMPILED:
        # those that read results need no compiled loops, which take a third of a second to load
        return int(sum_of_words(words, start))
    return int(np.sum(words.astype(np.uint64) * _factors(start, len(words)), dtype=np.uint64))


def _factors(start: int, count: int) -> np.ndarray:
    """Return the factors of words by their indices from ``start``."""
    factors = (np.arange(start, start + count, dtype=np.uint64) + _ONE) * _ODD
    return (factors ^ (factors >> _SHIFT)) | _ONE


@kernel
def sum_of_words(words: np.ndarray, start: int) -> np.uint64:
    """Return the sum, modulo 2^64, of unsigned words (n,) times the factors of their indices from ``start``."""
    total, factor = np.uint64(0), np.uint64(start) * _ODD
    for i in range(len(words)):
        factor += _ODD  # an addition: multiplications of vectors of 64-bit words are what limits the loop
        total += np.uint64(words[i]) * ((factor ^ (factor >> _SHIFT)) | _ONE)
    return total


def seeded(name: str, total: int) -> int:
    """Return a sum that depends on the name of its array; zero stays zero, for ranks without rows."""
    return (total * (2 * zlib.crc32(name.encode()) + 1)) & _WORD


def snapshot_digests(comm: MPI.Comm, sums: Mapping[str, int]) -> np.ndarray:
    """Return checksums (fields,) uint64 of arrays distributed in slabs over the ranks, sorted by name. Collective.

    ``sums``: name to :func:`word_sum` of this rank's rows, in the type in which they are stored.
    """
    return summed(comm, [seeded(name, part) for name, part in sorted(sums.items())])


def mark_digest(n: int, step: int, time: float) -> int:
    """Return the checksum of the step and time [s] of snapshot n."""
    return zlib.crc32(np.array([n, step], dtype=np.int64).tobytes() + np.float64(time).tobytes())


def numbers_digest(index: int, *numbers: float) -> int:
    """Return the checksum of an index and numbers."""
    return zlib.crc32(np.int64(index).tobytes() + np.array(numbers, dtype=np.float64).tobytes())


class RowDigests:
    """Checksums of the rows of a table.

    Parameters
    ----------
    layout : of a row, with the types of the file
    """

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self._multipliers = np.zeros(layout.width, dtype=np.uint64)
        for name, (first, end, _, _) in layout.places.items():
            self._multipliers[first:end] = _factors(zlib.crc32(name.encode()), end - first)
        # columns whose numbers in the file have other words than those in the vector
        kinds = {name: dtype.base for name, dtype in layout.columns.items()}
        self._others = [(layout[name], kind) for name, kind in kinds.items() if kind != np.float64]

    def of_vectors(self, rows: np.ndarray, first: int) -> np.ndarray:
        """Return checksums (n,) of rows (n, width) of float64, of which the first is row ``first`` of the table."""
        words = np.ascontiguousarray(rows).view(np.uint64)
        if self._others:
            words = words.copy()
        for place, kind in self._others:
            words[:, place] = rows[:, place].astype(kind).view(f"u{kind.itemsize}")
        numbers = np.arange(first + 1, first + len(words) + 1, dtype=np.uint64)
        return numbers * _ODD + (words * self._multipliers).sum(axis=1, dtype=np.uint64)

    def of_columns(self, columns: Mapping[str, np.ndarray], first: int) -> np.ndarray:
        """Return the same from the columns, name to values (n, ...)."""
        parts = [np.asarray(columns[name], dtype=np.float64) for name in self._layout.places]
        return self.of_vectors(np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1), first)


def stored_sum(dataset: h5py.Dataset, first: int, count: int) -> int:
    """Return :func:`word_sum` of stored rows, read in pieces and numbered from 0."""
    per_row = max(1, int(np.prod(dataset.shape[1:], dtype=np.int64)))
    piece, total = max(1, BLOCK // per_row), 0
    if dataset.compression is not None:  # a chunk is read as a whole
        piece = max(1, piece // dataset.chunks[0]) * dataset.chunks[0]
    for start in range(0, count, piece):
        stop = min(start + piece, count)
        total += word_sum(dataset[first + start : first + stop], start)
    return total & _WORD

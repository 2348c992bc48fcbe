"""Parts of datasets of files that all ranks read together: each rank its contiguous share, a piece at a time."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from ...errors import InputError
from ..exchange import Router
from ..slab import index_type, slab_of, slab_range

__all__ = ["PIECE", "Members", "damaged", "pieces", "read_ends", "route_members", "share_of"]

PIECE = 1 << 18
"""Number of rows that are read at a time, so that temporary arrays stay small."""


class Members:
    """Members of a group within the range [first, last), from pieces in any order."""

    def __init__(self, first: int, last: int) -> None:
        self._first = first
        self._mask = np.zeros(last - first, bool)

    def add(self, numbers: np.ndarray) -> None:
        """Add members by their numbers."""
        self._mask[numbers - self._first] = True

    def numbers(self) -> np.ndarray:
        """Return the members, int64, ascending."""
        found = np.flatnonzero(self._mask)
        found += self._first
        return found


def pieces(first: int, last: int) -> Iterator[tuple[int, int]]:
    """Divide the range [first, last) into ranges of at most :data:`PIECE`."""
    for start in range(first, last, PIECE):
        yield start, min(start + PIECE, last)


def share_of(dataset: Any, first: int, last: int, kind: type = np.float64) -> np.ndarray:
    """Return the rows [first, last) of a dataset in another type, without a second copy of them."""
    rows = np.empty((last - first, *dataset.shape[1:]), kind)
    for start, stop in pieces(first, last):
        rows[start - first : stop - first] = dataset[start:stop]
    return rows


def read_ends(dataset: Any, first: int, last: int, n_nodes: int) -> np.ndarray:
    """Return the ends (bars, 2) of the bars [first, last) of a dataset (n_bars, 2) or (2 n_bars,).

    Numbers that are no nodes are kept as far as the type can hold them, else they are -1: checks find both.
    """
    kind = index_type(n_nodes)
    width = 2 if dataset.ndim == 1 else 1
    ends = np.empty((last - first, 2), kind)
    for start, stop in pieces(first, last):
        piece = dataset[width * start : width * stop].reshape(-1, 2)
        if piece.size and (piece.min() < np.iinfo(kind).min or piece.max() > np.iinfo(kind).max):
            piece = np.where((piece < 0) | (piece >= n_nodes), -1, piece)
        ends[start - first : stop - first] = piece
    return ends


def route_members(dataset: Any, n: int, comm: MPI.Comm, path: Path) -> np.ndarray:
    """Return the members of a group within this rank's range of ``n``, of a dataset of all its members in any order.

    Each rank reads its share of the dataset and sends what it finds to the owners. Collective.

    Raises
    ------
    InputError
        On all ranks, if a member is not within 0 to n - 1, or one rank cannot read its share.
    """
    members = Members(*slab_range(n, comm.rank, comm.size))
    total = len(dataset)
    first, last = slab_range(total, comm.rank, comm.size)
    # all ranks take as many pieces as the one with most rows
    for start in range(0, -(-total // comm.size), PIECE):
        piece, wrong = np.empty(0, np.int64), None
        begin, end = min(first + start, last), min(first + start + PIECE, last)
        try:
            piece = dataset[begin:end].astype(np.int64)
        except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
            wrong = begin, damaged(path, error)
        outside = np.flatnonzero((piece < 0) | (piece >= n))
        if len(outside):
            text = f"{path}: {dataset.name} has member {piece[outside[0]]}, but numbers go from 0 to {n - 1}"
            wrong = begin + int(outside[0]), text
        found = [each for each in comm.allgather(wrong) if each is not None]
        if found:
            raise InputError(min(found)[1])
        members.add(Router(comm, slab_of(piece, n, comm.size)).send(piece))
    return members.numbers()


def damaged(path: Path, error: BaseException) -> str:
    """Return the message about a file that HDF5 cannot read."""
    return f"{path}: cannot be read ({error}); the file may be damaged: write it again"

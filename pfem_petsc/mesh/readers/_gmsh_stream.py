"""Pieces of Gmsh files: parsed one after the other, and sent from rank 0 to the others."""

from __future__ import annotations

from collections.abc import Iterator
from typing import IO, Any

import numpy as np
from mpi4py import MPI

from ..slab import slab_of
from ._gmsh_sections import Format, Numbers
from ._text import numbers_of

__all__ = ["END", "FAILED", "LINES", "MARKED", "POINTS", "TAGS", "Sender", "Stream", "receive", "steps"]

PIECE = 1 << 14
"""Number of rows that are parsed and sent at a time."""

_BYTES = 1 << 18  # of text that is parsed at a time

TAGS, POINTS, LINES, MARKED, END, FAILED = range(7200, 7206)
"""Tags of the messages: tags of nodes, their positions, lines, nodes with groups, and how it ended."""


class Stream(Numbers):
    """Numbers of one section of a file, read and parsed in pieces."""

    def __init__(self, where: str, file: IO[bytes], begin: int, end: int, layout: Format) -> None:
        super().__init__(where, b"", layout, False)
        self._file, self._next, self._stop, self._rest = file, begin, end, b""

    def end(self) -> None:
        """Refuse surplus numbers."""
        self._fill(1)
        super().end()

    def _take(self, n: int, kind: str = "f8") -> np.ndarray:
        if not self._binary:
            self._fill(n)
        return super()._take(n, kind)

    def _cut(self, n: int, dtype: np.dtype) -> np.ndarray:
        self._fill(n * dtype.itemsize)
        return super()._cut(n, dtype)

    def _fill(self, n: int) -> None:
        """Have at least n numbers, or bytes of a binary file, in memory, as far as there are so many."""
        have = self._bytes if self._binary else self._values
        left = len(have) - self._at
        if left >= n or self._next >= self._stop:
            return
        parts: list[Any] = [have[self._at :]]
        while left < n and self._next < self._stop:
            parts.append(self._read())
            left += len(parts[-1])
        self._at = 0
        if self._binary:
            self._bytes = b"".join(parts)
        else:
            self._values = np.concatenate(parts)

    def _read(self) -> Any:
        self._file.seek(self._next)
        text = self._file.read(min(_BYTES, self._stop - self._next))
        self._next = self._next + len(text) if text else self._stop
        if self._binary:
            return text
        text = self._rest + text
        if self._next < self._stop:  # the last word may go on
            cut = max(text.rfind(b"\n"), text.rfind(b" ")) + 1
            text, self._rest = text[:cut], text[cut:]
        return numbers_of(text)


class Sender:
    """Rank 0's side: collects rows and sends them as pieces, in order over the slabs of ``n`` rows, or, if ``n`` is
    None, in turn to all ranks."""

    def __init__(self, comm: MPI.Comm, kind: int, own: list[np.ndarray], n: int | None = None) -> None:
        self._comm, self._kind, self._own, self._n = comm, kind, own, n
        self._waiting: list[np.ndarray] = []
        self._count = self.sent = self._turn = 0

    def add(self, rows: np.ndarray) -> None:
        """Send rows, at the latest with :meth:`flush`."""
        self._waiting.append(rows)
        self._count += len(rows)
        if self._count >= PIECE:
            self.flush()

    def flush(self) -> None:
        """Send what is waiting."""
        if not self._count:
            return
        rows = np.concatenate(self._waiting)
        self._waiting, self._count = [], 0
        for rank, part in self._parts(rows):
            if rank == 0:
                self._own.append(_small(part) if self._kind == LINES else part.copy())
            else:
                self._comm.Send(np.ascontiguousarray(part), rank, self._kind)
        self.sent += len(rows)

    def _parts(self, rows: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
        if self._n is None:
            yield self._turn % self._comm.size, rows
            self._turn += 1
            return
        owner = slab_of(np.arange(self.sent, self.sent + len(rows)), self._n, self._comm.size)
        for rank in np.unique(owner):
            yield int(rank), rows[owner == rank]


def receive(comm: MPI.Comm, held: dict[int, list[np.ndarray]]) -> bool:
    """Keep what rank 0 sends up to the end; return whether it could read the file."""
    status = MPI.Status()
    while True:
        comm.Probe(0, MPI.ANY_TAG, status)
        kind, size = status.Get_tag(), status.Get_count(MPI.BYTE)
        piece = np.empty(size // 8, np.float64 if kind == POINTS else np.int64)
        comm.Recv(piece, 0, kind)
        if kind in (END, FAILED):
            return kind == END
        width = {POINTS: (3,), LINES: (4,), MARKED: (2,)}.get(kind, ())
        held[kind].append(_small(piece.reshape(-1, *width)) if kind == LINES else piece.reshape(-1, *width))


def _small(rows: np.ndarray) -> np.ndarray:
    """Return rows of integers in 32 bits if these hold them."""
    return rows.astype(np.int32) if rows.size and rows.max() < 1 << 31 and rows.min() >= 0 else rows.copy()


def steps(n: int) -> Iterator[int]:
    """Divide a count into counts of at most :data:`PIECE`."""
    for start in range(0, n, PIECE):
        yield min(PIECE, n - start)

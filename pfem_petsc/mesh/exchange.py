"""Exchange of rows of arrays between ranks, and updates of ghosts from their owners."""

from __future__ import annotations

import ctypes
import functools
from dataclasses import dataclass
from typing import Any, NamedTuple

import numba.experimental.function_type  # noqa: F401  # registers the type of C functions as arguments
import numpy as np
from mpi4py import MPI
from numba import types

__all__ = ["CFunction", "GhostExchange", "Messages", "Router", "mpi_functions", "swap"]

# First tag of the ghost messages; the number of columns is added, so that exchanges of different widths can be in
# progress at the same time.
_TAG = 7100


class Router:
    """Sends rows to given ranks and returns replies in the order of the rows. Collective.

    Parameters
    ----------
    comm : MPI.Comm
    ranks : (n,) int
        The destination of each row.
    rows : (n,) int, optional
        The rows of the arrays that are sent, some of them possibly to several ranks; without :meth:`reply`.
    """

    def __init__(self, comm: MPI.Comm, ranks: np.ndarray, rows: np.ndarray | None = None) -> None:
        self._comm = comm
        if comm.size == 1:
            self._counts = self._arriving = np.array([len(ranks)])
            self.n_received = len(ranks)
            return
        # 16-bit ranks are sorted by radix, several times faster than wider ones.
        if comm.size <= np.iinfo(np.uint16).max:
            ranks = ranks.astype(np.uint16, copy=False)
        self._order = np.argsort(ranks, kind="stable")
        if rows is not None:
            self._order = rows[self._order]
        self._counts = np.bincount(ranks, minlength=comm.size)
        self._arriving = np.empty_like(self._counts)
        comm.Alltoall(self._counts, self._arriving)
        self.n_received = int(self._arriving.sum())

    def send(self, rows: np.ndarray) -> np.ndarray:
        """Send row i to its rank; return the received rows, ordered by sending rank and its rows.

        On a single rank the array itself is returned, not a copy; likewise by :meth:`reply`.
        """
        if self._comm.size == 1:
            return rows
        return self._exchange(rows[self._order], self._counts, self._arriving)

    def reply(self, rows: np.ndarray) -> np.ndarray:
        """Send back one row per received row, in that order; return the replies in the order of the rows sent."""
        if self._comm.size == 1:
            return rows
        returned = self._exchange(np.ascontiguousarray(rows), self._arriving, self._counts)
        result = np.empty_like(returned)
        result[self._order] = returned
        return result

    def _exchange(self, rows: np.ndarray, leaving: np.ndarray, arriving: np.ndarray) -> np.ndarray:
        received = np.empty((int(arriving.sum()), *rows.shape[1:]), rows.dtype)
        # One item is one row, so that the counts stay within the 32-bit integers of MPI.
        row = MPI.BYTE.Create_contiguous(rows.dtype.itemsize * int(np.prod(rows.shape[1:], dtype=np.int64))).Commit()
        try:
            self._comm.Alltoallv([rows, leaving, row], [received, arriving, row])
        finally:
            row.Free()
        return received


@dataclass
class _Buffers:
    """Persistent requests of one width, with their buffers."""

    leaving: np.ndarray
    arriving: np.ndarray
    requests: list[MPI.Prequest]


class Messages(NamedTuple):
    """The messages of an exchange of three columns for compiled loops, which call MPI themselves.

    Attributes
    ----------
    several : whether there are several ranks
    rows : (r,) owned rows that are sent; leaving : (r, 3), arriving : (g, 3) buffers
    count : number of requests; requests, statuses : their handles, and room for as many statuses, as bytes
    handles : (3,) of the type int, the maximum, and the communicator
    """

    several: bool
    rows: np.ndarray
    leaving: np.ndarray
    arriving: np.ndarray
    count: int
    requests: np.ndarray
    statuses: np.ndarray
    handles: np.ndarray


class CFunction(types.WrapperAddressProtocol):
    """A C function that compiled loops take as an argument.

    Parameters
    ----------
    function : of ctypes
    signature : of Numba
    """

    def __init__(self, function: Any, signature: Any) -> None:
        self._function, self._signature = function, signature

    def __wrapper_address__(self) -> int:
        """Return the address of the function."""
        return ctypes.cast(self._function, ctypes.c_void_p).value

    def signature(self) -> Any:
        """Return the signature of the function."""
        return self._signature


_BYTES, _INT = types.CPointer(types.uint8), types.int32
SIGNATURES = {
    "MPI_Startall": _INT(_INT, _BYTES),
    "MPI_Waitall": _INT(_INT, _BYTES, _BYTES),
    "MPI_Allreduce": _INT(types.CPointer(_INT), types.CPointer(_INT), _INT, types.intp, types.intp, types.intp),
}


@functools.cache
def mpi_functions() -> tuple[CFunction, ...] | None:
    """Return ``MPI_Startall``, ``MPI_Waitall`` and ``MPI_Allreduce`` for compiled loops; None if there are none."""
    try:
        library = ctypes.CDLL(MPI.__file__)
        text, length = ctypes.create_string_buffer(MPI.MAX_LIBRARY_VERSION_STRING), ctypes.c_int()
        library.MPI_Get_library_version(text, ctypes.byref(length))
        # a library of another MPI than mpi4py's would not know its requests
        if text.value.decode().strip() != MPI.Get_library_version().strip("\0 \n"):
            return None
        return tuple(CFunction(getattr(library, name), signature) for name, signature in SIGNATURES.items())
    except (OSError, AttributeError):
        return None


class GhostExchange:
    """Sends owned rows to the ranks that have them as ghosts. Construction is collective, updates are point to point.

    Buffers and persistent requests are created at the first call of a width (number of columns) and kept.

    Parameters
    ----------
    comm : MPI.Comm
    starts : (size + 1,) int
        First number owned by each rank, and the end.
    ghosts : (n_ghosts,) int
        Numbers of this rank's ghosts, ascending, so that those of one owner are contiguous.
    tag : int
        First of a hundred tags of its messages, which must differ between exchanges in progress at the same time.

    Attributes
    ----------
    rows : owned rows that are ghosts on other ranks, in the order in which they are sent, repeated for each rank
    """

    def __init__(self, comm: MPI.Comm, starts: np.ndarray, ghosts: np.ndarray, tag: int = _TAG) -> None:
        self._comm, self._tag = comm, tag
        self._n_owned, self._n_ghosts = int(starts[comm.rank + 1] - starts[comm.rank]), len(ghosts)
        router = Router(comm, np.searchsorted(starts, ghosts, side="right") - 1)
        asked = router.send(np.asarray(ghosts, dtype=np.int64))
        self.rows = (asked - starts[comm.rank]).astype(np.intp)
        self._leaving, self._arriving = _neighbours(router._arriving), _neighbours(router._counts)
        self._buffers: dict[int, _Buffers] = {}

    @property
    def n_neighbours(self) -> int:
        """Number of ranks that send rows to this rank or receive rows from it."""
        return len({rank for rank, _, _ in self._leaving} | {rank for rank, _, _ in self._arriving})

    @property
    def alone(self) -> bool:
        """Whether this rank sends nothing and receives nothing."""
        return not self._leaving and not self._arriving

    def leaving(self, width: int) -> np.ndarray:
        """Return the buffer (rows, width) for the values of :attr:`rows`, to be passed to :meth:`bring`."""
        return self._of(width).leaving

    def bring(self, leaving: np.ndarray) -> np.ndarray:
        """Send values (rows, k) float64 of :attr:`rows` to their ghosts; return those of own ghosts (ghosts, k).

        The result is overwritten by the next call of this width.
        """
        if self.alone:
            return np.empty((0, leaving.shape[1]))
        buffers = self._of(leaving.shape[1])
        if leaving is not buffers.leaving:
            buffers.leaving[:] = leaving
        MPI.Prequest.Startall(buffers.requests)
        MPI.Request.Waitall(buffers.requests)
        return buffers.arriving

    def messages(self) -> Messages:
        """Return the messages of arrays with three columns for compiled loops, valid until :meth:`close`."""
        buffers = self._of(3)
        handle, status = MPI._sizeof(MPI.Request), MPI._sizeof(MPI.Status)
        handles = [ctypes.string_at(MPI._addressof(request), handle) for request in buffers.requests]
        requests = np.frombuffer(b"".join(handles), dtype=np.uint8).copy()
        statuses = np.zeros(max(len(handles), 1) * status, dtype=np.uint8)
        rows = self.rows.astype(np.int64)
        used = np.array([MPI._handleof(each) for each in (MPI.INT, MPI.MAX, self._comm)], dtype=np.uint64)
        arrays = buffers.leaving, buffers.arriving, len(handles), requests, statuses
        return Messages(self._comm.size > 1, rows, *arrays, used.view(np.int64))

    def update(self, array: np.ndarray) -> None:
        """Send the owned rows of ``array`` (n_local, k) float64 to their ghosts on other ranks."""
        if self.alone:
            return
        width = array.size // array.shape[0]
        rows, leaving = array.reshape(-1, width), self.leaving(width)
        # mode="clip" avoids the temporary array of NumPy's default; the rows are known to be in range
        np.take(rows, self.rows, axis=0, out=leaving, mode="clip")
        rows[self._n_owned :] = self.bring(leaving)

    def close(self) -> None:
        """Free the requests; no update may be in progress."""
        for buffers in self._buffers.values():
            for request in buffers.requests:
                request.Free()
        self._buffers.clear()

    def _of(self, width: int) -> _Buffers:
        if width not in self._buffers:
            leaving = np.empty((len(self.rows), width))
            arriving = np.empty((self._n_ghosts, width))
            tag = self._tag + width
            requests = [self._comm.Recv_init(arriving[a:b], rank, tag) for rank, a, b in self._arriving]
            requests += [self._comm.Send_init(leaving[a:b], rank, tag) for rank, a, b in self._leaving]
            self._buffers[width] = _Buffers(leaving, arriving, requests)
        return self._buffers[width]


def swap(comm: MPI.Comm, ranks: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Exchange rows (n, k) float64 with other ranks; only the ranks named here communicate.

    Row i goes to rank ``ranks[i]``, which sends the same number of rows to this rank, in the same order.
    """
    order = np.argsort(ranks, kind="stable")
    leaving, parts = np.ascontiguousarray(rows[order]), _neighbours(np.bincount(ranks, minlength=comm.size))
    arriving = np.empty_like(leaving)
    requests = [comm.Irecv(arriving[a:b], rank, _TAG - 1) for rank, a, b in parts]
    requests += [comm.Isend(leaving[a:b], rank, _TAG - 1) for rank, a, b in parts]
    MPI.Request.Waitall(requests)
    result = np.empty_like(arriving)
    result[order] = arriving
    return result


def _neighbours(counts: np.ndarray) -> list[tuple[int, int, int]]:
    """Return (rank, first row, end of rows) of every rank with a nonzero count, for rows sorted by rank."""
    ends = np.cumsum(counts)
    return [(int(rank), int(ends[rank] - counts[rank]), int(ends[rank])) for rank in np.flatnonzero(counts)]

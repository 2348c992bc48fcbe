"""The file that all ranks write, and what is being written to it beside the steps."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TypeVar

import h5py
import numpy as np
from mpi4py import MPI

from ..errors import SimulationFailure
from ..parallel.agreement import agreed, on_root
from ..parallel.memory import share_memory
from .hdf5 import Growing, open_shared, release, writing

T = TypeVar("T")

_PIECE = 1 << 18  # rows of a message
_TAG = 7301


class SharedFile:
    """An existing HDF5 file that is open for writing, and at most one piece of work on it beside the steps.

    On one machine rank 0 is the owner of the file: it writes what the other ranks give, in a tenth of the time of
    MPI-IO. On several machines, and for compressed values, all ranks are owners and write by collective transfers.

    Work beside the steps is done by a thread of the owner. Nothing else may use the file before :meth:`wait`.
    Construction is collective.

    Parameters
    ----------
    path : of the file
    comm : MPI.Comm
    name : of the file in messages
    compressed : whether values pass filters

    Attributes
    ----------
    file : h5py.File on owners, None on other ranks
    together : whether all ranks of several are owners
    owners : MPI.Comm of an owner and those that take part in its calls of HDF5
    """

    def __init__(self, path: Path, comm: MPI.Comm, name: Path, compressed: bool) -> None:
        self.comm, self.name = comm, name
        self.together = comm.size > 1 and (compressed or not share_memory(comm))
        self.owners = comm if self.together else MPI.COMM_SELF
        self.file: h5py.File | None = None
        with writing(comm, name):
            if self.together or comm.rank == 0:
                self.file = open_shared(path, self.owners)
        self._thread = ThreadPoolExecutor(1, "result file")
        self._begun = False
        self._work: Future[None] | None = None

    def writing(self) -> AbstractContextManager[None]:
        """Context of one HDF5 operation of the owners, see :func:`~pfem_petsc.output.hdf5.writing`."""
        return writing(self.owners, self.name)

    def call(self, function: Callable[[], T]) -> T:
        """Call a function that uses the file on its owners; return its result on all ranks. Collective."""
        return function() if self.together else on_root(self.comm, self._guarded, function)

    def _guarded(self, function: Callable[[], T]) -> T:
        """Call a function of the only owner, whose errors of HDF5 other ranks must know."""
        with self.writing():
            return function()

    def write(self, dataset: Growing | None, first: int, rows: np.ndarray, index: tuple[int, ...] = ()) -> None:
        """Write each rank's rows (n, ...) from row ``first`` of a dataset, at an index of the dimensions before.

        ``dataset`` is None on ranks that are no owners, which send their rows. Collective.
        """

        def put(first: int, rows: np.ndarray) -> None:
            start = (*index, first, *(0,) * (rows.ndim - 1))
            with self.writing():
                dataset.write(start, rows.reshape((1,) * len(index) + rows.shape), collective=self.together)

        if self.together:
            put(first, rows)
            return
        failure: SimulationFailure | None = None
        for start, rank, n in self._pieces(first, len(rows)):
            piece = rows[start - first : start - first + n] if rank == self.comm.rank else None
            if self.file is None:
                if piece is not None:
                    self.comm.Send(np.ascontiguousarray(piece), 0, _TAG)
            else:
                if piece is None:
                    piece = np.empty((n, *rows.shape[1:]), rows.dtype)
                    self.comm.Recv(piece, rank, _TAG)
                try:
                    put(start, piece)
                except SimulationFailure as error:  # what is on its way must be received
                    failure = failure or error
        with agreed(self.comm):
            if failure is not None:
                raise failure

    def _pieces(self, first: int, n: int) -> list[tuple[int, int, int]]:
        """Return the rows of all ranks in pieces: first row, rank, number of rows. Collective."""
        parts = enumerate(self.comm.allgather((first, n)))
        return [
            (start, rank, min(_PIECE, first + n - start))
            for rank, (first, n) in parts
            for start in range(first, first + n, _PIECE)
        ]

    def submit(self, work: Callable[[], None], beside: bool) -> None:
        """Let the owners do some work, ``beside`` the steps or now. What fails beside them, all ranks raise in
        :meth:`wait`. Collective."""
        if self.together or not beside:
            self.call(work)
            return
        self._begun = True
        if self.file is not None:
            self._work = self._thread.submit(self._guarded, work)

    def wait(self) -> None:
        """Wait for the work beside the steps. Collective.

        Raises
        ------
        SimulationFailure
            On all ranks, if it has failed.
        """
        if not self._begun:
            return
        self._begun = False
        work, self._work = self._work, None
        with agreed(self.comm):
            if work is not None:
                work.result()

    def close(self) -> None:
        """Close the file, which no work uses any more. Collective."""
        file, self.file = self.file, None
        self._thread.shutdown()
        with writing(self.comm, self.name):
            if file is not None:
                file.close()

    def abandon(self) -> None:
        """Leave the file after a failure, see :func:`~pfem_petsc.output.hdf5.release`."""
        file, self.file = self.file, None
        self._thread.shutdown()
        if file is not None:
            release(file, self.owners)

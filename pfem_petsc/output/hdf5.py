"""HDF5 for all writers: growing datasets, free space, errors, and the file that all ranks write together."""

from __future__ import annotations

import functools
import os
import resource
import shutil
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any, TypeVar

import h5py
import numpy as np
from mpi4py import MPI

from ..errors import InputError, SimulationFailure
from ..parallel.agreement import agreed, aside, on_root, outcome
from ..parallel.heap import SharedArrays, share_memory

CHUNK_BYTES = 1 << 20
_LARGEST = 1 << 32  # bytes of a chunk of HDF5
# How many times smaller than CHUNK_BYTES compressed chunks may be.
_SMALLER = 64
# Level of compression: higher ones take two to ten times as long for a few percent.
_DEFLATE = 1


class Growing:
    """A dataset of a file that is open for writing.

    What HDF5 needs for a write of rows is looked up once: a write takes 3 µs and the time that its bytes take, instead
    of 15.

    Parameters
    ----------
    dataset : (rows, ...)

    Attributes
    ----------
    dtype : of the numbers
    """

    def __init__(self, dataset: h5py.Dataset) -> None:
        self._id, self._shape, self.dtype = dataset.id, dataset.shape, dataset.dtype
        self._type = h5py.h5t.py_create(self.dtype)
        self._zeros = (0,) * (len(self._shape) - 1)

    def grow(self, n_rows: int) -> None:
        """Set the number of rows. Collective for a shared file."""
        self._shape = (n_rows, *self._shape[1:])
        self._id.set_extent(self._shape)

    def write(self, first: int, rows: np.ndarray, collective: bool = False) -> None:
        """Write rows (n, ...) starting at row ``first``; no rows: join a collective transfer without data."""
        if rows.size == 0:
            rows = np.empty((1,) * len(self._shape), dtype=self.dtype)
            source, target = h5py.h5s.create_simple(rows.shape), self._id.get_space()
            source.select_none()
            target.select_none()
        else:
            rows = np.ascontiguousarray(rows, dtype=self.dtype)
            source, target = _selection(self._shape, (first, *self._zeros), rows.shape)
        self._id.write(source, target, rows, self._type, _collective() if collective else None)


@functools.lru_cache(16)
def _selection(
    shape: tuple[int, ...], start: tuple[int, ...], count: tuple[int, ...]
) -> tuple[h5py.h5s.SpaceID, h5py.h5s.SpaceID]:
    """Return the spaces in memory and in the file of a part of a dataset, one pair for all columns of a table."""
    target = h5py.h5s.create_simple(shape)
    target.select_hyperslab(start, count)
    return h5py.h5s.create_simple(count), target


@functools.cache
def _collective() -> h5py.h5p.PropDXID:
    transfer = h5py.h5p.create(h5py.h5p.DATASET_XFER)
    transfer.set_dxpl_mpio(h5py.h5fd.MPIO_COLLECTIVE)
    return transfer


def chunk_rows(n_rows: int, row_bytes: int, compressed: bool = False) -> int:
    """Return the number of rows per chunk for blocks of ``n_rows`` rows: blocks up to 1 MiB, else equal parts.

    It depends on the global size only, so that files from any number of ranks have the same chunks. A divisor of the
    block is preferred, because then no chunk contains rows of two snapshots. A compressed one would be written anew
    with the second snapshot, and a kill would lose the first: if there is no divisor for chunks of 16 KiB to 1 MiB, it
    is a whole block, unless HDF5 has no chunks of that size.
    """
    parts = max(1, -(-n_rows // max(1, CHUNK_BYTES // row_bytes)))
    for divisor in range(parts, (_SMALLER if compressed else 4) * parts):
        if n_rows % divisor == 0:
            return max(1, n_rows // divisor)
    return n_rows if compressed and n_rows * row_bytes < _LARGEST else -(-n_rows // parts)


def is_compressed(dataset: h5py.Dataset) -> bool:
    """Return whether chunks pass filters on their way to the file."""
    return dataset.id.get_create_plist().get_nfilters() > 0


def create_growing(
    group: h5py.Group,
    name: str,
    row_shape: tuple[int, ...],
    dtype: np.dtype | type,
    chunk: int | tuple[int, ...],
    compressed: bool = False,
) -> h5py.Dataset:
    """Create an empty dataset (0, *row_shape) that grows by rows, and its parents. Collective for a shared file.

    ``chunk``: rows of a chunk, or its shape; ``compressed``: by gzip, which all readers of HDF5 have, after a shuffle
    of bytes: the high bytes of near values are alike.
    """
    shape = (0, *row_shape)
    space = h5py.h5s.create_simple(shape, (h5py.h5s.UNLIMITED, *row_shape))
    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    properties.set_chunk(chunk if isinstance(chunk, tuple) else (chunk, *(max(1, extent) for extent in row_shape)))
    if compressed:
        properties.set_shuffle()
        properties.set_deflate(_DEFLATE)
    # Parallel writes need chunks allocated when the dataset grows, also in a file created by one rank.
    properties.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    # Ranks would write zeros into new chunks, one chunk after the other; rows count only once they are written.
    properties.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    *parents, leaf = name.split("/")
    if parents:
        group = group.require_group("/".join(parents))
    made = h5py.h5d.create(
        group.id, leaf.encode(), h5py.h5t.py_create(np.dtype(dtype), logical=True), space, properties
    )
    return h5py.Dataset(made)


# Exceptions that h5py raises for errors of the HDF5 library, depending on the call, such as reading a damaged file.
HDF5_ERRORS = (OSError, RuntimeError, ValueError, KeyError)

# Lowest and highest format of a result file. With the superblock of 1.8 and objects of 1.10 all HDF5 metadata have
# checksums, and chunks along one growing dimension are indexed by an extensible array, whose entries do not move. The
# B-tree of earlier formats is split from time to time, and a kill between the writes of a split lost the file. With the
# superblock of 1.10 HDF5 would refuse a file whose writer was killed.
SUPERBLOCK, OBJECTS = ("v108", "v108"), ("v110", "v110")
# Bytes of the chunk cache per dataset: the default of 1 MiB, times all columns and fields, would fill up in a long run,
# and rows are never written twice.
CHUNK_CACHE = 1 << 16


def require_parallel_hdf5(comm: MPI.Comm) -> None:
    """Refuse several ranks if h5py cannot write one file from all of them. Collective; before any write, as ranks agree
    aside whether it has succeeded.

    Raises
    ------
    InputError
        On all ranks (the build may differ between machines).
    """
    aside(comm)
    with agreed(comm):
        if comm.size > 1 and not h5py.get_config().mpi:
            raise InputError(
                f"h5py {h5py.__version__} ({h5py.__file__}) is a serial build, and {comm.size} ranks write one result "
                "file together: install h5py built with MPI (Debian, Ubuntu: apt install python3-h5py-mpi; else "
                "CC=mpicc HDF5_MPI=ON pip install --no-binary=h5py h5py), or run on one rank"
            )


def create_new(
    path: Path,
    comm: MPI.Comm,
    build: Callable[..., None],
    *arguments: Any,
    userblock_size: int = 0,
) -> Path:
    """Create an HDF5 file with its whole structure on rank 0 and return its temporary name.

    ``build(file, *arguments)`` fills it; the first ``userblock_size`` bytes belong to the caller. HDF5
    stores checksums of everything except the values. With serial creation the structure
    is the same for any number of ranks, and an unwritable folder is the same error on all of them. Collective.

    Raises
    ------
    InputError
        On all ranks, if the folder cannot be written, or is not the same folder on all of them.
    """

    temporary = path.with_name(path.name + ".new")

    def create() -> None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            h5py.File(temporary, "w", locking=False, libver=SUPERBLOCK, userblock_size=userblock_size).close()
            with h5py.File(temporary, "r+", locking=False, libver=OBJECTS) as file:
                build(file, *arguments)
        except (OSError, RuntimeError) as error:
            number = getattr(error, "errno", None)
            raise InputError(
                f"{path}: cannot write there: {os.strerror(number) if number else first_line(error)}; "
                "choose another output folder (-o)"
            ) from error

    on_root(comm, create)
    first = first_of_machine(comm)
    with agreed(comm):
        # A network file system may show a new file on other machines with a delay.
        deadline = time.monotonic() + 5.0
        while first and not temporary.exists():
            if time.monotonic() > deadline:
                raise InputError(
                    f"{path}: made by rank 0, but rank {comm.rank} on {MPI.Get_processor_name()} does not see it: "
                    "choose an output folder (-o) that all machines share"
                )
            time.sleep(0.1)
    return temporary


def open_shared(path: Path, comm: MPI.Comm) -> h5py.File:
    """Open an existing file for writing on all ranks; on one rank without a lock, so that it can be read meanwhile."""
    if comm.size == 1:
        return h5py.File(path, "r+", locking=False, rdcc_nbytes=CHUNK_CACHE, libver=OBJECTS)
    return h5py.File(path, "r+", driver="mpio", comm=comm, libver=OBJECTS)


def dataset_names(group: h5py.Group) -> list[str]:
    """Return the names of all datasets in a group and its subgroups, relative to it: ["time", "wall/floor/force"]."""
    names: list[str] = []
    group.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
    return names


def first_of_machine(comm: MPI.Comm) -> bool:
    """Return whether this rank is the first one of those on its machine. Collective."""
    if comm.size == 1:
        return True
    machine = comm.Split_type(MPI.COMM_TYPE_SHARED)
    first = machine.rank == 0
    machine.Free()
    return first


def writes_together(comm: MPI.Comm) -> bool:
    """Return whether ranks write arrays by collective transfers: on several machines. Collective.

    These pass all data to one rank of each machine, which writes them: on a single machine it takes four times as long
    as each rank's writing of its own rows.
    """
    return comm.allreduce(int(first_of_machine(comm))) > 1


def set_text(group: h5py.Group, name: str, text: str) -> None:
    """Store or replace a text as a dataset of fixed length; several ranks cannot write variable lengths."""
    if name in group:
        del group[name]
    raw = text.encode("utf-8")
    group.create_dataset(name, data=np.array(raw, dtype=h5py.string_dtype("utf-8", max(1, len(raw)))))


def set_unit(dataset: h5py.Dataset, unit: str) -> None:
    """Set the attribute ``unit`` of a field or history column: "m/s", or "1" for a pure number. Collective."""
    raw = (unit or "1").encode()
    dataset.attrs.create("unit", raw, dtype=h5py.string_dtype("utf-8", len(raw)))


@contextmanager
def writing(comm: MPI.Comm, path: Path) -> Iterator[None]:
    """Context of one HDF5 operation of all ranks; an error on any rank becomes a SimulationFailure on all.

    If an operation fails on one rank, the others may wait in HDF5 forever. Therefore the rank that failed waits for
    them a few seconds only and then raises the error alone; the caller must end the job. Collective.
    """
    failure: SimulationFailure | None = None
    try:
        yield
    except (OSError, RuntimeError) as error:
        failure = SimulationFailure(
            f"{path}: writing failed on rank {comm.rank} ({first_line(error)}): is the disk full, or the folder gone? "
            "What was written before stays readable; continue with --restart when there is room"
        )
        failure.__cause__ = error
    if comm.size > 1:
        found = outcome(comm, failure is not None)
        if found is None:
            raise failure
        if found[0] < comm.size:
            raise comm.bcast(failure, root=found[0])
    elif failure is not None:
        raise failure


def release(file: h5py.File, comm: MPI.Comm) -> None:
    """Abandon a file that can no longer be written.

    HDF5 1.10 and later crash if a close, or the exit of the process, cannot write data that are still in memory.
    Therefore a single process redirects these writes to memory. Several ranks leave the file open, because closing it
    together might never end.
    """
    if comm.size == 1 and file.id.valid:
        nowhere = os.memfd_create("released")
        os.dup2(nowhere, file.id.get_vfd_handle())
        os.close(nowhere)
        file.close()


def first_line(error: BaseException) -> str:
    """Return the first line of an error message, without the details added by HDF5; its type if it is empty."""
    return str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__


def require_room(comm: MPI.Comm, path: Path, n_bytes: int, target: Path | None = None) -> None:
    """Check that the next write fits on the disk; a disk that fills up within HDF5 may damage the file.

    Rank 0 decides. Collective.

    Raises
    ------
    SimulationFailure
        On all ranks, if the file (or folder ``target``) is missing or fewer than ``n_bytes`` + 1 MiB are free, on the
        disk or below the limit of the process for the size of files.
    """

    def look() -> None:
        try:
            size = (target or path).stat().st_size
            free, limited = shutil.disk_usage(path.parent).free, ""
            limit = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
            if limit != resource.RLIM_INFINITY and limit - size < free:
                free, limited = max(limit - size, 0), f" (ulimit -f: {limit / 1e6:.1f} MB for a file)"
        except OSError as error:
            raise SimulationFailure(
                f"{path}: gone or unreachable during the run ({os.strerror(error.errno)}); "
                "do not move or remove the output folder of a running simulation"
            ) from error
        needed = n_bytes + (1 << 20)
        if free < needed:
            raise SimulationFailure(
                f"{path}: disk full{limited}: {free / 1e6:.1f} MB are free, and the next write may take "
                f"{needed / 1e6:.1f} MB. "
                "What was written before is complete; make room and continue with --restart, or write less "
                "(fields_every, fields, precision, compression in [output])"
            )

    on_root(comm, look)


def fsync_all(path: Path) -> None:
    """Flush a file, or the entries of a folder, to disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


T = TypeVar("T")


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

    def write(self, dataset: Growing | None, first: int, rows: np.ndarray) -> None:
        """Write each rank's rows (n, ...) from row ``first`` of a dataset.

        ``dataset`` is None on ranks that are no owners, whose rows go through memory that ranks share. Collective.
        """
        if self.comm.size > 1 and not self.together:
            ends = self.comm.allreduce(first + len(rows), op=MPI.MAX)
            with writing(self.comm, self.name):
                memory = SharedArrays(self.comm, {"rows": np.dtype((rows.dtype, (ends, *rows.shape[1:])))})
            memory.arrays["rows"][first : first + len(rows)] = rows
            self.comm.Barrier()
            first, rows = 0, memory.arrays["rows"]

        def put() -> None:
            with self.writing():
                dataset.write(first, rows, collective=self.together)

        self.call(put)

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

"""Memory: what a set-up frees goes back to the system; arrays that all ranks of a machine share.

SuperLU_DIST, which a PETSc may be linked to, tells the C library as it is loaded to keep all freed memory. A run would
then hold the largest temporary arrays of its set-up to its end.
"""

from __future__ import annotations

import contextlib
import ctypes
import mmap
import os
from collections.abc import Iterator, Mapping

import numpy as np
from mpi4py import MPI

__all__ = ["return_freed_memory", "returning_freed_memory"]

_TRIM_THRESHOLD, _MMAP_THRESHOLD, _MMAP_MAX = -1, -3, -4  # of mallopt(3) of the GNU C library

_LARGE = 1 << 20
"""Size [B] from which an array has memory of its own, which goes back as the array is freed."""


@contextlib.contextmanager
def returning_freed_memory() -> Iterator[None]:
    """Have the C library return the memory of large arrays as they are freed; elsewhere than with glibc nothing.

    Afterwards it keeps what is freed: requesting pages again in every step would make implicit steps 4 % slower.
    """
    library = _glibc()
    if library is None:
        yield
        return
    library.mallopt(_MMAP_THRESHOLD, _LARGE)
    library.mallopt(_MMAP_MAX, 1 << 16)
    library.mallopt(_TRIM_THRESHOLD, 16 * _LARGE)
    try:
        yield
    finally:
        library.malloc_trim(0)
        library.mallopt(_MMAP_MAX, 0)
        library.mallopt(_TRIM_THRESHOLD, -1)


def return_freed_memory() -> None:
    """Return what is free now, for example before steps that need less than those before."""
    library = _glibc()
    if library is not None:
        library.malloc_trim(0)


def _glibc() -> ctypes.CDLL | None:
    with contextlib.suppress(OSError, AttributeError):
        library = ctypes.CDLL(None)
        library.gnu_get_libc_version  # noqa: B018 - other libraries number the parameters differently
        return library
    return None


_ALIGNMENT = 64


class SharedArrays:
    """Arrays that all ranks of one machine see: rank 0 creates them, and the others map its memory.

    The memory is no file of /dev/shm, which is small in containers, and is freed with the last rank. Who reads what
    another rank has written must wait for it. Construction is collective.

    Parameters
    ----------
    comm : MPI.Comm
    kinds : name to the type of the array with its shape

    Attributes
    ----------
    arrays : name to array, zero at first

    Raises
    ------
    OSError
        On all ranks, if one of them cannot map the memory, as on another machine or in another container.
    """

    def __init__(self, comm: MPI.Comm, kinds: Mapping[str, np.dtype]) -> None:
        starts = np.cumsum([0, *(-(-kind.itemsize // _ALIGNMENT) * _ALIGNMENT for kind in kinds.values())])
        self.arrays: dict[str, np.ndarray] = {}
        handle, error = -1, None
        try:
            if comm.rank == 0:
                handle = os.memfd_create("pfem_petsc")
                os.ftruncate(handle, max(int(starts[-1]), 1))
        except OSError as caught:
            error = caught
        owner = comm.bcast((os.getpid(), handle) if error is None else None, root=0)
        try:
            if owner is None:
                raise error or OSError("rank 0 has no memory for arrays that ranks share")
            if comm.rank:
                handle = os.open("/proc/{}/fd/{}".format(*owner), os.O_RDWR)
            memory = mmap.mmap(handle, max(int(starts[-1]), 1))
            for start, (name, kind) in zip(starts.tolist(), kinds.items(), strict=False):
                self.arrays[name] = np.ndarray(kind.shape, kind.base, memory, start)
        except OSError as caught:
            error = caught
        errors = [each for each in comm.allgather(error) if each is not None]
        if handle >= 0:
            os.close(handle)  # the others have opened it by now
        if errors:
            raise errors[0]


def share_memory(comm: MPI.Comm) -> bool:
    """Return whether all ranks can share arrays: those of one machine. Collective."""
    mark = np.random.default_rng().integers(2**62) if comm.rank == 0 else None
    try:
        shared = SharedArrays(comm, {"mark": np.dtype((np.int64, (1,)))}).arrays["mark"]
    except OSError:
        return False
    if comm.rank == 0:
        shared[:] = mark
    # a process of another machine may have the same number
    return comm.allreduce(bool(comm.bcast(mark, root=0) == shared[0]), op=MPI.LAND)

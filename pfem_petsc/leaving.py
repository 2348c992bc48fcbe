"""The end of the program, without the end of the interpreter, which takes a sixth of the time of a short run."""

from __future__ import annotations

import atexit
import ctypes
import gc
import os
import sys
from typing import TextIO


class Leaving:
    """Ends the process at exit once all other work at exit is done.

    Python would then free, one by one, objects and libraries that end with the process anyway. A program that has
    failed, or that has left files open, ends in the usual way.

    Attributes
    ----------
    status : exit status of the program; None until it is known
    """

    status: int | None = None

    def ends_with(self, status: int) -> int:
        """Take the exit status of the program, which has nothing more to do, and return it."""
        self.status = status
        if status == 0:
            gc.freeze()  # nothing that is collected at exit would be freed for long
        return status

    def leave(self) -> None:
        """End the process if the program has succeeded."""
        if self.status != 0:
            return
        if not _files_are_open() and _are_flushed(sys.stdout, sys.stderr):
            _finalise()
            os._exit(0)
        gc.unfreeze()
        gc.collect()  # objects that libraries could no longer free after Python


def leave_at_exit() -> Leaving:
    """Return what ends the process after everything that is registered from now on for the exit."""
    leaving = Leaving()
    atexit.register(leaving.leave)
    return leaving


def _finalise() -> None:
    """Finalise libraries in the order in which they end with the interpreter: PETSc prints its logs, then MPI tells the
    launcher."""
    if "petsc4py.PETSc" in sys.modules:
        sys.modules["petsc4py.PETSc"]._finalize()
    if "mpi4py.MPI" in sys.modules:
        mpi = sys.modules["mpi4py.MPI"]
        if mpi.Is_initialized() and not mpi.Is_finalized():
            mpi.Finalize()
    ctypes.CDLL(None).fflush(None)  # what libraries have printed


def _are_flushed(*streams: TextIO) -> bool:
    """Return whether all is written; what is not, Python reports with the exit status of that."""
    try:
        for stream in streams:
            stream.flush()
    except (OSError, ValueError):
        return False
    return True


def _files_are_open() -> bool:
    """Return whether files of HDF5 are open, which it would complete at the end of the process."""
    h5py = sys.modules.get("h5py")
    return h5py is not None and h5py.h5f.get_obj_count(h5py.h5f.OBJ_ALL, h5py.h5f.OBJ_FILE) > 0

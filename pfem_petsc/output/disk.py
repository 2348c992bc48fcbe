"""Free space for the next write, and files flushed to the disk."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from mpi4py import MPI

from ..errors import SimulationFailure
from ..parallel.agreement import on_root

__all__ = ["fsync_all", "require_room"]


def require_room(comm: MPI.Comm, path: Path, n_bytes: int, target: Path | None = None) -> None:
    """Stop before a write that does not fit, while the file is intact: a disk that fills up within HDF5 may damage it.

    Rank 0 decides. Collective.

    Raises
    ------
    SimulationFailure
        On all ranks, when the file (or folder ``target``) is gone or fewer than ``n_bytes`` + 1 MiB are free.
    """

    def look() -> None:
        try:
            (target or path).stat()
            free = shutil.disk_usage(path.parent).free
        except OSError as error:
            raise SimulationFailure(
                f"{path}: gone or unreachable during the run ({os.strerror(error.errno)}); "
                "do not move or remove the output folder of a run that is going on"
            ) from error
        needed = n_bytes + (1 << 20)
        if free < needed:
            raise SimulationFailure(
                f"{path}: disk full: {free / 1e6:.1f} MB are free, and the next write may take {needed / 1e6:.1f} MB. "
                "What was written before is complete; make room and continue with --restart, or write less "
                "(fields_every, fields, precision in [output])"
            )

    on_root(comm, look)


def fsync_all(path: Path) -> None:
    """Flush a file, or the entries of a folder, to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)

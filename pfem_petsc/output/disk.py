"""Checks of free disk space before a write, and flushing of files to disk."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from mpi4py import MPI

from ..errors import SimulationFailure
from ..parallel.agreement import on_root

__all__ = ["fsync_all", "require_room"]


def require_room(comm: MPI.Comm, path: Path, n_bytes: int, target: Path | None = None) -> None:
    """Check that the next write fits on the disk; a disk that fills up within HDF5 may damage the file.

    Rank 0 decides. Collective.

    Raises
    ------
    SimulationFailure
        On all ranks, if the file (or folder ``target``) is missing or fewer than ``n_bytes`` + 1 MiB are free.
    """

    def look() -> None:
        try:
            (target or path).stat()
            free = shutil.disk_usage(path.parent).free
        except OSError as error:
            raise SimulationFailure(
                f"{path}: gone or unreachable during the run ({os.strerror(error.errno)}); "
                "do not move or remove the output folder of a running simulation"
            ) from error
        needed = n_bytes + (1 << 20)
        if free < needed:
            raise SimulationFailure(
                f"{path}: disk full: {free / 1e6:.1f} MB are free, and the next write may take {needed / 1e6:.1f} MB. "
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

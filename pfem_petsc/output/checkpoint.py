"""Reads checkpoints, bit for bit and on any number of ranks; :mod:`.checkpoint_writer` writes them."""

from __future__ import annotations

import json
import time
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import h5py
import numpy as np
from mpi4py import MPI

from ..errors import InputError
from ..parallel.agreement import agreed, on_root
from ..parallel.natural import NaturalOrder
from .hdf5 import HDF5_ERRORS, first_line
from .integrity import check_seal, checksum, remedy

__all__ = [
    "asked_checkpoint",
    "Checkpoint",
    "OpenCheckpoint",
    "newest_checkpoint",
    "read_checkpoint",
    "read_checkpoint_header",
]

NAME, PREVIOUS = "checkpoint.h5", "checkpoint-previous.h5"

_ATTEMPTS = 20  # to open a file between two replacements


@dataclass(frozen=True)
class Checkpoint:
    """Contents of a checkpoint.

    Attributes
    ----------
    path : Path
    arrays : dict of name to this rank's owned rows (n_owned, ...), in the types in which they were written
    scalars : dict
        As written; float64 exact to the last bit.
    attributes : dict
    """

    path: Path
    arrays: dict[str, np.ndarray]
    scalars: dict[str, Any]
    attributes: dict[str, Any]


class OpenCheckpoint:
    """A checkpoint opened for reading: the same file on all ranks, unchanged between header and last array.

    Every rank opens the file once and reads it through that descriptor, even if a run replaces the checkpoint
    meanwhile. Construction is collective.

    Parameters
    ----------
    path : Path or str
    comm : MPI.Comm

    Attributes
    ----------
    scalars, attributes : dicts, as they were written
    digest : of everything except the values of the arrays, whose checksums are part of it

    Raises
    ------
    InputError
        On all ranks, if the file is missing, damaged, or of another version.
    """

    def __init__(self, path: Path | str, comm: MPI.Comm) -> None:
        self.path, self.comm = Path(path), comm
        self._raw: BinaryIO | None = None
        for attempt in range(_ATTEMPTS):
            with agreed(comm):
                self._raw = _open(self.path)
                mine = check_seal(self.path, self._raw)
            digests = comm.allgather(mine)
            if len(set(digests)) == 1:
                break
            # the file was replaced while the ranks opened it
            self.close()
            time.sleep(0.05 * (1 + attempt))
        else:
            raise InputError(
                f"{self.path}: is replaced repeatedly, or not the same file on all machines: wait until the run that "
                "writes it has ended"
            )
        self.digest = digests[0]
        self.scalars, self.attributes = on_root(comm, self._header)

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        raw, self._raw = self._raw, None
        if raw is not None:
            raw.close()

    def _header(self) -> tuple[dict[str, Any], dict[str, Any]]:
        with _sound(self.path), h5py.File(self._raw, "r") as file:
            state = file["state"][()]
            if zlib.crc32(state) != file["state"].attrs["checksum"]:
                raise InputError(f"{self.path}: damaged: its state does not match the checksum; {remedy(self.path)}")
        state = json.loads(state)
        return state["scalars"], state["attributes"]

    def read(self, orders: Mapping[str, NaturalOrder]) -> Checkpoint:
        """Read arrays, on any number of ranks. Collective.

        Parameters
        ----------
        orders : mapping of array name to the distribution of its rows over this run's ranks
            Selects the arrays; others in the file are ignored.

        Raises
        ------
        InputError
            On all ranks, if the file is damaged, lacks one of the arrays, or has another number of rows.
        """
        path = self.path
        slabs: dict[str, np.ndarray] = {}
        expected: dict[str, int] = {}
        # Reading needs no collective transfers: every rank reads its slab independently.
        with agreed(self.comm), _sound(path), h5py.File(self._raw, "r") as file:
            for name, order in orders.items():
                if name not in file["arrays"]:
                    known = ", ".join(sorted(file["arrays"])) or "none"
                    raise InputError(
                        f"{path}: has no array {name!r} (it has {known}): it belongs to another kind of run"
                    )
                dataset = file["arrays"][name]
                if len(dataset) != order.n_global:
                    raise InputError(
                        f"{path}: {name} has {len(dataset)} rows, the case needs {order.n_global}: it belongs to "
                        "another mesh; restart the case it was written by"
                    )
                slabs[name] = dataset[order.first : order.first + order.count]
                expected[name] = int(dataset.attrs["checksum"])
        for name, slab in slabs.items():
            if checksum(self.comm, slab, orders[name].first) != expected[name]:
                raise InputError(f"{path}: damaged: the values of {name} do not match their checksum; {remedy(path)}")
        arrays = {name: orders[name].from_slab(slab) for name, slab in slabs.items()}
        return Checkpoint(path, arrays, self.scalars, self.attributes)


def read_checkpoint(path: Path | str, comm: MPI.Comm, orders: Mapping[str, NaturalOrder]) -> Checkpoint:
    """Open, read and close a checkpoint; see :class:`OpenCheckpoint`. Collective."""
    file = OpenCheckpoint(path, comm)
    try:
        return file.read(orders)
    finally:
        file.close()


def read_checkpoint_header(path: Path | str, comm: MPI.Comm) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return scalars and attributes of a checkpoint on all ranks; raises as :class:`OpenCheckpoint`. Collective."""
    file = OpenCheckpoint(path, comm)
    file.close()
    return file.scalars, file.attributes


def newest_checkpoint(folder: Path | str) -> Path | None:
    """Return the newest checkpoint of an output folder, or None. Not collective."""
    for name in (NAME, PREVIOUS):
        if (Path(folder) / name).is_file():
            return Path(folder) / name
    return None


def asked_checkpoint(folder: Path | str, asked: bool | Path | str) -> Path | None:
    """The checkpoint of a restart: the newest of the output folder or of another one, or a file. On one rank.

    Raises
    ------
    InputError
        Another folder, without a checkpoint.
    """
    if asked is True:
        return newest_checkpoint(folder)
    path = Path(asked)
    if not path.is_dir():
        return path
    if (newest := newest_checkpoint(path)) is None:
        raise InputError(f"{path}: there is no checkpoint in this folder; name another, or start without --restart")
    return newest


def _open(path: Path) -> BinaryIO:
    for _ in range(_ATTEMPTS):
        try:
            if path.exists() and not path.is_file():
                raise InputError(f"{path}: is no file that a run has written; {remedy(path)}")
            return open(path, "rb")  # noqa: SIM115 - it stays open
        except FileNotFoundError:
            # a run may be between the two renamings of its next checkpoint
            if not path.with_name(PREVIOUS).exists() or path.name != NAME:
                break
            time.sleep(0.02)
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror}; {remedy(path)}") from error
    raise InputError(f"{path}: there is no such checkpoint; name an existing one, or start without --restart")


@contextmanager
def _sound(path: Path) -> Iterator[None]:
    try:
        yield
    except HDF5_ERRORS as error:
        raise InputError(f"{path}: not a checkpoint, or damaged: {first_line(error)}; {remedy(path)}") from error

"""Checkpoints in mesh numbering, bit for bit and for any number of ranks; at any time there is a complete one."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import time
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, Self

import h5py
import numpy as np
from mpi4py import MPI

from ..errors import InputError, SimulationFailure
from ..parallel.agreement import agreed
from ..parallel.natural import NaturalOrder
from .hdf5 import (
    HDF5_ERRORS,
    Growing,
    create_new,
    first_line,
    first_of_machine,
    fsync_all,
    open_shared,
    release,
    require_parallel_hdf5,
    require_room,
    set_text,
    writes_together,
    writing,
)
from .integrity import checksum

NAME, PREVIOUS = "checkpoint.h5", "checkpoint-previous.h5"
ORIGIN = "checkpoint-origin.h5"
"""The state that load cases start from."""

_FORMAT, _VERSION = "pfem_petsc checkpoint", 2
_HEAD = 512  # bytes before those of HDF5: format and version, which a file gets when it is complete
_ATTEMPTS = 20  # to open a file between two replacements


class Checkpoint:
    """A checkpoint opened for reading: the same file on all ranks, unchanged between header and last array.

    Every rank opens the file once and reads it through that descriptor, even if a run replaces the checkpoint
    meanwhile. Construction is collective.

    Parameters
    ----------
    path : Path or str
    comm : MPI.Comm

    Attributes
    ----------
    scalars, attributes : dicts, as they were written; float64 exact to the last bit
    digest : of everything except the values of the arrays, whose checksums are part of it; HDF5 has those of the rest

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
                state = self._state()
            self.digest = hashlib.sha256(state).hexdigest()
            if len(set(comm.allgather(self.digest))) == 1:
                break
            # the file was replaced while the ranks opened it
            self.close()
            time.sleep(0.05 * (1 + attempt))
        else:
            raise InputError(
                f"{self.path}: is replaced repeatedly, or not the same file on all machines: wait until the run that "
                "writes it has ended"
            )
        content = json.loads(state)
        self.scalars, self.attributes = content["scalars"], content["attributes"]
        self._checksums: dict[str, int] = content["checksums"]

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        raw, self._raw = self._raw, None
        if raw is not None:
            raw.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _state(self) -> bytes:
        """Return the text of all but the arrays, of a sound file. Not collective."""
        path = self.path
        with _sound(path):
            name, _, version = self._raw.read(_HEAD).split(b"\n")[0].decode(errors="replace").rpartition(" ")
        if name != _FORMAT:
            raise InputError(f"{path}: not a checkpoint of pfem_petsc, or damaged at its beginning; {_remedy(path)}")
        if version != str(_VERSION):
            raise InputError(
                f"{path}: has version {version} of the checkpoint format, this program reads {_VERSION}: restart with "
                f"the version of pfem_petsc that wrote it, or {_remedy(path)}"
            )
        with _sound(path), h5py.File(self._raw, "r") as file:
            state, expected = file["state"][()], file["state"].attrs["checksum"]
        if zlib.crc32(state) != expected:
            raise InputError(f"{path}: damaged: its state does not match the checksum; {_remedy(path)}")
        return state

    def read(self, orders: Mapping[str, NaturalOrder]) -> dict[str, np.ndarray]:
        """Return this rank's owned rows (n_owned, ...) of arrays, in the types of the file, by name, on any number of
        ranks. Collective.

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
        slabs = {}
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
        for name, slab in slabs.items():
            if checksum(self.comm, slab, orders[name].first) != self._checksums[name]:
                raise InputError(f"{path}: damaged: the values of {name} do not match their checksum; {_remedy(path)}")
        return {name: orders[name].from_slab(slab) for name, slab in slabs.items()}


def newest_checkpoint(folder: Path | str) -> Path | None:
    """Return the newest checkpoint of an output folder, or None. Not collective."""
    return next((path for path in (Path(folder, NAME), Path(folder, PREVIOUS)) if path.is_file()), None)


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


def _remedy(path: Path) -> str:
    """Return what a user can do without this checkpoint."""
    previous = path.with_name(f"{path.stem}-previous{path.suffix}")
    if previous.is_file():
        return f"restart from the one before: --restart {previous}"
    return "start without --restart"


def _open(path: Path) -> BinaryIO:
    for _ in range(_ATTEMPTS):
        try:
            if path.exists() and not path.is_file():
                raise InputError(f"{path}: is no file that a run has written; {_remedy(path)}")
            return open(path, "rb")  # noqa: SIM115 - it stays open
        except FileNotFoundError:
            # a run may be between the two renamings of its next checkpoint
            if not path.with_name(PREVIOUS).exists() or path.name != NAME:
                break
            time.sleep(0.02)
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror}; {_remedy(path)}") from error
    raise InputError(f"{path}: there is no such checkpoint; name an existing one, or start without --restart")


@contextmanager
def _sound(path: Path) -> Iterator[None]:
    try:
        yield
    except HDF5_ERRORS as error:
        raise InputError(f"{path}: not a checkpoint, or damaged: {first_line(error)}; {_remedy(path)}") from error


def write_checkpoint(
    path: Path | str,
    comm: MPI.Comm,
    arrays: Mapping[str, tuple[NaturalOrder, np.ndarray]],
    scalars: Mapping[str, Any],
    attributes: Mapping[str, Any],
) -> None:
    """Write a checkpoint such that at any time there is a complete one.

    The file is written under a temporary name, flushed to disk, and renamed; the previous checkpoint is kept as
    ``checkpoint-previous.h5``. Collective.

    Parameters
    ----------
    path : Path or str
        The file, usually ``checkpoint.h5``, in an existing folder.
    comm : MPI.Comm
    arrays : mapping of name to (order, owned rows (n_owned, ...))
        Numbers of 1, 2, 4 or 8 bytes.
    scalars, attributes : mappings
        Data that JSON can represent; the attributes describe the run (case, versions), the scalars are its state.

    Raises
    ------
    SimulationFailure
        On all ranks, for example if the disk is full or the folder is missing. Earlier checkpoints are kept.
    """
    require_parallel_hdf5(comm)
    path = Path(path)
    # sorted by name, because the memory of contact may be ordered differently on each rank
    slabs = {name: arrays[name][0].to_slab(np.asarray(arrays[name][1])) for name in sorted(arrays)}
    shapes = {name: ((arrays[name][0].n_global, *slab.shape[1:]), slab.dtype) for name, slab in slabs.items()}
    n_bytes = sum(dtype.itemsize * int(np.prod(shape, dtype=np.int64)) for shape, dtype in shapes.values())
    require_room(comm, path, n_bytes, target=path.parent)
    checks = {name: checksum(comm, slab, arrays[name][0].first) for name, slab in slabs.items()}
    content = {"scalars": dict(scalars), "attributes": dict(attributes), "checksums": checks}
    state = json.dumps(content, default=lambda value: value.tolist())  # of NumPy
    try:
        temporary = create_new(path, comm, _create, shapes, state, userblock_size=_HEAD)
    except InputError as error:
        raise SimulationFailure(f"{path}: no checkpoint could be written: {error}") from error

    together = writes_together(comm)
    with writing(comm, temporary):
        file = open_shared(temporary, comm)
    try:
        for name, slab in slabs.items():
            with writing(comm, temporary):
                Growing(file["arrays"][name]).write(arrays[name][0].first, slab, collective=together)
        with writing(comm, temporary):
            file.flush()
    except SimulationFailure:
        release(file, comm)
        if comm.rank == 0:
            temporary.unlink(missing_ok=True)
        raise
    first = first_of_machine(comm)
    with writing(comm, temporary):
        file.close()
        if first:  # a machine has one cache of the file
            fsync_all(temporary)
    with writing(comm, path):
        if comm.rank == 0:
            _put_in_place(temporary, path)


def _create(file: h5py.File, shapes: Mapping, state: str) -> None:
    set_text(file, "state", state)
    file["state"].attrs["checksum"] = zlib.crc32(state.encode())
    for name, (shape, dtype) in shapes.items():
        file.create_dataset(f"arrays/{name}", shape=shape, dtype=dtype)
    file.require_group("arrays")


def _put_in_place(temporary: Path, path: Path) -> None:
    with open(temporary, "r+b") as raw:
        raw.write(f"{_FORMAT} {_VERSION}\n".encode())
    fsync_all(temporary)
    if path.exists():
        os.replace(path, path.with_name(f"{path.stem}-previous{path.suffix}"))
    os.replace(temporary, path)
    # Some network file systems cannot sync folders; they do not delay their entries either.
    try:
        fsync_all(path.parent)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise

"""Writes checkpoints in mesh numbering; at any time there is a complete one."""

from __future__ import annotations

import errno
import json
import os
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from mpi4py import MPI

from ..errors import InputError, SimulationFailure
from ..parallel.natural import NaturalOrder
from .disk import fsync_all, require_room
from .hdf5 import (
    create_new,
    first_of_machine,
    open_shared,
    release,
    require_parallel_hdf5,
    set_text,
    write_rows,
    writes_together,
    writing,
)
from .integrity import checksum, seal, seal_size

__all__ = ["write_checkpoint"]


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
    state = json.dumps({"scalars": dict(scalars), "attributes": dict(attributes)}, default=_plain)
    try:
        temporary = create_new(path, comm, _create, shapes, checks, state, userblock_size=seal_size(len(shapes)))
    except InputError as error:
        raise SimulationFailure(f"{path}: no checkpoint could be written: {error}") from error

    together = writes_together(comm)
    with writing(comm, temporary):
        file = open_shared(temporary, comm)
    try:
        for name, slab in slabs.items():
            with writing(comm, temporary):
                write_rows(file["arrays"][name], arrays[name][0].first, slab, collective=together)
        with writing(comm, temporary):
            file.flush()
    except SimulationFailure:
        release(file, comm)
        if comm.rank == 0:
            temporary.unlink(missing_ok=True)
        raise
    with writing(comm, temporary):
        file.close()
    with writing(comm, temporary):
        if comm.rank == 0:
            seal(temporary)
    first = first_of_machine(comm)
    with writing(comm, temporary):
        if first:  # a machine has one cache of the file
            fsync_all(temporary)
    with writing(comm, path):
        if comm.rank == 0:
            _put_in_place(temporary, path)


def _create(file: h5py.File, shapes: Mapping, checks: Mapping[str, int], state: str) -> None:
    set_text(file, "state", state)
    file["state"].attrs["checksum"] = zlib.crc32(state.encode())
    group = file.create_group("arrays")
    for name, (shape, dtype) in shapes.items():
        group.create_dataset(name, shape=shape, dtype=dtype).attrs["checksum"] = np.uint64(checks[name])


def _put_in_place(temporary: Path, path: Path) -> None:
    if path.exists():
        os.replace(path, path.with_name(f"{path.stem}-previous{path.suffix}"))
    os.replace(temporary, path)
    # Some network file systems cannot sync folders; they do not delay their entries either.
    try:
        fsync_all(path.parent)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"a checkpoint cannot hold {type(value).__name__} {value!r}")

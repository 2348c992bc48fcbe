"""Modes in a result file: the group ``/modes``, created empty with the file and filled at the end of the run.

``eigenvalue`` (modes,), ``frequency`` [Hz] or ``load_factor`` (modes,), ``shape`` (modes, nodes, 3) in mesh numbering;
the attribute ``kind``. ``/checks/modes`` has one checksum per mode, written last; a mode without one is ignored.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import h5py
import numpy as np
from mpi4py import MPI

from .hdf5 import chunk_rows, create_growing, grow, set_unit, writing
from .integrity import CHECKS, numbers_digest, snapshot_digests, stored_digest, word_sum

if TYPE_CHECKING:
    from ..parallel.natural import NaturalOrder

__all__ = ["MODES", "NAMES", "complete_modes", "create_modes", "mode_damages", "prepare_modes", "write_modes"]

MODES = "modes"
NAMES = {"vibration": ("frequency", "Hz"), "buckling": ("load_factor", "")}
"""Name and unit of the numbers of each kind of modes."""


def create_modes(file: h5py.File, kind: str, n_nodes: int) -> None:
    """Create the group without modes, replacing an existing one. Not collective."""
    clear_modes(file)
    group = file.create_group(MODES)
    group.attrs.create("kind", kind.encode(), dtype=h5py.string_dtype("utf-8", len(kind)))
    name, unit = NAMES[kind]
    set_unit(create_growing(group, name, (), np.float64, 64), unit)
    set_unit(create_growing(group, "eigenvalue", (), np.float64, 64), "1/s²" if kind == "vibration" else "")
    _create_shape(group, n_nodes, "kg^-1/2" if kind == "vibration" else "")
    create_growing(file[CHECKS], MODES, (), np.uint64, 64)


def _create_shape(group: h5py.Group, n_nodes: int, unit: str) -> None:
    space = h5py.h5s.create_simple((0, n_nodes, 3), (h5py.h5s.UNLIMITED, n_nodes, 3))
    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    properties.set_chunk((1, chunk_rows(n_nodes, 24), 3))
    properties.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    kind = h5py.h5t.py_create(np.dtype(np.float64), logical=True)
    set_unit(h5py.Dataset(h5py.h5d.create(group.id, b"shape", kind, space, properties)), unit)


def clear_modes(file: h5py.File) -> None:
    """Remove the group if it exists. Not collective."""
    file.pop(MODES, None)
    file[CHECKS].pop(MODES, None)


def prepare_modes(path: Path, kind: str | None, n_nodes: int) -> None:
    """Prepare a file to be continued: an empty group of this kind, or no group for None. Not collective."""
    with h5py.File(path, "r+", locking=False) as file:
        if kind is not None:
            create_modes(file, kind, n_nodes)
        elif MODES in file:
            clear_modes(file)


def write_modes(
    file: h5py.File,
    comm: MPI.Comm,
    path: Path,
    order: NaturalOrder,
    eigenvalues: np.ndarray,
    values: np.ndarray,
    shapes: np.ndarray,
) -> None:
    """Write all modes, replacing existing ones. Collective.

    Parameters
    ----------
    file : open on all ranks, with the group
    comm, path : of the file
    order : of the nodes
    eigenvalues, values : (k,); ``values`` are frequencies or load factors
    shapes : (k, owned, 3)
    """
    group, checks = file[MODES], file[CHECKS][MODES]
    name = next(name for name, _ in NAMES.values() if name in group)
    n = len(eigenvalues)
    with writing(comm, path):
        for dataset in (group[name], group["eigenvalue"], group["shape"]):
            grow(dataset, n)
    digests = np.zeros(n, dtype=np.uint64)
    for k in range(n):
        slab = np.ascontiguousarray(order.to_slab(shapes[k]))
        total = snapshot_digests(comm, {"shape": word_sum(slab, order.first)})[0]
        digests[k] = total ^ np.uint64(numbers_digest(k, eigenvalues[k], values[k]))
        with writing(comm, path):
            _write_slab(group["shape"], k, order.first, slab, comm.size > 1)
    with writing(comm, path):
        if comm.rank == 0:
            group[name][:] = values
            group["eigenvalue"][:] = eigenvalues
        file.flush()
    with writing(comm, path):
        grow(checks, n)
        if comm.rank == 0:
            checks[:] = digests
        file.flush()


def _write_slab(dataset: h5py.Dataset, mode: int, first: int, slab: np.ndarray, collective: bool) -> None:
    transfer = h5py.h5p.create(h5py.h5p.DATASET_XFER)
    if collective:
        transfer.set_dxpl_mpio(h5py.h5fd.MPIO_COLLECTIVE)
    target = dataset.id.get_space()
    if len(slab):
        source = h5py.h5s.create_simple((1, *slab.shape))
        target.select_hyperslab((mode, first, 0), (1, *slab.shape))
    else:
        slab = np.empty((1, 3))
        source = h5py.h5s.create_simple((1, 1, 3))
        source.select_none()
        target.select_none()
    dataset.id.write(source, target, slab, dxpl=transfer)


def complete_modes(file: h5py.File) -> int:
    """Return the number of complete modes."""
    if MODES not in file or MODES not in file[CHECKS]:
        return 0
    return min(len(file[CHECKS][MODES]), *(len(dataset) for dataset in file[MODES].values()))


def mode_damages(file: h5py.File, deep: bool) -> Iterator[str]:
    """Yield one line for each defect of the modes."""
    n = complete_modes(file)
    if not n:
        return
    group = file[MODES]
    name = next(name for name, _ in NAMES.values() if name in group)
    values, eigenvalues, digests = group[name][:n], group["eigenvalue"][:n], file[CHECKS][MODES][:n]
    for k in range(n if deep else 0):
        total = np.uint64(stored_digest("shape", group["shape"][k]))
        if total ^ np.uint64(numbers_digest(k, eigenvalues[k], values[k])) != digests[k]:
            yield f"mode {k + 1} does not match its checksum"

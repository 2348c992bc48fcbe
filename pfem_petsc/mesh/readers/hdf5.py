"""The mesh file format of this package (.h5): HDF5, read and written by all ranks, each its slab.

``/points`` (n_nodes, 3) float [m], ``/bars`` (n_bars, 2) integers from 0, ``/node_groups/<name>`` and
``/bar_groups/<name>`` with the numbers of members, in any order; ``/bar_fields/<name>`` (n_bars,) float.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from ...errors import InputError
from ...parallel.agreement import agreed, on_root
from ..slab import MeshSlab, check_size, slab_range
from ..whole import WholeMesh
from . import missing_field
from ._shares import damaged, read_ends, route_members, share_of

__all__ = ["SUFFIXES", "read", "read_on", "write_hdf5"]

SUFFIXES = (".h5",)

# HDF5 filters compress real meshes by less than this; a dataset beyond it was never written.
_COMPRESSION = 1100


def read(path: Path, fields: Collection[str] | None = None) -> WholeMesh:
    """Return the mesh in an HDF5 file, with the named cell fields; None: with all.

    Raises
    ------
    InputError
        As :func:`read_on`.
    """
    if fields is None:
        sizes = _describe(path)
        with _opened(path) as file:
            fields = _fields(file, sizes[1])
    slab = read_on(path, MPI.COMM_SELF, dict.fromkeys(fields, "bar_fields"))
    return WholeMesh(slab.points, slab.bars, slab.node_groups, slab.bar_groups, slab.bar_fields)


def read_on(path: Path, comm: MPI.Comm, fields: Mapping[str, str] | None = None) -> MeshSlab:
    """Return this rank's slab of the mesh in an HDF5 file, with the named cell fields. Collective; no rank reads more
    than its part at a time.

    Raises
    ------
    InputError
        On all ranks, naming the dataset, if the file is not HDF5 or its datasets are not those of a mesh.
    """
    n_nodes, n_bars, node_names, bar_names = on_root(comm, _describe, path, fields)
    check_size(n_nodes, str(path))
    first_node, last_node = slab_range(n_nodes, comm.rank, comm.size)
    first_bar, last_bar = slab_range(n_bars, comm.rank, comm.size)
    # Every rank opens the file read-only: this needs no MPI driver, which a serial h5py lacks.
    with agreed(comm):
        file = _opened(path)
    with file:
        with agreed(comm), _told(path):
            slab = MeshSlab(
                n_nodes=n_nodes,
                n_bars=n_bars,
                first_node=first_node,
                points=share_of(file["points"], first_node, last_node),
                first_bar=first_bar,
                bars=read_ends(file["bars"], first_bar, last_bar, n_nodes),
                bar_fields={name: share_of(file["bar_fields"][name], first_bar, last_bar) for name in fields or {}},
                source=str(path),
            )
        for kind, names, n, groups in (
            ("node_groups", node_names, n_nodes, slab.node_groups),
            ("bar_groups", bar_names, n_bars, slab.bar_groups),
        ):
            for name in names:
                groups[name] = route_members(file[kind][name], n, comm, path)
    return slab


@contextmanager
def _told(path: Path) -> Iterator[None]:
    """Context that raises what HDF5 and NumPy raise for a damaged file as an InputError."""
    try:
        yield
    except MemoryError:
        raise InputError(f"{path}: the mesh does not fit in memory; use more ranks") from None
    except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
        raise InputError(damaged(path, error)) from None


def write_hdf5(path: Path, slab: MeshSlab, comm: MPI.Comm) -> None:
    """Write a mesh, each rank its slab. Collective; ranks write one after the other, which needs no MPI driver."""
    import h5py

    for rank in range(comm.size):
        if rank == comm.rank:
            with h5py.File(path, "w" if rank == 0 else "r+", locking=False) as file:
                if rank == 0:
                    file.create_dataset("points", (slab.n_nodes, 3), np.float64)
                    file.create_dataset("bars", (slab.n_bars, 2), slab.bars.dtype)
                    for kind, groups in (("node_groups", slab.node_groups), ("bar_groups", slab.bar_groups)):
                        for name in groups:
                            file.create_dataset(f"{kind}/{name}", (0,), np.int64, maxshape=(None,), chunks=(4096,))
                    for name in slab.bar_fields:
                        file.create_dataset(f"bar_fields/{name}", (slab.n_bars,), np.float64)
                file["points"][slab.first_node : slab.first_node + len(slab.points)] = slab.points
                file["bars"][slab.first_bar : slab.first_bar + len(slab.bars)] = slab.bars
                for name, values in slab.bar_fields.items():
                    file[f"bar_fields/{name}"][slab.first_bar : slab.first_bar + len(values)] = values
                for kind, groups in (("node_groups", slab.node_groups), ("bar_groups", slab.bar_groups)):
                    for name, members in groups.items():
                        dataset = file[f"{kind}/{name}"]
                        before = len(dataset)
                        dataset.resize((before + len(members),))
                        dataset[before:] = members
        comm.Barrier()


def _opened(path: Path) -> Any:
    import h5py

    try:
        return h5py.File(path, "r", locking=False)
    except (OSError, RuntimeError) as error:
        raise InputError(f"{path}: not a readable HDF5 file ({error})") from None


def _describe(path: Path, fields: Mapping[str, str] | None = None) -> tuple[int, int, list[str], list[str]]:
    """Check shape and type of every dataset; return sizes and names of groups."""
    import h5py

    with _opened(path) as file:
        try:
            counts = []
            for name, width, kinds, what in (("points", 3, "f", "floats"), ("bars", 2, "iu", "integers")):
                dataset = file.get(name)
                if not isinstance(dataset, h5py.Dataset):
                    raise InputError(f"{path}: no dataset /{name}; a mesh has /points (n, 3) and /bars (n, 2)")
                if dataset.ndim != 2 or dataset.shape[1] != width or dataset.dtype.kind not in kinds:
                    raise InputError(
                        f"{path}: /{name} has shape {dataset.shape} and type {dataset.dtype}; "
                        f"expected (n, {width}) {what}"
                    )
                # Unwritten datasets need no space in the file, so a small file can declare any size.
                stored, declared = dataset.id.get_storage_size(), prod(dataset.shape) * dataset.dtype.itemsize
                if declared > stored * (_COMPRESSION if dataset.chunks else 1):
                    raise InputError(f"{path}: /{name} declares {dataset.shape} values but holds {stored} bytes")
                counts.append(len(dataset))
            names = [_names(path, file, kind) for kind in ("node_groups", "bar_groups")]
            missing = missing_field(path, fields or {}, _fields(file, counts[1]))
            if missing is not None:
                raise InputError(missing)
        except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
            raise InputError(f"{path}: cannot be read ({error}); the file may be damaged: write it again") from None
    return counts[0], counts[1], names[0], names[1]


def _fields(file: Any, n_bars: int) -> list[str]:
    """Return the names of the cell fields."""
    import h5py

    group = file.get("bar_fields")
    if not isinstance(group, h5py.Group):
        return []
    sets = {name: group.get(name) for name in group}
    right = [name for name, data in sets.items() if isinstance(data, h5py.Dataset) and data.shape == (n_bars,)]
    return [name for name in right if sets[name].dtype.kind in "fiu"]


def _names(path: Path, file: Any, kind: str) -> list[str]:
    import h5py

    if kind not in file:
        return []
    if not isinstance(file[kind], h5py.Group):
        raise InputError(f"{path}: /{kind} is not a group of datasets")
    names = sorted(file[kind])
    for name in names:
        dataset = file[kind].get(name)
        if not isinstance(dataset, h5py.Dataset) or dataset.ndim != 1 or dataset.dtype.kind not in "iu":
            raise InputError(f"{path}: /{kind}/{name} is not a list of integers")
    return names

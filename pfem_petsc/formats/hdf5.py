"""The mesh file format of this package (.h5): HDF5, read by all ranks together, each its share.

``/points`` (n_nodes, 3) float [m], ``/bars`` (n_bars, 2) integers from 0, ``/node_groups/<name>`` and
``/bar_groups/<name>`` with the numbers of members, in any order; ``/bar_fields/<name>`` (n_bars,) and
``/node_fields/<name>`` (n_nodes,) float.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from ..errors import InputError
from ..mesh.exchange import Router
from ..mesh.slab import MeshSlab, check_memory, index_type, slab_of, slab_range
from ..mesh.whole import WholeMesh, check_fields, without_slashes
from ..parallel.agreement import agreed, on_root

SUFFIXES = (".h5",)

PIECE = 1 << 18
"""Number of rows that are read at a time, so that temporary arrays stay small."""

# HDF5 filters compress real meshes by less than this; a dataset beyond it was never written.
_COMPRESSION = 1100

_FAILURES = (OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError)
"""What h5py and NumPy raise for a damaged file."""


def read_on(path: Path, comm: MPI.Comm, fields: Mapping[str, str] | None = None) -> MeshSlab:
    """Return this rank's slab of the mesh in an HDF5 file, with the named fields; None: with all. Collective; no rank
    reads more than its part at a time.

    Raises
    ------
    InputError
        On all ranks, naming the dataset, if the file is not HDF5 or its datasets are not those of a mesh.
    """
    n_nodes, n_bars, groups, known = on_root(comm, _content, path, fields)
    check_memory(n_nodes, str(path))
    first_node, last_node = slab_range(n_nodes, comm.rank, comm.size)
    first, last = slab_range(n_bars, comm.rank, comm.size)
    slab = MeshSlab(n_nodes, n_bars, first_node, np.empty((0, 3)), first, np.empty((0, 2), int), source=str(path))
    wanted = {kind: [n for n in names if fields is None or n in fields] for kind, names in known.items()}
    # Every rank opens the file read-only: this needs no MPI driver, which a serial h5py lacks.
    with agreed(comm), _opened(path) as file:
        slab.points = _share_of(file["points"], first_node, last_node)
        slab.bars = np.empty((last - first, 2), index_type(n_nodes))
        limits = np.iinfo(slab.bars.dtype)
        for start, stop in _pieces(first, last):
            piece = file["bars"][start:stop]
            if piece.min() < limits.min or piece.max() > limits.max:
                piece = np.where((piece < 0) | (piece >= n_nodes), -1, piece)
            slab.bars[start - first : stop - first] = piece
        for kind, *share in (("bar_fields", first, last), ("node_fields", first_node, last_node)):
            setattr(slab, kind, {name: _share_of(file[f"{kind}/{name}"], *share) for name in wanted[kind]})
    for kind, n in (("node_groups", n_nodes), ("bar_groups", n_bars)):
        for name in groups[kind]:
            getattr(slab, kind)[name] = _members(path, f"{kind}/{name}", n, comm)
    return slab


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Context with a file open for reading, from which what is raised for a damaged file comes as an InputError."""
    import h5py

    try:
        file = h5py.File(path, "r", locking=False)
    except (OSError, RuntimeError) as error:
        raise InputError(f"{path}: not a readable HDF5 file ({error})") from None
    with file:
        try:
            yield file
        except MemoryError:
            raise InputError(f"{path}: the mesh does not fit in memory; use more ranks") from None
        except _FAILURES as error:
            raise InputError(f"{path}: cannot be read ({error}); the file may be damaged: write it again") from None


def _content(
    path: Path, fields: Mapping[str, str] | None
) -> tuple[int, int, dict[str, list[str]], dict[str, list[str]]]:
    """Check shape and type of every dataset, and that the fields are there; return the numbers of nodes and bars, and
    the names of groups and fields of both."""
    import h5py

    with _opened(path) as file:
        counts = []
        for name, width, kinds, what in (("points", 3, "f", "floats"), ("bars", 2, "iu", "integers")):
            dataset = file.get(name)
            if not isinstance(dataset, h5py.Dataset):
                raise InputError(f"{path}: no dataset /{name}; a mesh has /points (n, 3) and /bars (n, 2)")
            if dataset.ndim != 2 or dataset.shape[1] != width or dataset.dtype.kind not in kinds:
                raise InputError(
                    f"{path}: /{name} has shape {dataset.shape} and type {dataset.dtype}; expected (n, {width}) {what}"
                )
            # Unwritten datasets need no space in the file, so a small file can declare any size.
            stored, declared = dataset.id.get_storage_size(), prod(dataset.shape) * dataset.dtype.itemsize
            if declared > stored * (_COMPRESSION if dataset.chunks else 1):
                raise InputError(f"{path}: /{name} declares {dataset.shape} values but holds {stored} bytes")
            counts.append(len(dataset))
        groups: dict[str, list[str]] = {}
        for kind in ("node_groups", "bar_groups"):
            group = file[kind] if kind in file else None  # noqa: SIM401 - get() hides what is wrong
            if group is not None and not isinstance(group, h5py.Group):
                raise InputError(f"{path}: /{kind} is not a group of datasets")
            groups[kind] = sorted(group or ())
            for name in groups[kind]:
                dataset = group.get(name)
                if not isinstance(dataset, h5py.Dataset) or dataset.ndim != 1 or dataset.dtype.kind not in "iu":
                    raise InputError(f"{path}: /{kind}/{name} is not a list of integers")
        known = {}
        for kind, n in (("node_fields", counts[0]), ("bar_fields", counts[1])):
            group = file.get(kind)
            sets = {name: group.get(name) for name in group} if isinstance(group, h5py.Group) else {}
            fits = [name for name, data in sets.items() if isinstance(data, h5py.Dataset) and data.shape == (n,)]
            known[kind] = [name for name in fits if sets[name].dtype.kind in "fiu"]
    check_fields(path, fields, {*known["bar_fields"], *known["node_fields"]})
    return *counts, groups, known


def _pieces(first: int, last: int) -> Iterator[tuple[int, int]]:
    """Divide the range [first, last) into ranges of at most :data:`PIECE`."""
    for start in range(first, last, PIECE):
        yield start, min(start + PIECE, last)


def _share_of(dataset: Any, first: int, last: int) -> np.ndarray:
    """Return the rows [first, last) of a dataset as float64, without a second copy of them."""
    rows = np.empty((last - first, *dataset.shape[1:]))
    for start, stop in _pieces(first, last):
        rows[start - first : stop - first] = dataset[start:stop]
    return rows


def _members(path: Path, name: str, n: int, comm: MPI.Comm) -> np.ndarray:
    """Return the members of a group within this rank's range of ``n``, ascending: each rank reads its share of the
    dataset, which has all members in any order, and sends what it finds to the owners. Collective."""
    first, last = slab_range(n, comm.rank, comm.size)
    mask = np.zeros(last - first, bool)
    with agreed(comm), _opened(path) as file:
        total = len(file[name])
    begin, end = slab_range(total, comm.rank, comm.size)
    # all ranks take as many pieces as the one with most rows
    for start in range(begin, begin - (-total // comm.size), PIECE):
        with agreed(comm), _opened(path) as file:
            numbers = file[name][min(start, end) : min(start + PIECE, end)].astype(np.int64)
            for outside in numbers[(numbers < 0) | (numbers >= n)][:1]:
                raise InputError(f"{path}: /{name} has member {outside}, but numbers go from 0 to {n - 1}")
        mask[Router(comm, slab_of(numbers, n, comm.size)).send(numbers) - first] = True
    return first + np.flatnonzero(mask)


def write(path: Path, mesh: WholeMesh) -> None:
    """Write the mesh, exactly."""
    import h5py

    with h5py.File(path, "w", locking=False) as file:
        file["points"], file["bars"] = mesh.points, mesh.bars
        for kind in ("node_groups", "bar_groups", "bar_fields", "node_fields"):
            for name, values in without_slashes(getattr(mesh, kind)).items():
                file[f"{kind}/{name}"] = np.asarray(values, np.float64 if kind.endswith("fields") else np.int64)

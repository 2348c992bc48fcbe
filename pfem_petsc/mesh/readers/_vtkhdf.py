"""Files of VTK's HDF5 format that only hold lines; each rank reads its share; VTK reads all others.

Those are an UnstructuredGrid in one part, without steps, whose cells are lines of two points in the order of
``Connectivity``. Groups and bar fields are those of :mod:`.vtk`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mpi4py import MPI

from ...errors import InputError
from ..slab import MeshSlab, check_size, slab_range
from . import missing_field
from ._shares import Members, pieces, read_ends, share_of

__all__ = ["read_on"]

_LINE = 3
_NAMED = ("group", "section")  # arrays of numbers of groups, whose names are elsewhere
_MASK = "group:"
_FAILURES = (OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError)


class _Layout(NamedTuple):
    """What a file has: names of the arrays that mark groups, and of the fields of cells."""

    n_nodes: int
    n_bars: int
    node_masks: list[str]
    bar_masks: list[str]
    fields: list[str]


def read_on(path: Path, comm: MPI.Comm, fields: Mapping[str, str]) -> MeshSlab | None:
    """Return this rank's slab, with the named cell fields; None on all ranks for a file of another layout. Collective.

    Raises
    ------
    InputError
        On all ranks, if a field is missing, or there are too many nodes or too little memory.
    """
    layout = comm.bcast(_layout(path) if comm.rank == 0 else None)
    if layout is None:
        return None
    missing = missing_field(path, fields, layout.fields)
    if missing is not None:
        raise InputError(missing)
    check_size(layout.n_nodes, str(path))
    slab, fits = None, True
    try:
        slab = _share(path, comm, layout, list(fields))
    except MemoryError:
        fits = False
    except _FAILURES:
        pass  # VTK says what is wrong
    if not comm.allreduce(fits, op=MPI.LAND):
        raise InputError(f"{path}: the mesh does not fit in memory; use more ranks")
    return slab if comm.allreduce(slab is not None, op=MPI.LAND) else None


def _opened(path: Path) -> Any:
    import h5py

    return h5py.File(path, "r", locking=False)


def _layout(path: Path) -> _Layout | None:
    """Return what a file has; None if its layout is another."""
    try:
        with _opened(path) as file:
            root = file["VTKHDF"]
            kind = root.attrs["Type"]
            if (kind.decode() if isinstance(kind, bytes) else str(kind)) != "UnstructuredGrid" or "Steps" in root:
                return None
            sizes = [root[name][:].tolist() for name in ("NumberOfPoints", "NumberOfCells", "NumberOfConnectivityIds")]
            if [len(size) for size in sizes] != [1, 1, 1]:
                return None
            (n_nodes,), (n_bars,), (n_ends,) = sizes
            shapes = {"Points": (n_nodes, 3), "Connectivity": (n_ends,), "Offsets": (n_bars + 1,), "Types": (n_bars,)}
            whole = all(_holds(root[name], shape, "f" if name == "Points" else "iu") for name, shape in shapes.items())
            if not whole or n_ends != 2 * n_bars or not n_nodes or not n_bars:
                return None
            masks = []
            for kind, n in (("PointData", n_nodes), ("CellData", n_bars)):
                data = root.get(kind, {})
                if any(name in data for name in _NAMED):
                    return None
                masks.append([name for name in data if name.startswith(_MASK) and len(name) > len(_MASK)])
                if not all(_holds(data[name], (n,), "fiu") for name in masks[-1]):
                    return None
            cells = root.get("CellData", {})
            known = [name for name in cells if not name.startswith(_MASK) and cells[name].ndim == 1]
            if not all(_holds(cells[name], (n_bars,), "fiu") for name in known):
                return None
            return _Layout(n_nodes, n_bars, *masks, known)
    except _FAILURES:
        return None


def _holds(dataset: Any, shape: tuple[int, ...], kinds: str) -> bool:
    """Return whether a dataset has this shape, numbers of these kinds, and was written."""
    if dataset.shape != shape or dataset.dtype.kind not in kinds:
        return False
    return dataset.chunks is not None or dataset.id.get_storage_size() >= dataset.size * dataset.dtype.itemsize


def _share(path: Path, comm: MPI.Comm, layout: _Layout, fields: list[str]) -> MeshSlab | None:
    """Return this rank's slab; None if its cells are not all lines in order."""
    first_node, last_node = slab_range(layout.n_nodes, comm.rank, comm.size)
    first_bar, last_bar = slab_range(layout.n_bars, comm.rank, comm.size)
    with _opened(path) as file:
        root = file["VTKHDF"]
        for start, stop in pieces(first_bar, last_bar):
            in_order = np.array_equal(root["Offsets"][start : stop + 1], np.arange(2 * start, 2 * stop + 1, 2))
            if not in_order or not (root["Types"][start:stop] == _LINE).all():
                return None

        def groups(kind: str, names: list[str], first: int, last: int) -> dict[str, np.ndarray]:
            found = {}
            for name in names:
                members = Members(first, last)
                for start, stop in pieces(first, last):
                    members.add(start + np.flatnonzero(root[kind][name][start:stop]))
                found[name.removeprefix(_MASK)] = members.numbers()
            return found

        return MeshSlab(
            n_nodes=layout.n_nodes,
            n_bars=layout.n_bars,
            first_node=first_node,
            points=share_of(root["Points"], first_node, last_node),
            first_bar=first_bar,
            bars=read_ends(root["Connectivity"], first_bar, last_bar, layout.n_nodes),
            node_groups=groups("PointData", layout.node_masks, first_node, last_node),
            bar_groups=groups("CellData", layout.bar_masks, first_bar, last_bar),
            bar_fields={name: share_of(root["CellData"][name], first_bar, last_bar) for name in fields},
            source=str(path),
        )

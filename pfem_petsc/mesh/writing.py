"""A mesh from arrays, as a file that cases name."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from ..parallel.agreement import on_root
from .slab import MeshSlab

if TYPE_CHECKING:
    from mpi4py import MPI
    from numpy.typing import ArrayLike

__all__ = ["write_mesh"]

_SUFFIX = ".h5"


def write_mesh(
    path: Path | str,
    points: ArrayLike,
    bars: ArrayLike,
    *,
    node_groups: Mapping[str, ArrayLike] | None = None,
    bar_groups: Mapping[str, ArrayLike] | None = None,
    bar_fields: Mapping[str, ArrayLike] | None = None,
    comm: MPI.Comm | None = None,
) -> Path:
    """Write nodes and bars to an HDF5 file for ``mesh.file``; an earlier file of this name is replaced. Collective.

    Parameters
    ----------
    path : name of the file; ends in ``.h5``
    points : (nodes, 3) positions [m]
    bars : (bars, 2) integers, the nodes at the ends of each bar, numbered from 0
    node_groups, bar_groups : numbers of the members, or a boolean mask, for each name
    bar_fields : (bars,) numbers for each name, such as areas [m2] for ``area_field`` of sections
    comm : default: the world; its rank 0 writes its arrays

    Returns
    -------
    The absolute path.

    Raises
    ------
    InputError
        On all ranks, for arrays of wrong shape or type; a mesh that cannot be simulated (coordinates that are not
        finite, bars of zero length, two bars between the same nodes, nodes without bars); a file that cannot be
        written.
    """
    if comm is None:
        from mpi4py import MPI

        comm = MPI.COMM_WORLD
    return on_root(
        comm, _write, Path(path).absolute(), points, bars, node_groups or {}, bar_groups or {}, bar_fields or {}
    )


def _write(
    path: Path,
    points: ArrayLike,
    bars: ArrayLike,
    node_groups: Mapping[str, ArrayLike],
    bar_groups: Mapping[str, ArrayLike],
    bar_fields: Mapping[str, ArrayLike],
) -> Path:
    from mpi4py import MPI

    from .checks import check_mesh
    from .readers.hdf5 import write_hdf5

    if path.suffix != _SUFFIX:
        raise InputError(f"{path}: the name of a mesh file that is written from arrays ends in {_SUFFIX}")
    nodes, ends = _array(path, "points", points, 3, "fiu"), _array(path, "bars", bars, 2, "iu")
    slab = MeshSlab(
        n_nodes=len(nodes),
        n_bars=len(ends),
        first_node=0,
        points=nodes.astype(np.float64),
        first_bar=0,
        bars=ends.astype(np.int64),
        node_groups={name: _members(path, "node_groups", name, m, len(nodes)) for name, m in node_groups.items()},
        bar_groups={name: _members(path, "bar_groups", name, m, len(ends)) for name, m in bar_groups.items()},
        bar_fields={name: _field(path, name, values, len(ends)) for name, values in bar_fields.items()},
        source=str(path),
    )
    check_mesh(slab, MPI.COMM_SELF)
    new = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            write_hdf5(new, slab, MPI.COMM_SELF)
            os.replace(new, path)
        finally:
            new.unlink(missing_ok=True)
    except (OSError, RuntimeError) as error:
        raise InputError(f"{path}: cannot be written: {getattr(error, 'strerror', None) or error}") from error
    return path


def _array(path: Path, name: str, values: ArrayLike, width: int, kinds: str) -> np.ndarray:
    try:
        array = np.asarray(values)
    except ValueError:
        array = np.empty(0, object)  # rows of different lengths
    if array.ndim != 2 or array.shape[1] != width or array.dtype.kind not in kinds:
        what = "positions [m]" if name == "points" else "integers, the nodes at both ends"
        raise InputError(
            f"{path}: {name} has shape {array.shape} and type {array.dtype}; expected ({name}, {width}) {what}"
        )
    return array


def _field(path: Path, name: str, values: ArrayLike, n: int) -> np.ndarray:
    """Return the values of a cell field."""
    where = f"{path}: bar_fields[{name!r}]"
    _check_name(where, name)
    array = np.asarray(values)
    if array.shape != (n,) or array.dtype.kind not in "fiu":
        raise InputError(f"{where} has shape {array.shape} and type {array.dtype}; expected ({n},) numbers")
    return array.astype(np.float64)


def _check_name(where: str, name: str) -> None:
    if not isinstance(name, str) or not name or "/" in name or name == ".":
        raise InputError(f"{where}: expected a name without slashes")


def _members(path: Path, kind: str, name: str, values: ArrayLike, n: int) -> np.ndarray:
    """Return the numbers of the members of a group, ascending."""
    where = f"{path}: {kind}[{name!r}]"
    _check_name(where, name)
    array = np.asarray(values)
    if array.dtype.kind == "b" and array.shape == (n,):
        return np.flatnonzero(array)
    if array.size == 0:
        return np.empty(0, np.int64)
    if array.ndim != 1 or array.dtype.kind not in "iu":
        raise InputError(
            f"{where} has shape {array.shape} and type {array.dtype}; expected a list of numbers from 0, or ({n},) "
            "booleans"
        )
    wrong = array[(array < 0) | (array >= n)]
    if len(wrong):
        raise InputError(f"{where} has member {wrong[0]}, but numbers go from 0 to {n - 1}")
    return np.unique(array.astype(np.int64))

"""A mesh from arrays, as a file that cases name."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import InputError
from ..parallel.agreement import on_root
from .arrays import slab_from_arrays

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
    slab = slab_from_arrays(str(path), points, bars, node_groups, bar_groups, bar_fields)
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

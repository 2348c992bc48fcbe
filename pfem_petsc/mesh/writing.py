"""Mesh files from arrays."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from ..parallel.agreement import on_root
from .slab import slab_from_arrays

if TYPE_CHECKING:
    from mpi4py import MPI
    from numpy.typing import ArrayLike

__all__ = ["write_mesh"]


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
    """Write nodes and bars to a file for ``mesh.file``; an earlier file of this name is replaced. Collective.

    Parameters
    ----------
    path : name of the file; its suffix selects the format (``docs/meshes.md``); ``.h5`` stores everything exactly
    points : (nodes, 3) positions [m]
    bars : (bars, 2) integers, the nodes at both ends of each bar, numbered from 0
    node_groups, bar_groups : numbers of the members, or a boolean mask, for each name
    bar_fields : (bars,) numbers for each name, such as areas [m2] for ``area_field`` of sections
    comm : communicator whose rank 0 writes its arrays; default: COMM_WORLD

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

    from .whole import WholeMesh, check_mesh
    from .writers import write_whole, writer_name

    writer_name(path)
    slab = slab_from_arrays(str(path), points, bars, node_groups, bar_groups, bar_fields)
    check_mesh(slab, MPI.COMM_SELF)
    mesh = WholeMesh(slab.points, slab.bars, slab.node_groups, slab.bar_groups, slab.bar_fields)
    return write_whole(path, mesh)

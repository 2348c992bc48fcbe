"""The HDF5 format of this package (.h5): nodes, bars, groups and bar fields, exactly."""

from __future__ import annotations

from pathlib import Path

from mpi4py import MPI

from ..readers.hdf5 import write_hdf5
from ..slab import MeshSlab
from ..whole import WholeMesh, without_slashes

__all__ = ["SUFFIXES", "write"]

SUFFIXES = (".h5",)


def write(path: Path, mesh: WholeMesh) -> None:
    """Write the mesh."""
    slab = MeshSlab(
        n_nodes=len(mesh.points),
        n_bars=len(mesh.bars),
        first_node=0,
        points=mesh.points,
        first_bar=0,
        bars=mesh.bars,
        node_groups=without_slashes(mesh.node_groups),
        bar_groups=without_slashes(mesh.bar_groups),
        bar_fields=without_slashes(mesh.bar_fields),
    )
    write_hdf5(path, slab, MPI.COMM_SELF)

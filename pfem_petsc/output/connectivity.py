"""The mesh in a result file: the two nodes of each bar, written once."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import h5py
import numpy as np
from mpi4py import MPI

from .digests import CHECKS, mesh_digest
from .hdf5 import write_rows, writes_together, writing
from .integrity import word_sum

if TYPE_CHECKING:
    from ..mesh.distribution import DistributedMesh

__all__ = ["write_connectivity"]

_PIECE = 2**18  # number of bars whose connectivity is written at once on one rank


def write_connectivity(file: h5py.File, comm: MPI.Comm, path: Path, mesh: DistributedMesh) -> None:
    """Write the ends of all bars in mesh numbering, their offsets, and the digest of the mesh. Collective.

    Bars that are evaluated on two ranks are written by the rank that counts them.
    """
    vtk, order = file["VTKHDF"], mesh.bar_order
    first, count, together = order.first, order.count, writes_together(comm)
    # one rank may have all bars: pieces keep the working arrays small
    piece = count if comm.size > 1 else min(count, _PIECE)
    total = 0
    for start in range(0, max(count, 1), max(piece, 1)):
        stop = min(start + piece, count)
        if comm.size > 1:
            ends = order.to_slab(mesh.node_ids[mesh.bars[mesh.counted]].astype(np.int64).reshape(-1, 2))
        else:
            ends = mesh.node_ids[mesh.bars[order.owned_rows(start, stop)]].astype(np.int64)
        total += word_sum(ends.ravel(), 2 * (first + start))
        with writing(comm, path):
            write_rows(vtk["Connectivity"], 2 * (first + start), ends.ravel(), collective=together)
        # there is one more offset than bars, which the last rank writes
        end = first + stop + (stop == count and comm.rank == comm.size - 1)
        with writing(comm, path):
            write_rows(vtk["Offsets"], first + start, 2 * np.arange(first + start, end), collective=together)
    digest = mesh_digest(comm, total & (2**64 - 1))
    with writing(comm, path):
        if comm.rank == 0:
            write_rows(file[CHECKS]["mesh"], 0, digest)
        file.flush()

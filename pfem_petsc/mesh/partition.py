"""Partition of the nodes over ranks."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from ..errors import InputError
from .exchange import Router
from .ordering import BITS, hilbert_keys
from .slab import MeshSlab, slab_of

__all__ = ["PARTITIONERS", "bounding_cube", "partition"]

PARTITIONERS = ("auto", "ptscotch", "coordinates")

# Candidate positions tested at once for each border between two ranks.
_CANDIDATES = 256


def partition(slab: MeshSlab, comm: MPI.Comm, partitioner: str = "auto") -> tuple[np.ndarray, str]:
    """Compute the owner of every node of this rank's slab. Collective.

    Parameters
    ----------
    slab : MeshSlab
    comm : MPI.Comm
    partitioner : str
        ``"ptscotch"`` cuts few bars (PETSc must have been built with it); ``"coordinates"`` divides a space-filling
        curve into equal parts, independent of the slabs; ``"auto"`` uses the second for structured meshes and if PETSc
        lacks PT-Scotch. Both are reproducible from run to run; ``"ptscotch"`` uses random numbers that continue from
        call to call, so a second call in one process may differ.

    Returns
    -------
    owners : (nodes of the slab,) int32
    used : str
        The partitioner used, for the log.
    """
    if partitioner not in PARTITIONERS:
        raise InputError(f"partitioner: unknown value {partitioner!r}; known: {', '.join(PARTITIONERS)}")
    if comm.size == 1:
        return np.zeros(len(slab.points), np.int32), "none (one rank)"
    if partitioner == "ptscotch" or (partitioner == "auto" and not slab.structured):
        owners = _by_graph(slab, comm)
        if owners is not None:
            return owners, "ptscotch"
        if partitioner == "ptscotch":
            raise InputError("partitioner: this PETSc was built without PT-Scotch; use 'coordinates'")
    return _by_coordinates(slab, comm), "coordinates"


def bounding_cube(points: np.ndarray, comm: MPI.Comm) -> tuple[np.ndarray, float]:
    """Return the lowest corner (3,) [m] and largest extent [m] of the points of all ranks. Collective."""
    box = np.full((2, 3), np.inf)
    if len(points):
        box[0], box[1] = points.min(axis=0), -points.max(axis=0)
    comm.Allreduce(MPI.IN_PLACE, box, op=MPI.MIN)
    return box[0], float((-box[1] - box[0]).max())


def _by_coordinates(slab: MeshSlab, comm: MPI.Comm) -> np.ndarray:
    """Divide the Hilbert curve through the nodes such that ranks have equal numbers of nodes.

    The borders are found by counting keys below candidate positions, refined around each border, so the result depends
    on the nodes and the number of ranks only.
    """
    keys = hilbert_keys(slab.points, *bounding_cube(slab.points, comm))
    in_order = np.sort(keys)
    wanted = (slab.n_nodes * np.arange(1, comm.size)) // comm.size
    # Invariant: fewer keys than required lie below `low`, at least as many below `high`.
    low = np.zeros(comm.size - 1, np.uint64)
    width = 1 << (3 * BITS)
    while width > 1:
        step = max(width // _CANDIDATES, 1)
        candidates = low[:, None] + np.uint64(step) * np.arange(1, _CANDIDATES + 1, dtype=np.uint64)
        below = np.searchsorted(in_order, candidates.ravel(), side="left").reshape(candidates.shape)
        below = below.astype(np.int64)
        comm.Allreduce(MPI.IN_PLACE, below, op=MPI.SUM)
        low += np.uint64(step) * (below < wanted[:, None]).sum(axis=1).astype(np.uint64)
        width = step
    return np.searchsorted(low, keys, side="left").astype(np.int32)


def _by_graph(slab: MeshSlab, comm: MPI.Comm) -> np.ndarray | None:
    """Partition the graph of nodes and bars by PT-Scotch; None if PETSc lacks it (equal on all ranks)."""
    from petsc4py import PETSc

    tool = PETSc.MatPartitioning().create(comm)
    owners = PETSc.IS()
    graph = PETSc.Mat()
    try:
        try:
            tool.setType("ptscotch")
        except PETSc.Error as error:
            if error.ierr != 86:  # PETSC_ERR_UNKNOWN_TYPE
                raise
            return None
        rows, columns = _adjacency(slab, comm)
        n = len(slab.points)
        graph.createAIJ(((n, slab.n_nodes), (n, slab.n_nodes)), csr=(rows, columns, np.ones(len(columns))), comm=comm)
        tool.setAdjacency(graph)
        tool.apply(owners)
        return owners.indices.astype(np.int32)
    finally:
        owners.destroy()
        tool.destroy()
        graph.destroy()


def _adjacency(slab: MeshSlab, comm: MPI.Comm) -> tuple[np.ndarray, np.ndarray]:
    """Return the neighbours of every node of the slab, ascending and unique, as row starts and columns."""
    from petsc4py import PETSc

    ends = np.concatenate([slab.bars, slab.bars[:, ::-1]]).astype(np.int64)
    router = Router(comm, slab_of(ends[:, 0], slab.n_nodes, comm.size))
    ends = router.send(ends)
    pairs = np.unique((ends[:, 0] - slab.first_node) * slab.n_nodes + ends[:, 1])
    node, neighbour = np.divmod(pairs, slab.n_nodes)
    rows = np.zeros(len(slab.points) + 1, PETSc.IntType)
    rows[1:] = np.cumsum(np.bincount(node, minlength=len(slab.points)))
    return rows, neighbour.astype(PETSc.IntType)

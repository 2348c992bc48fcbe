"""Partition of the nodes over ranks."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from ..errors import InputError
from .exchange import Router
from .ordering import BITS, hilbert_keys
from .slab import MeshSlab, slab_of

__all__ = ["PARTITIONERS", "UNEVEN", "bounding_box", "bounding_cube", "partition"]

PARTITIONERS = ("auto", "ptscotch", "coordinates")

UNEVEN = 1.1
"""Ratio of the largest to the mean work of the ranks that the partitioner ``"auto"`` accepts."""

_OF_NODE = 4  # work of a node in an explicit step, where that of a bar is 2

# Candidate positions tested at once for each border between two ranks.
_CANDIDATES = 256

_PIECE = 1 << 18  # number of bars whose ends are sent at a time, to keep temporary arrays small


def partition(slab: MeshSlab, comm: MPI.Comm, partitioner: str = "auto") -> tuple[np.ndarray, str]:
    """Compute the owner of every node of this rank's slab. Collective.

    Parameters
    ----------
    slab : MeshSlab
    comm : MPI.Comm
    partitioner : str
        ``"ptscotch"`` cuts few bars (PETSc must have been built with it), for equal numbers of nodes;
        ``"coordinates"`` divides a space-filling curve into parts of equal work, independent of the slabs; ``"auto"``
        uses the second for structured meshes, if PETSc lacks PT-Scotch, and if a rank would have over :data:`UNEVEN`
        times the mean work, because nodes have very different numbers of bars. Both are reproducible from run to run;
        ``"ptscotch"`` uses random numbers that continue from call to call, so a second call in one process may differ.

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
        if owners is not None and (partitioner == "ptscotch" or _is_even(owners, slab, comm)):
            return owners, "ptscotch"
        if partitioner == "ptscotch":
            raise InputError("partitioner: this PETSc was built without PT-Scotch; use 'coordinates'")
    return _by_coordinates(slab, _works(slab, comm), comm), "coordinates"


def bounding_box(points: np.ndarray, comm: MPI.Comm) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest corners (3,) [m] of the box around the points of all ranks. Collective."""
    box = np.full((2, 3), np.inf)
    if len(points):
        box[0], box[1] = points.min(axis=0), -points.max(axis=0)
    comm.Allreduce(MPI.IN_PLACE, box, op=MPI.MIN)
    return box[0], -box[1]


def bounding_cube(points: np.ndarray, comm: MPI.Comm) -> tuple[np.ndarray, float]:
    """Return the lowest corner (3,) [m] and largest extent [m] of the points of all ranks. Collective."""
    low, high = bounding_box(points, comm)
    return low, float((high - low).max())


def _works(slab: MeshSlab, comm: MPI.Comm) -> np.ndarray:
    """Return the work of a step for each node of the slab (int64), in halves of that for a bar. Collective."""
    works = np.full(len(slab.points), _OF_NODE, np.int64)
    # all ranks take as many pieces as the one with most bars
    for start in range(0, -(-slab.n_bars // comm.size), _PIECE):
        ends = slab.bars[start : start + _PIECE].reshape(-1)
        ends = Router(comm, slab_of(ends, slab.n_nodes, comm.size)).send(ends)
        works += np.bincount(ends - slab.first_node, minlength=len(slab.points))
    return works


def _is_even(owners: np.ndarray, slab: MeshSlab, comm: MPI.Comm) -> bool:
    """Return whether the ranks have about the same work. Collective."""
    shares = np.bincount(owners, weights=_works(slab, comm), minlength=comm.size)
    comm.Allreduce(MPI.IN_PLACE, shares)
    return bool(shares.max() <= UNEVEN * shares.mean())


def _by_coordinates(slab: MeshSlab, works: np.ndarray, comm: MPI.Comm) -> np.ndarray:
    """Divide the Hilbert curve through the nodes such that ranks have equal ``works``, integers.

    The borders are found by summing works below candidate positions, refined around each border, so the result depends
    on the nodes, their works and the number of ranks only.
    """
    keys = hilbert_keys(slab.points, *bounding_cube(slab.points, comm))
    order = np.argsort(keys)
    in_order, sums = keys[order], np.concatenate([[0], np.cumsum(works[order])])
    wanted = (comm.allreduce(int(sums[-1])) * np.arange(1, comm.size)) // comm.size
    # Invariant: less work than required lies below `low`, at least as much below `high`.
    low = np.zeros(comm.size - 1, np.uint64)
    width = 1 << (3 * BITS)
    while width > 1:
        step = max(width // _CANDIDATES, 1)
        candidates = low[:, None] + np.uint64(step) * np.arange(1, _CANDIDATES + 1, dtype=np.uint64)
        below = sums[np.searchsorted(in_order, candidates.ravel(), side="left")].reshape(candidates.shape)
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

    parts = []
    # all ranks take as many pieces as the one with most bars
    for start in range(0, -(-slab.n_bars // comm.size), _PIECE):
        bars = slab.bars[start : start + _PIECE]
        ends = np.concatenate([bars, bars[:, ::-1]]).astype(np.int64)
        ends = Router(comm, slab_of(ends[:, 0], slab.n_nodes, comm.size)).send(ends)
        parts.append((ends[:, 0] - slab.first_node) * slab.n_nodes + ends[:, 1])
    pairs = np.concatenate([np.empty(0, np.int64), *parts])
    del parts
    pairs.sort()
    if len(pairs):
        pairs = pairs[np.append(True, pairs[1:] != pairs[:-1])]
    node, neighbour = np.divmod(pairs, slab.n_nodes)
    del pairs
    rows = np.zeros(len(slab.points) + 1, PETSc.IntType)
    rows[1:] = np.cumsum(np.bincount(node, minlength=len(slab.points)))
    return rows, neighbour.astype(PETSc.IntType)

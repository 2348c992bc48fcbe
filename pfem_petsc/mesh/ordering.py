"""The order of nodes and bars in memory, and the partition of a mesh over ranks."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from mpi4py import MPI

from .exchange import Router
from .slab import MeshSlab, slab_of

BITS = 21
"""Bits of each coordinate in a key: three times this fits in 64 bits."""

NODE_BLOCK = 512
"""Number of nodes whose bars and node loops follow each other, so that their data stay in the cache."""

LEAST_RUN = 8
"""Mean number of bars of the runs of constant offset from which a block goes by these: shorter loops do not pay."""

FEW = 0.15
"""Share of the bars whose runs may be shorter, so that all are in the order of the others."""

_PLANES = 4
"""Maximum number of planes of nodes, as a multiple of those of a cubic grid with as many nodes."""

_LONGER = 1.5
"""Ratio of extents from which rows are along the longer one, whatever the order of the axes."""

_STEPS = 1 << 20
"""Planes closer together than this part of the extent count as one."""

# Number of points processed at a time, so that temporary arrays stay in the cache.
_PIECE = 1 << 15

_BARS = 1 << 18  # bars sorted at a time, to keep temporary arrays small


def hilbert_keys(points: np.ndarray, low: np.ndarray, extent: float) -> np.ndarray:
    """Return the positions of points along the Hilbert curve through the cube that starts at ``low``.

    Parameters
    ----------
    points : (n, 3) float64 [m]
    low : (3,) float64 [m]
        Lowest corner of the points of the whole mesh.
    extent : float [m]
        Edge of the cube: the largest extent of the whole mesh.

    Returns
    -------
    keys : (n,) uint64

    Notes
    -----
    J. Skilling, "Programming the Hilbert curve", AIP Conf. Proc. 707 (2004), 381-387.
    """
    keys = np.empty(len(points), np.uint64)
    # The last cell is closed at its upper end; a mesh of zero extent (a single node) is in one cell.
    scale = ((1 << BITS) - 0.5) / extent if extent > 0.0 else 0.0
    for first in range(0, len(points), _PIECE):
        piece = slice(first, first + _PIECE)
        cells = ((points[piece] - low) * scale).astype(np.uint32)
        keys[piece] = _hilbert([np.ascontiguousarray(cells[:, axis]) for axis in range(3)])
    return keys


def _hilbert(x: list[np.ndarray]) -> np.ndarray:
    """Apply Skilling's transform of cell coordinates (three arrays of uint32, changed in place) to positions."""
    for bit in range(BITS - 1, 0, -1):
        q = np.uint32(1 << bit)
        lower = np.uint32((1 << bit) - 1)
        for axis in range(3):
            # Where the bit is set, invert the lower bits of x; elsewhere exchange them with those of this axis.
            is_set = (x[axis] & q) != 0
            exchanged = np.where(is_set, np.uint32(0), (x[0] ^ x[axis]) & lower)
            x[0] ^= np.where(is_set, lower, exchanged)
            x[axis] ^= exchanged
    x[1] ^= x[0]
    x[2] ^= x[1]
    twist = np.zeros_like(x[0])
    for bit in range(BITS - 1, 0, -1):
        twist ^= np.where((x[2] & np.uint32(1 << bit)) != 0, np.uint32((1 << bit) - 1), np.uint32(0))
    keys = np.zeros(len(x[0]), np.uint64)
    for axis in range(3):
        keys |= _spread(x[axis] ^ twist) << np.uint64(2 - axis)
    return keys


def _spread(x: np.ndarray) -> np.ndarray:
    """Insert two zero bits between the bits of 21-bit numbers."""
    x = x.astype(np.uint64)
    for shift, mask in (
        (32, 0x001F00000000FFFF),
        (16, 0x001F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        x = (x | (x << np.uint64(shift))) & np.uint64(mask)
    return x


def sweep_axes(low: np.ndarray, high: np.ndarray) -> tuple[int, ...]:
    """Return the axes of a sweep through the box from ``low`` to ``high`` (3,): across layers, across rows, along rows.

    Layers across the longest extent have the fewest nodes; rows along the longer extent of a layer have the most.
    """
    extents = high - low
    layers, middle, rows = (int(axis) for axis in np.argsort(-extents, kind="stable"))
    if extents[middle] > _LONGER * extents[rows]:
        middle, rows = rows, middle
    return layers, middle, rows


def sweep_keys(points: np.ndarray, axes: tuple[int, ...] | None = None) -> np.ndarray:
    """Return the positions of points in a sweep, layer by layer, and row by row in a layer.

    Along axes on which the nodes lie in few planes, as those of lattices, layers and rows are these planes; the nodes
    of a row then repeat with the cells, and so do the differences between the numbers of both ends of bars. Along other
    axes they are about one node spacing wide, so that the bars of a node extend over two layers only.

    Parameters
    ----------
    points : (n, 3) float64 [m]
    axes : see :func:`sweep_axes`; None: of the points. Where parts of a mesh have the same axes, the nodes on both
        sides of their borders are in the same order

    Returns
    -------
    keys : (n,) int64
    """
    if len(points) == 0:
        return np.empty(0, np.int64)
    low, high = points.min(axis=0), points.max(axis=0)
    extents = high - low
    spacing = _spacing(extents, len(points))
    keys = np.zeros(len(points), np.int64)
    for axis in sweep_axes(low, high) if axes is None else axes:
        if extents[axis] > 0.0:
            rows = int(extents[axis] / spacing + 0.5) + 1
            planes = _planes(points[:, axis], float(low[axis]), float(extents[axis]), _PLANES * rows)
            if planes is None:
                # Nodes of a regular lattice lie at the centres of cells, not on their borders.
                planes = ((points[:, axis] - low[axis]) / spacing + 0.5).astype(np.int64)
                keys *= rows
            else:
                keys *= int(planes.max()) + 1
            keys += planes
    return keys


def _planes(x: np.ndarray, low: float, extent: float, most: int) -> np.ndarray | None:
    """Return the numbers of the planes of coordinates, in ascending order, or None if there are more than ``most``."""
    used = np.zeros(_STEPS + 1, dtype=bool)
    scale = _STEPS / extent
    for first in range(0, len(x), _PIECE):
        used[np.rint((x[first : first + _PIECE] - low) * scale).astype(np.int64)] = True
    begins = used.copy()
    begins[1:] &= ~used[:-1]  # rounding may divide a plane between two steps
    number = np.cumsum(begins) - 1
    if number[-1] >= most:
        return None
    return number[np.rint((x - low) * scale).astype(np.int64)]


def _spacing(extents: np.ndarray, n: int) -> float:
    """Return the spacing [m] of a grid of these extents with ``n`` nodes: the product of extent / spacing + 1 is n."""
    high = float(extents.max())
    if n == 1 or high == 0.0:
        return 1.0
    low = high / n
    for _ in range(60):
        middle = low**0.5 * high**0.5
        low, high = (middle, high) if np.prod(extents / middle + 1.0) > n else (low, middle)
    return high


def bar_order(bars: np.ndarray, group: np.ndarray | None, n_local: int) -> np.ndarray:
    """Return the order (indices) of bars by group and block of nodes of the lower local end.

    In a block bars are in order of the offset between both ends, then of the lower end, if many have the same offset,
    else in order of the lower, then of the higher end; if few bars of the rank are in such blocks, all are in the first
    order.

    Parameters
    ----------
    bars : (b, 2) int32
        Local ends.
    group : (b,) small int, or None for a single group
        Sorted before locality: section, counted or not.
    n_local : int
        Number of local nodes.
    """
    block = np.minimum(bars[:, 0], bars[:, 1])
    block //= NODE_BLOCK
    if group is not None:
        blocks = n_local // NODE_BLOCK + 1
        wide = np.int32 if (int(group.max(initial=0)) + 1) * blocks < 1 << 31 else np.int64
        block = block.astype(wide, copy=False)
        block += group.astype(wide, copy=False) * wide(blocks)
    order = np.argsort(block, kind="stable").astype(np.int32 if len(bars) < 1 << 31 else np.int64)
    block = block[order]
    irregular, short = 0, []
    for first, last in _pieces(block):
        rows = order[first:last]
        number, low, offset = _places(bars[rows], block[first:last])
        key = (number * n_local + offset) * NODE_BLOCK + low
        place = np.argsort(key, kind="stable")
        order[first:last] = rows[place]
        scattered = _scattered(key[place], number, LEAST_RUN)
        irregular += np.count_nonzero(np.isin(number, scattered))
        short += [(first, last, scattered)] * bool(len(scattered))
    if irregular <= FEW * len(bars):
        return order
    for first, last, scattered in short:
        rows = order[first:last]
        number, low, offset = _places(bars[rows], block[first:last])
        stars = np.isin(number, scattered)
        major, minor = np.where(stars, low, offset), np.where(stars, offset, low)
        order[first:last] = rows[np.lexsort((minor, major, number))]
    return order


def _pieces(block: np.ndarray) -> Iterator[tuple[int, int]]:
    """Yield ranges [first, last) of the sorted ``block`` (b,): whole blocks of about :data:`_BARS` bars, or one."""
    first = 0
    while first < len(block):
        last = len(block)
        if first + _BARS < last:
            last = int(np.searchsorted(block, block[first + _BARS], side="left"))
            last = last if last > first else int(np.searchsorted(block, block[first], side="right"))
        yield first, last
        first = last


def _places(bars: np.ndarray, block: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return consecutive numbers of the sorted ``block`` (b,) of bars, their lower ends in it, and the offsets of their
    ends."""
    low, high = bars.min(axis=1).astype(np.int64), bars.max(axis=1)
    return np.cumsum(np.diff(block, prepend=block[:1]) != 0), low % NODE_BLOCK, high - low


def _scattered(key: np.ndarray, block: np.ndarray, least: float) -> np.ndarray:
    """Return the blocks whose runs of constant offset have fewer than ``least`` bars on average; all keys sorted."""
    fresh = np.diff(key, prepend=-2) != 1
    return np.flatnonzero(np.bincount(block) < least * np.bincount(block[fresh], minlength=block[-1] + 1))


UNEVEN = 1.1
"""Ratio of the largest to the mean work of the ranks that is accepted of PT-Scotch."""

_OF_NODE = 4  # work of a node in an explicit step, where that of a bar is 2

# Candidate positions tested at once for each border between two ranks.
_CANDIDATES = 256

_BARS_SENT = 1 << 18  # number of bars whose ends are sent at a time, to keep temporary arrays small


def partition(slab: MeshSlab, comm: MPI.Comm) -> tuple[np.ndarray, str]:
    """Compute the owner of every node of this rank's slab. Collective.

    PT-Scotch cuts few bars, for equal numbers of nodes. A space-filling curve through the nodes divided into parts of
    equal work, independent of the slabs, serves structured meshes, a PETSc without PT-Scotch, and meshes of which a
    rank would have over :data:`UNEVEN` times the mean work, because nodes have very different numbers of bars. Both are
    reproducible from run to run; PT-Scotch uses random numbers that continue from call to call, so a second call in one
    process may differ.

    Returns
    -------
    owners : (nodes of the slab,) int32
    used : str
        ``"ptscotch"``, ``"coordinates"`` or ``"none (one rank)"``, for the log.
    """
    if comm.size == 1:
        return np.zeros(len(slab.points), np.int32), "none (one rank)"
    works = _works(slab, comm)
    owners = None if slab.structured else _by_graph(slab, comm)
    if owners is not None:
        shares = np.bincount(owners, weights=works, minlength=comm.size)
        comm.Allreduce(MPI.IN_PLACE, shares)
        if shares.max() <= UNEVEN * shares.mean():
            return owners, "ptscotch"
    return _by_coordinates(slab, works, comm), "coordinates"


def bounding_box(points: np.ndarray, comm: MPI.Comm) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest corners (3,) [m] of the box around the points of all ranks. Collective."""
    box = np.stack([points.min(axis=0, initial=np.inf), -points.max(axis=0, initial=-np.inf)])
    comm.Allreduce(MPI.IN_PLACE, box, op=MPI.MIN)
    return box[0], -box[1]


def _works(slab: MeshSlab, comm: MPI.Comm) -> np.ndarray:
    """Return the work of a step for each node of the slab (int64), in halves of that for a bar. Collective."""
    works = np.full(len(slab.points), _OF_NODE, np.int64)
    # all ranks take as many pieces as the one with most bars
    for start in range(0, -(-slab.n_bars // comm.size), _BARS_SENT):
        ends = slab.bars[start : start + _BARS_SENT].reshape(-1)
        ends = Router(comm, slab_of(ends, slab.n_nodes, comm.size)).send(ends)
        works += np.bincount(ends - slab.first_node, minlength=len(slab.points))
    return works


def _by_coordinates(slab: MeshSlab, works: np.ndarray, comm: MPI.Comm) -> np.ndarray:
    """Divide the Hilbert curve through the nodes such that ranks have equal ``works``, integers.

    The borders are found by summing works below candidate positions, refined around each border, so the result depends
    on the nodes, their works and the number of ranks only.
    """
    low, high = bounding_box(slab.points, comm)
    keys = hilbert_keys(slab.points, low, float((high - low).max()))
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
    for start in range(0, -(-slab.n_bars // comm.size), _BARS_SENT):
        bars = slab.bars[start : start + _BARS_SENT]
        ends = np.concatenate([bars, bars[:, ::-1]]).astype(np.int64)
        ends = Router(comm, slab_of(ends[:, 0], slab.n_nodes, comm.size)).send(ends)
        parts.append((ends[:, 0] - slab.first_node) * slab.n_nodes + ends[:, 1])
    node, neighbour = np.divmod(np.unique(np.concatenate([np.empty(0, np.int64), *parts])), slab.n_nodes)
    rows = np.zeros(len(slab.points) + 1, PETSc.IntType)
    rows[1:] = np.cumsum(np.bincount(node, minlength=len(slab.points)))
    return rows, neighbour.astype(PETSc.IntType)

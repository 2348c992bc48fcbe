"""Planes of the grid behind a truss, along the axes: through the layers of a lattice, else equidistant."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

if TYPE_CHECKING:
    from ..mesh.distribution import DistributedMesh

__all__ = ["fills_block", "grid_coordinates", "grid_planes"]

# Spacing of the planes over the mean length of the bars. Lattices of 10^5 bars, iterations to 1e-6 and time: 2 is best
# of 1.5, 2, 2.5, 3.
_SPACING = 2.0
_FINEST = 4  # nodes for a box of a filled block: more boxes would make the coarse problem as large as the fine one
_CLOSE = 1e-6  # distance of coordinates that are one layer, and of nodes that are on a plane, over the spacing
_LAYERS = 8  # most layers between two planes
_PIECE = 1 << 16  # bars at a time, so that temporary arrays stay small
# A block has this extent in mean lengths of bars, and this many nodes in a cube of this length; lattices have 1.3 to 2.
_THICK = 4.0
_FILLED = 0.5


def grid_planes(mesh: DistributedMesh) -> list[np.ndarray]:
    """Return the coordinates [m] of the planes along x, y and z, ascending. Collective."""
    low, high = _extremes(mesh)
    spacing = max(_SPACING * _mean_length(mesh), _least(high - low, mesh.n_nodes))
    points = mesh.points[: mesh.n_owned]
    return [_planes(mesh.comm, points[:, axis], low[axis], high[axis], spacing) for axis in range(3)]


def fills_block(mesh: DistributedMesh) -> bool:
    """Whether a truss is several bars thick in all directions and has nodes everywhere between its extremes, so that
    the functions of the grid describe its soft motions. Slender and hollow trusses bend within a box. Collective."""
    low, high = _extremes(mesh)
    length = _mean_length(mesh)
    extents = high - low
    return bool(extents.min() >= _THICK * length and mesh.n_nodes * length**3 >= _FILLED * np.prod(extents))


def _extremes(mesh: DistributedMesh) -> tuple[np.ndarray, np.ndarray]:
    points = mesh.points[: mesh.n_owned]
    low, high = np.empty(3), np.empty(3)
    mesh.comm.Allreduce(points.min(axis=0, initial=np.inf), low, op=MPI.MIN)
    mesh.comm.Allreduce(points.max(axis=0, initial=-np.inf), high, op=MPI.MAX)
    return low, high


def _mean_length(mesh: DistributedMesh) -> float:
    """Return the mean length of the bars [m], rounded, because the sum depends on the number of ranks. Collective."""
    counted = mesh.bars[mesh.counted]
    total = 0.0
    for first in range(0, len(counted), _PIECE):
        some = counted[first : first + _PIECE]
        total += float(np.linalg.norm(mesh.points[some[:, 1]] - mesh.points[some[:, 0]], axis=1).sum())
    return float(f"{mesh.comm.allreduce(total) / mesh.n_bars:.3g}")


def _least(extents: np.ndarray, n_nodes: int) -> float:
    """Return the spacing [m] with which the boxes that fill the extents are fewer than the nodes."""
    filled = extents[extents > 0.0]
    boxes = n_nodes / _FINEST
    spacing = 0.0
    if len(filled):
        spacing = float((np.prod(filled) / boxes) ** (1.0 / len(filled)))
        # a truss that fills little of its extents has fewer boxes than these
        spacing *= 0.5
    return spacing


def _planes(comm: MPI.Comm, x: np.ndarray, low: float, high: float, spacing: float) -> np.ndarray:
    if not high - low > _CLOSE * spacing:
        return np.array([low])
    count = max(int(round((high - low) / spacing)), 1)
    even = np.linspace(low, high, count + 1)
    layers = _layers(comm, x, low, spacing, _LAYERS * count + 1)
    if layers is None:
        return even
    # the planes nearest to equidistant ones among the layers: bars of a lattice end on them and do not cross them
    at = np.round(np.linspace(0, len(layers) - 1, min(count, len(layers) - 1) + 1)).astype(int)
    return layers[at]


def _layers(comm: MPI.Comm, x: np.ndarray, low: float, spacing: float, most: int) -> np.ndarray | None:
    """Return the coordinates that nodes have, None if they are more than ``most``. Collective."""
    close = _CLOSE * spacing
    some = _merged(np.sort(x[: 4 * most]), close)
    few = comm.allreduce(len(some), op=MPI.MAX) <= most
    if not few:
        return None
    mine = some
    for first in range(0, len(x), 1 << 18):
        mine = _merged(np.unique(np.concatenate([mine, x[first : first + (1 << 18)]])), close)
        if len(mine) > most:
            break
    if comm.allreduce(len(mine), op=MPI.MAX) > most:
        return None
    layers = _merged(np.sort(np.concatenate(comm.allgather(mine))), close)
    return layers if len(layers) <= most else None


def _merged(ascending: np.ndarray, close: float) -> np.ndarray:
    """Return the first one of values that are close."""
    return ascending[np.diff(ascending, prepend=-np.inf) > close]


def grid_coordinates(points: np.ndarray, planes: list[np.ndarray]) -> np.ndarray:
    """Return positions (n, 3) counted in planes: the number of the plane before a point, and the part of the way to the
    next; whole numbers on planes."""
    t = np.zeros_like(points)
    for axis, at in enumerate(planes):
        if len(at) > 1:
            box = np.clip(np.searchsorted(at, points[:, axis], side="right") - 1, 0, len(at) - 2)
            part = (points[:, axis] - at[box]) / (at[box + 1] - at[box])
            whole = np.round(part)
            t[:, axis] = box + np.where(np.abs(part - whole) < 10.0 * _CLOSE, whole, np.clip(part, 0.0, 1.0))
    return t

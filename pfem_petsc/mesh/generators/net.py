"""A rectangular net of square or rectangular meshes in the x-y plane: chains of bars in both directions."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from ...case.base import PositiveInt, StrictModel, listed
from ..slab import MeshSlab
from .base import Length, Part


class Parameters(StrictModel):
    """Keys of ``[mesh]`` with ``generator = "net"``."""

    size: Annotated[tuple[Length, Length], listed]
    """Extents along x and y [m]."""
    cells: Annotated[tuple[PositiveInt, PositiveInt], listed]
    """Number of meshes along x and y."""


def generate(parameters: Parameters, rank: int, size: int) -> MeshSlab:
    """Generate this rank's part: node i + j (nx + 1) at (i lx/nx, j ly/ny, 0); bars along x, then along y.

    Node groups ``corners``, ``corner_1`` to ``corner_4`` (from the origin, then that at the end of the x axis),
    ``edges`` (corners included) and ``centre`` (the node next to the middle); bar groups ``warp`` (along x) and
    ``weft`` (along y).
    """
    nx, ny = parameters.cells
    across, along = nx + 1, nx * (ny + 1)
    n_nodes, n_bars = across * (ny + 1), along + across * ny
    part = Part(n_nodes, n_bars, rank, size, "mesh.cells")
    numbers, bars = part.nodes, part.bars
    j, i = np.divmod(numbers, across)
    points = np.zeros((len(numbers), 3))
    points[:, 0] = parameters.size[0] * i / nx
    points[:, 1] = parameters.size[1] * j / ny
    warp = bars < along
    start = np.where(warp, bars + bars // nx, bars - along)
    corners = (0, nx, n_nodes - 1, n_nodes - across)
    side = ((i == 0) | (i == nx)).astype(int) + ((j == 0) | (j == ny))
    node_groups = {
        "corners": side == 2,
        **{f"corner_{k}": numbers == node for k, node in enumerate(corners, 1)},
        "edges": side > 0,
        "centre": numbers == nx // 2 + (ny // 2) * across,
    }
    ends = start, start + np.where(warp, 1, across)
    return part.slab("net", points, ends, node_groups, {"warp": warp, "weft": ~warp})

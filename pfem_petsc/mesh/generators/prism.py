"""A tensegrity prism: two polygons of cables, cables between them, and struts connected only at their end nodes."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from ...case.base import Finite, PositiveFloat, StrictModel
from ..slab import MeshSlab, check_length, check_size, index_type, slab_range

__all__ = ["Parameters", "generate"]


class Parameters(StrictModel):
    """Keys of ``[mesh]`` with ``generator = "prism"``."""

    radius: PositiveFloat
    """Distance of the corners from the axis [m]."""
    height: PositiveFloat
    """Distance of the polygons [m]."""
    sides: Annotated[int, Field(ge=3, lt=2**63)] = 3
    """Number of struts, and of corners of each polygon."""
    twist: Finite | None = None
    """Angle about the axis from the foot of a strut to its head [degrees]; default: 90 + 180 / sides, at which cables
    and struts balance each other."""


def generate(parameters: Parameters, rank: int, size: int) -> MeshSlab:
    """Generate this rank's part, about the z axis: node i at the bottom, z = 0, node i + sides at the top.

    The first two corners of the bottom lie along x. Strut i goes from node i to node i + sides, the cable beside it
    from node i to the head of the strut before. Node groups ``bottom``, ``top``, and ``first``, ``second`` (corners of
    the bottom); bar groups ``bottom_cables``, ``top_cables``, ``side_cables``, ``cables`` (these three) and ``struts``,
    in this order.
    """
    n = parameters.sides
    check_size(2 * n, "mesh.sides")
    check_length(2.0 * parameters.radius * np.sin(np.pi / n), "mesh.radius (with mesh.sides)")
    check_length(parameters.height, "mesh.height")
    twist = 90.0 + 180.0 / n if parameters.twist is None else parameters.twist
    first_node, last_node = slab_range(2 * n, rank, size)
    first_bar, last_bar = slab_range(4 * n, rank, size)
    numbers = np.arange(first_node, last_node)
    top, corner = np.divmod(numbers, n)
    angles = np.deg2rad(360.0 * corner / n - 180.0 / n - 90.0 + twist * top)
    points = np.stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))], axis=1) * parameters.radius
    points[:, 2] = parameters.height * top
    bars = np.arange(first_bar, last_bar)
    kind, i = np.divmod(bars, n)
    after, before = (i + 1) % n, (i - 1) % n
    start = np.where(kind == 1, i + n, i)
    end = np.choose(kind, [after, after + n, before + n, i + n])
    kinds = ("bottom_cables", "top_cables", "side_cables", "struts")
    groups = {name: bars[kind == k] for k, name in enumerate(kinds)}
    return MeshSlab(
        n_nodes=2 * n,
        n_bars=4 * n,
        first_node=first_node,
        points=points,
        first_bar=first_bar,
        bars=np.stack([start, end], axis=1).astype(index_type(2 * n)),
        node_groups={
            "bottom": numbers[top == 0],
            "top": numbers[top == 1],
            "first": numbers[numbers == 0],
            "second": numbers[numbers == 1],
        },
        bar_groups={**groups, "cables": bars[kind < 3]},
        source="generator prism",
        structured=True,
    )

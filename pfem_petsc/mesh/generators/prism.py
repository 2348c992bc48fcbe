"""A tensegrity prism: two polygons of cables, cables between them, and struts connected only at their end nodes."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from ...case.base import Finite, StrictModel
from ..slab import MeshSlab
from .base import Length, Part


class Parameters(StrictModel):
    """Keys of ``[mesh]`` with ``generator = "prism"``."""

    radius: Length
    """Distance of the corners from the axis [m]."""
    height: Length
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
    twist = 90.0 + 180.0 / n if parameters.twist is None else parameters.twist
    part = Part(2 * n, 4 * n, rank, size, "mesh.sides")
    top, corner = np.divmod(part.nodes, n)
    angles = np.deg2rad(360.0 * corner / n - 180.0 / n - 90.0 + twist * top)
    points = np.stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))], axis=1) * parameters.radius
    points[:, 2] = parameters.height * top
    kind, i = np.divmod(part.bars, n)
    after, before = (i + 1) % n, (i - 1) % n
    ends = np.where(kind == 1, i + n, i), np.choose(kind, [after, after + n, before + n, i + n])
    node_groups = {"bottom": top == 0, "top": top == 1, "first": part.nodes == 0, "second": part.nodes == 1}
    kinds = ("bottom_cables", "top_cables", "side_cables", "struts")
    bar_groups = {name: kind == k for k, name in enumerate(kinds)}
    return part.slab("prism", points, ends, node_groups, {**bar_groups, "cables": kind < 3})

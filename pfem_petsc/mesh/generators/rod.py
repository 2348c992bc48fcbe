"""A straight rod of equal bars along the x axis, from the origin."""

from __future__ import annotations

import numpy as np

from ...case.base import PositiveInt, StrictModel
from ..slab import MeshSlab
from .base import Length, Part


class Parameters(StrictModel):
    """Keys of ``[mesh]`` with ``generator = "rod"``."""

    length: Length
    """Length of the rod [m]."""
    elements: PositiveInt
    """Number of bars."""


def generate(parameters: Parameters, rank: int, size: int) -> MeshSlab:
    """Generate this rank's part of the rod: node i at x = i length / elements, bar i from node i to node i + 1.

    Node groups ``start`` and ``end``; bar group ``rod`` (all).
    """
    n = parameters.elements
    part = Part(n + 1, n, rank, size, "mesh.elements")
    points = np.zeros((len(part.nodes), 3))
    points[:, 0] = parameters.length * part.nodes / n
    ends = {"start": part.nodes == 0, "end": part.nodes == n}
    return part.slab("rod", points, (part.bars, part.bars + 1), ends, {"rod": part.bars >= 0})

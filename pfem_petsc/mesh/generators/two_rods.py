"""Two equal rods of equal bars along the x axis, end to end with a gap between them."""

from __future__ import annotations

import numpy as np

from ...case.base import PositiveInt, StrictModel
from ..slab import MeshSlab
from .base import Length, Part


class Parameters(StrictModel):
    """Keys of ``[mesh]`` with ``generator = "two_rods"``."""

    length: Length
    """Length of each rod [m]."""
    elements: PositiveInt
    """Number of bars of each rod."""
    gap: Length
    """Distance between the rods [m]."""


def generate(parameters: Parameters, rank: int, size: int) -> MeshSlab:
    """Generate this rank's part: the first rod from x = 0 to length, the second from length + gap to 2 length + gap.

    Node groups ``start``, ``first_end``, ``second_start``, ``end``; bar groups ``first`` and ``second``.
    """
    n = parameters.elements
    part = Part(2 * (n + 1), 2 * n, rank, size, "mesh.elements")
    rod, place = np.divmod(part.nodes, n + 1)
    points = np.zeros((len(part.nodes), 3))
    points[:, 0] = parameters.length * place / n + rod * (parameters.length + parameters.gap)
    start = part.bars + part.bars // n
    ends = {"start": 0, "first_end": n, "second_start": n + 1, "end": 2 * n + 1}
    node_groups = {name: part.nodes == node for name, node in ends.items()}
    bar_groups = {"first": part.bars < n, "second": part.bars >= n}
    return part.slab("two_rods", points, (start, start + 1), node_groups, bar_groups)

"""Two equal rods of equal bars along the x axis, end to end with a gap between them."""

from __future__ import annotations

import numpy as np

from ...case.base import PositiveFloat, PositiveInt, StrictModel
from ..slab import MeshSlab, check_length, check_size, index_type, slab_range

__all__ = ["Parameters", "generate"]


class Parameters(StrictModel):
    """Keys of ``[mesh]`` with ``generator = "two_rods"``."""

    length: PositiveFloat
    """Length of each rod [m]."""
    elements: PositiveInt
    """Number of bars of each rod."""
    gap: PositiveFloat
    """Distance between the rods [m]."""


def generate(parameters: Parameters, rank: int, size: int) -> MeshSlab:
    """Generate this rank's part: the first rod from x = 0 to length, the second from length + gap to 2 length + gap.

    Node groups ``start``, ``first_end``, ``second_start``, ``end``; bar groups ``first`` and ``second``.
    """
    n = parameters.elements
    check_size(2 * (n + 1), "mesh.elements")
    check_length(parameters.length / n, "mesh.length (over mesh.elements)")
    first_node, last_node = slab_range(2 * (n + 1), rank, size)
    first_bar, last_bar = slab_range(2 * n, rank, size)
    numbers = np.arange(first_node, last_node)
    rod, place = np.divmod(numbers, n + 1)
    points = np.zeros((len(numbers), 3))
    points[:, 0] = parameters.length * place / n + rod * (parameters.length + parameters.gap)
    bars = np.arange(first_bar, last_bar, dtype=index_type(2 * (n + 1)))
    start = bars + bars // n
    groups = {"start": 0, "first_end": n, "second_start": n + 1, "end": 2 * n + 1}
    return MeshSlab(
        n_nodes=2 * (n + 1),
        n_bars=2 * n,
        first_node=first_node,
        points=points,
        first_bar=first_bar,
        bars=np.stack([start, start + 1], axis=1),
        node_groups={name: numbers[numbers == node] for name, node in groups.items()},
        bar_groups={"first": bars[bars < n].astype(np.int64), "second": bars[bars >= n].astype(np.int64)},
        source="generator two_rods",
        structured=True,
    )

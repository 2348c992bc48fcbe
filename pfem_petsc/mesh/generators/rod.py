"""A straight rod of equal bars along the x axis, from the origin."""

from __future__ import annotations

import numpy as np

from ...case.base import PositiveFloat, PositiveInt, StrictModel
from ..slab import MeshSlab, check_length, check_size, index_type, slab_range

__all__ = ["Parameters", "generate"]


class Parameters(StrictModel):
    """Keys of ``[mesh]`` with ``generator = "rod"``."""

    length: PositiveFloat
    """Length of the rod [m]."""
    elements: PositiveInt
    """Number of bars."""


def generate(parameters: Parameters, rank: int, size: int) -> MeshSlab:
    """Generate this rank's part of the rod: node i at x = i length / elements, bar i from node i to node i + 1.

    Node groups ``start`` and ``end``; bar group ``rod`` (all).
    """
    n = parameters.elements
    check_size(n + 1, "mesh.elements")
    check_length(parameters.length / n, "mesh.length (over mesh.elements)")
    first_node, last_node = slab_range(n + 1, rank, size)
    first_bar, last_bar = slab_range(n, rank, size)
    points = np.zeros((last_node - first_node, 3))
    points[:, 0] = parameters.length * np.arange(first_node, last_node) / n
    start = np.arange(first_bar, last_bar, dtype=index_type(n + 1))
    ends = np.array([0, n])
    ends_here = (ends >= first_node) & (ends < last_node)
    return MeshSlab(
        n_nodes=n + 1,
        n_bars=n,
        first_node=first_node,
        points=points,
        first_bar=first_bar,
        bars=np.stack([start, start + 1], axis=1),
        node_groups={"start": ends[:1][ends_here[:1]], "end": ends[1:][ends_here[1:]]},
        bar_groups={"rod": np.arange(first_bar, last_bar)},
        source="generator rod",
        structured=True,
    )

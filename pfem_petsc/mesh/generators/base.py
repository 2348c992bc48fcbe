"""One rank's part of a generated mesh, from the numbers of its nodes and bars."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

import numpy as np
from pydantic import Field

from ..slab import MeshSlab, check_size, index_type, slab_of_whole, slab_range

Length = Annotated[float, Field(gt=1e-150, lt=1e150)]
"""A length [m] whose square neither overflows nor underflows."""


class Part:
    """A rank's contiguous ranges of the nodes and bars of a mesh.

    Attributes
    ----------
    nodes, bars : (n,) int64 numbers in the mesh

    Raises
    ------
    InputError
        If the mesh is too large; ``where`` names the key.
    """

    def __init__(self, n_nodes: int, n_bars: int, rank: int, size: int, where: str = "mesh") -> None:
        check_size(n_nodes, where, n_bars)
        self.n_nodes, self.n_bars = n_nodes, n_bars
        self.nodes = np.arange(*slab_range(n_nodes, rank, size))
        self.bars = np.arange(*slab_range(n_bars, rank, size))
        self._first = slab_range(n_nodes, rank, size)[0], slab_range(n_bars, rank, size)[0]

    def slab(
        self,
        source: str,
        points: np.ndarray,
        ends: tuple[np.ndarray, np.ndarray],
        node_groups: Mapping[str, np.ndarray],
        bar_groups: Mapping[str, np.ndarray],
    ) -> MeshSlab:
        """Return the part of the mesh.

        Parameters
        ----------
        source : name of the generator, for messages
        points : (nodes, 3) [m]
        ends : numbers (bars,) of the first and second nodes
        node_groups, bar_groups : which of the nodes and bars (n,) bool are in each group, by name
        """
        return MeshSlab(
            n_nodes=self.n_nodes,
            n_bars=self.n_bars,
            first_node=self._first[0],
            points=points,
            first_bar=self._first[1],
            bars=np.stack(ends, axis=1).astype(index_type(self.n_nodes)),
            node_groups={name: self.nodes[mask] for name, mask in node_groups.items()},
            bar_groups={name: self.bars[mask] for name, mask in bar_groups.items()},
            source=f"generator {source}",
            structured=True,
        )


def circle(radius: float, angles: np.ndarray) -> np.ndarray:
    """Return points (n, 3) [m] about the z axis at angles (n,) [rad], with exact zeros on the axes."""
    points = radius * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))])
    points[np.abs(points) < 1e-15 * radius] = 0.0
    return points


def dome(source: str, points: np.ndarray, second_legs: tuple[int, int], rank: int, size: int) -> MeshSlab:
    """Return a rank's part of a dome: an apex, node 0, a ring of nodes, and as many feet.

    Bars: apex to ring, the ring, from each node of the ring to its foot, and as many second legs, which start at the
    node of the ring and end at the foot ``second_legs`` places farther. Node groups ``apex``, ``ring``, ``feet``; bar
    groups ``spokes``, ``ring``, ``legs``.

    Parameters
    ----------
    source : name of the generator, for messages
    points : (1 + 2 n, 3) [m]
    """
    n = len(points) // 2
    k = np.arange(n)
    ring, feet = 1 + k, 1 + n + k
    bars = [(0 * k, ring), (ring, np.roll(ring, -1)), (ring, feet)]
    bars += [(np.roll(ring, -second_legs[0]), np.roll(feet, -second_legs[1]))]
    return slab_of_whole(
        points,
        np.vstack([np.column_stack(pair) for pair in bars]),
        {"apex": np.zeros(1), "ring": ring, "feet": feet},
        {"spokes": k, "ring": n + k, "legs": np.arange(2 * n, 4 * n)},
        f"generator {source}",
        rank,
        size,
    )

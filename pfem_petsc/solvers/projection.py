"""Rows and columns of an assembled Hessian at nodes whose prescribed directions are no axes: P H P + s (I - P)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .node_blocks import turn_blocks

if TYPE_CHECKING:
    from ..mechanics.directions import Directions
    from ..mesh.distribution import DistributedMesh

__all__ = ["Projection"]


class Projection:
    """Projections on the free directions of local nodes. Construction is collective.

    Attributes
    ----------
    nodes : (m,) owned nodes; held : (m, 3, 3) projections on their prescribed directions
    """

    def __init__(self, mesh: DistributedMesh, directions: Directions) -> None:
        self.nodes, self.held = directions.nodes, np.eye(3) - directions.free
        shared = np.zeros((mesh.n_local, 10))
        shared[self.nodes, 0] = 1.0
        shared[self.nodes, 1:] = directions.free.reshape(-1, 9)
        mesh.update_ghosts(shared)
        nodes = np.flatnonzero(shared[:, 0])
        self._place = np.full(mesh.n_local, -1, dtype=np.int32)
        self._place[nodes] = np.arange(len(nodes), dtype=np.int32)
        self._free = np.ascontiguousarray(shared[nodes, 1:]).reshape(-1, 3, 3)

    def project(self, ptr: np.ndarray, local_columns: np.ndarray, values: np.ndarray) -> None:
        """Project the values of a matrix, without its new diagonal blocks."""
        turn_blocks(ptr, local_columns, self._place, self._free, self._free, values)

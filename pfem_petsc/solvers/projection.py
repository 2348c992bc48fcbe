"""Rows and columns of an assembled Hessian at nodes whose prescribed directions are no axes: P H P + s (I - P)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..mechanics.compiled import kernel

if TYPE_CHECKING:
    from ..mechanics.directions import Directions
    from ..mesh.distribution import DistributedMesh

__all__ = ["Projection"]


@kernel
def _project_blocks(ptr, local_columns, place, free, values):
    """Multiply blocks by the projections ``free`` (m, 3, 3) of their row and column nodes; ``place`` -1: none."""
    block = np.zeros((3, 3))
    for row in range(len(ptr) - 1):
        width = 3 * (ptr[row + 1] - ptr[row])
        r = place[row]
        for k in range(ptr[row], ptr[row + 1]):
            c = place[local_columns[k]]
            if r < 0 and c < 0:
                continue
            at = 6 * ptr[row] + 3 * k
            for i in range(3):
                for j in range(3):
                    block[i, j] = values[at + i * width + j]
            if r >= 0:
                for j in range(3):
                    x, y, z = block[0, j], block[1, j], block[2, j]
                    for i in range(3):
                        block[i, j] = free[r, i, 0] * x + free[r, i, 1] * y + free[r, i, 2] * z
            if c >= 0:
                for i in range(3):
                    x, y, z = block[i, 0], block[i, 1], block[i, 2]
                    for j in range(3):
                        block[i, j] = x * free[c, 0, j] + y * free[c, 1, j] + z * free[c, 2, j]
            for i in range(3):
                for j in range(3):
                    values[at + i * width + j] = block[i, j]


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
        _project_blocks(ptr, local_columns, self._place, self._free, values)

"""Springs from nodes to the ground: forces -K (x - X) about the positions X of the mesh, along constant axes.

K is diagonal in the frame of each table, by default that of the model; tables of one node add up.

They are added to the internal forces of the bars, so every scheme integrates them with the bars. The forces of bars
cancel in the sum over all nodes; what remains of it is the force of the truss on the ground by the springs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .directions import axes_of

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..mesh.distribution import DistributedMesh
    from ..solvers.matrix import BlockPattern

__all__ = ["Springs", "make_springs"]


class Springs:
    """Springs of the nodes that this rank owns.

    Attributes
    ----------
    nodes : (m,) local indices, distinct
    stiffness : (m, 3, 3), symmetric [N/m]
    anchors : (m, 3) positions without force [m]
    """

    def __init__(self, nodes: np.ndarray, stiffness: np.ndarray, anchors: np.ndarray) -> None:
        self.nodes, self.stiffness, self.anchors = nodes, stiffness, anchors

    def add_forces(self, x: np.ndarray, f: np.ndarray) -> float:
        """Add the internal forces at positions ``x`` to ``f``, both (local, 3); return the stored energy [J]."""
        stretch = x[self.nodes] - self.anchors
        force = self._times(stretch)
        f[self.nodes] += force
        return 0.5 * float((force * stretch).sum())

    def add_step_forces(self, x0: np.ndarray, x: np.ndarray, f: np.ndarray) -> None:
        """Add the discrete gradient of a step from ``x0`` to ``x``, the force at mid-step: energies are quadratic."""
        f[self.nodes] += self._times(0.5 * (x0[self.nodes] + x[self.nodes]) - self.anchors)

    def add_product(self, weight: float, u: np.ndarray, out: np.ndarray) -> None:
        """Add ``weight`` times the stiffness times ``u`` to ``out``, with a row for each owned node at least."""
        out[self.nodes] += weight * self._times(u[self.nodes])

    def add_tangents(self, weight: float, pattern: BlockPattern, values: np.ndarray) -> None:
        """Add ``weight`` times the stiffness to the values of a matrix."""
        if not weight:
            return
        ptr = pattern.ptr.astype(np.int64)
        start = 6 * ptr[self.nodes] + 3 * pattern.diagonal[self.nodes]
        width = 3 * (ptr[self.nodes + 1] - ptr[self.nodes])
        for i in range(3):
            for j in range(3):
                values[start + i * width + j] += weight * self.stiffness[:, i, j]

    def largest(self) -> np.ndarray:
        """Return the largest stiffness of each node in any direction (m,) [N/m]."""
        return np.linalg.eigvalsh(self.stiffness)[:, -1]

    def _times(self, u: np.ndarray) -> np.ndarray:
        # written out: the order of the sum does not depend on the number of nodes
        k = self.stiffness
        return k[:, :, 0] * u[:, :1] + k[:, :, 1] * u[:, 1:2] + k[:, :, 2] * u[:, 2:]


def make_springs(case: Case, nodes: dict[str, np.ndarray], mesh: DistributedMesh) -> Springs | None:
    """Return the springs of ``[[spring]]``, None if the case has none. A node in several gets the sum of stiffness."""
    grounded = [entry for entry in case.spring if entry.node_set is not None]
    if not grounded:
        return None
    stiffness = np.zeros((mesh.n_owned, 3, 3))
    for entry in grounded:
        tensor = np.diag(entry.stiffness)
        if entry.frame is not None:
            axes = axes_of(*np.array(entry.frame))
            tensor = axes.T @ tensor @ axes
            tensor = 0.5 * (tensor + tensor.T)
        stiffness[nodes[entry.node_set]] += tensor
    held = np.flatnonzero(stiffness.any(axis=(1, 2)))
    return Springs(held, stiffness[held], mesh.points[held].copy())

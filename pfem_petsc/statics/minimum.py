"""Whether an equilibrium is a minimum of the potential, so that a structure can rest there."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from petsc4py import PETSc

from ..solvers.matrix import HessianMatrix
from .stability import LARGEST, Stability

if TYPE_CHECKING:
    from ..contact.forces import WallForces
    from ..stepping.model import Model

__all__ = ["MinimumCheck"]

_ZERO = 1e-10  # of the largest nodal stiffness: eigenvalues down to minus this are zero, those of free motions
_RIGID = 1e3  # of the largest nodal stiffness: what walls have along the normals of nodes that they push


class MinimumCheck:
    """Counts directions in which the potential falls, without those that walls prevent. Collective.

    Attributes
    ----------
    refusal : why it cannot, None where it can
    """

    def __init__(self, model: Model) -> None:
        self.model = model
        self._matrix: HessianMatrix | None = None
        self._stability: Stability | None = None
        self.refusal: str | None = f"the model has more than {LARGEST:,} unknowns"
        if 3 * model.mesh.n_nodes <= LARGEST:
            self._matrix = HessianMatrix(model.mesh, model.supports)
            self._stability = Stability(model, self._matrix)
            self.refusal = self._stability.refusal
        self._scale = max(model.comm.allgather(float(model.nodal_stiffness.max(initial=0.0))))

    def falling(self, x: np.ndarray, walls: WallForces, time: float) -> int:
        """Number of negative eigenvalues of the stiffness at positions (local, 3), -1 where it cannot be factorised.

        ``walls`` says which nodes walls push, ``time`` where the walls are. Collective.
        """
        nodes, blocks = self._held(walls, time)
        model, matrix = self.model, self._matrix

        def add(values: np.ndarray) -> None:
            matrix.add_lumped(np.full(model.mesh.n_owned, _ZERO * self._scale), values)
            model.bars.tangents(x, 1.0, model.inertia.coefficients(0.0, 0.0), matrix.pattern, values)
            matrix.add_blocks(nodes, _RIGID * self._scale * blocks, values)
            matrix.constrain(self._scale, values)

        matrix.fill(add)
        try:
            return self._stability.look().negatives
        except PETSc.Error:
            return -1

    def _held(self, walls: WallForces, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Nodes (k,) that walls hold, and the projections (k, 3, 3) on their directions, summed."""
        contact = self.model.contact
        blocks = np.zeros((self.model.mesh.n_owned, 3, 3))
        if len(walls.nodes):
            normals, _ = contact.planes(walls.touching, walls.places, contact.motion.displacements(time))
            blocks[walls.nodes] += np.einsum("mw,mwi,mwj->mij", walls.touching.astype(float), normals, normals)
        if contact.ties.any:
            blocks[contact.ties.nodes()[0]] += np.eye(3)
        nodes = np.flatnonzero(blocks.any(axis=(1, 2)))
        return nodes, blocks[nodes]

    def destroy(self) -> None:
        """Free the PETSc objects. Collective."""
        for owner in (self._stability, self._matrix):
            if owner is not None:
                owner.destroy()

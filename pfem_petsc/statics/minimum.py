"""Whether an equilibrium is a minimum of the potential, so that a structure can rest there."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from petsc4py import PETSc

from ..solvers.matrix import HessianMatrix
from .stability import LARGEST, Stability

if TYPE_CHECKING:
    from ..contact.forces import WallForces
    from ..solvers.lagged import LaggedPreconditioner
    from ..solvers.matrix_free import MatrixFreeHessian
    from ..stepping.model import Model

__all__ = ["MinimumCheck", "held_nodes", "is_indefinite"]

_ZERO = 1e-10  # of the largest nodal stiffness: eigenvalues down to minus this are zero, those of free motions
_RIGID = 1e3  # of the largest nodal stiffness: what walls have along the normals of nodes that they push
_ITERATIONS = 500  # of conjugate gradients that look for a negative curvature, about those of a linear solve
_RTOL = 1e-6  # a mode of negative curvature cannot remain hidden while the residual of a random load falls this far
_NOISE = 1e-12  # of the largest nodal stiffness: curvatures down to minus this are rounding


def held_nodes(model: Model, walls: WallForces) -> np.ndarray:
    """Return which owned nodes are taken as held in all directions.

    These are tied nodes, those that walls with friction or curved walls push, and those that links push: their forces
    resist a motion along the wall, or turn with the nodes. What is unstable with them held is unstable without.
    """
    contact, held = model.contact, np.zeros(model.mesh.n_owned, dtype=bool)
    special = ~contact.flat | (np.array(contact.static_friction) > 0.0)
    held[walls.nodes[walls.touching[:, special].any(axis=1)]] = True
    if contact.ties.any:
        held[contact.ties.nodes()[0]] = True
    for link in model.links:
        link.mark(held)
    return held


def is_indefinite(
    model: Model,
    hessian: HessianMatrix | MatrixFreeHessian,
    lagged: LaggedPreconditioner | None,
    held: np.ndarray,
) -> bool:
    """Return whether conjugate gradients meet a negative curvature of an operator; without a factorisation.

    A curvature that is found is a proof. The load is random: that of the truss may be orthogonal to the mode.
    ``held`` (owned,) : nodes that do not move. Collective.
    """
    noise = _NOISE * max(model.comm.allgather(float(model.nodal_stiffness.max(initial=0.0))))
    b, diagonal = hessian.mat.createVecs()
    z, p, w = b.duplicate(), b.duplicate(), b.duplicate()

    def clear(vector: PETSc.Vec) -> None:
        with vector as values:
            model.supports.clear(values.reshape(-1, 3))
            values.reshape(-1, 3)[held] = 0.0

    def precondition() -> float:
        if lagged is not None and lagged.is_set_up:
            lagged.inner.apply(b, z)
        else:
            z.pointwiseDivide(b, diagonal)
        clear(z)
        return b.dot(z)

    diagonal = hessian.mat.getDiagonal(diagonal)
    diagonal.array[:] = np.maximum(np.abs(diagonal.array), noise or 1.0)
    ids = 3 * model.mesh.node_ids[: model.mesh.n_owned, None] + np.arange(3)
    b.array[:] = np.cos((ids.ravel() + 0.5) ** 1.5)
    clear(b)
    start, before, found = b.norm(), 0.0, False
    for _ in range(_ITERATIONS):
        product = precondition()
        if not (product > 0.0 and b.norm() > _RTOL * start):
            break
        p.aypx(product / before if before else 0.0, z)
        hessian.mat.mult(p, w)
        clear(w)
        curvature, before = p.dot(w), product
        if curvature <= 0.0:
            found = curvature < -noise * p.dot(p)
            break
        b.axpy(-product / curvature, w)
    for vector in (b, diagonal, z, p, w):
        vector.destroy()
    return found


class MinimumCheck:
    """Counts directions in which the potential falls, without those that walls prevent. Collective.

    Parameters
    ----------
    model : Model
    largest : number of unknowns up to which it factorises the stiffness

    Attributes
    ----------
    refusal : why it cannot, None where it can
    """

    def __init__(self, model: Model, largest: int = LARGEST) -> None:
        self.model = model
        self._matrix: HessianMatrix | None = None
        self._stability: Stability | None = None
        self.refusal: str | None = f"the model has more than {largest:,} unknowns"
        if 3 * model.mesh.n_nodes <= largest:
            self._matrix = HessianMatrix(model.mesh, model.supports)
            self._stability = Stability(model, self._matrix)
            self.refusal = self._stability.refusal
        self._scale = max(model.comm.allgather(float(model.nodal_stiffness.max(initial=0.0))))

    def falling(self, x: np.ndarray, walls: WallForces, time: float, bars: np.ndarray | None = None) -> int:
        """Number of negative eigenvalues of the stiffness at positions (local, 3), -1 where it cannot be factorised.

        ``walls`` says which nodes walls push, ``time`` where the walls are; ``bars`` (5, b) is their stiffness if not
        the tangent, see ``Bars.linearise``. Collective.
        """
        nodes, blocks = self._held(walls, time)
        model, matrix = self.model, self._matrix

        def add(values: np.ndarray) -> None:
            matrix.add_lumped(np.full(model.mesh.n_owned, _ZERO * self._scale), values)
            if bars is None:
                model.bars.tangents(x, 1.0, model.inertia.coefficients(0.0, 0.0), matrix.pattern, values)
            else:
                matrix.add_bars(bars, values)
                if model.bars.springs is not None:
                    model.bars.springs.add_tangents(1.0, matrix.pattern, values)
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
        blocks[held_nodes(self.model, walls)] += np.eye(3)
        nodes = np.flatnonzero(blocks.any(axis=(1, 2)))
        return nodes, blocks[nodes]

    def destroy(self) -> None:
        """Free the PETSc objects. Collective."""
        for owner in (self._stability, self._matrix):
            if owner is not None:
                owner.destroy()

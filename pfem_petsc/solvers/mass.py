"""Accelerations from forces with consistent mass: solves M a = f by conjugate gradients."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from petsc4py import PETSc

from ..errors import SimulationFailure
from .matrix import HessianMatrix
from .reasons import linear_reason

if TYPE_CHECKING:
    from ..stepping.model import Model

__all__ = ["MassSolver"]

_PREFIX = "pfem_mass_"


class MassSolver:
    """The consistent mass matrix, constant during a run, and its solver. Construction is collective.

    Options: prefix ``pfem_mass_``.

    Parameters
    ----------
    model : Model
        With consistent mass.
    """

    def __init__(self, model: Model) -> None:
        self._supports = model.supports
        self._matrix = matrix = HessianMatrix(model.mesh, model.supports)

        def add(values: np.ndarray) -> None:
            coefficients = model.inertia.coefficients(1.0, 0.0)
            model.bars.tangents(model.mesh.points, 0.0, coefficients, matrix.pattern, values)
            if model.inertia.points.mass is not None:
                matrix.add_lumped(model.inertia.points.mass, values)
            matrix.constrain(float(model.inertia.mass.max(initial=1.0)), values)

        matrix.fill(add)
        self._right, self._left = matrix.mat.createVecs()
        self._ksp = PETSc.KSP().create(model.comm)
        self._ksp.setOptionsPrefix(_PREFIX)
        self._ksp.setType("cg")
        self._ksp.getPC().setType("pbjacobi")
        self._ksp.setTolerances(rtol=1e-14, max_it=1000)
        self._ksp.setOperators(matrix.mat)
        self._ksp.setFromOptions()

    def solve(self, load: np.ndarray) -> np.ndarray:
        """Return accelerations (owned, 3) [m/s2] for forces (owned, 3) [N], zero on prescribed components. Collective.

        Raises
        ------
        SimulationFailure
            On all ranks, if the solver does not converge.
        """
        right = load.copy()
        self._supports.clear(right)
        self._right.array[:] = right.ravel()
        self._ksp.solve(self._right, self._left)
        reason = self._ksp.getConvergedReason()
        if reason < 0:
            raise SimulationFailure(
                f"the initial acceleration: no convergence after {self._ksp.getIterationNumber()} iterations with the "
                f"consistent mass matrix: {linear_reason(reason)}; check options -{_PREFIX}..., the densities and areas"
            )
        a = self._left.array.reshape(load.shape).copy()
        self._supports.clear(a)
        return a

    def destroy(self) -> None:
        """Free the PETSc objects."""
        for thing in (self._ksp, self._right, self._left):
            thing.destroy()
        self._matrix.destroy()

"""Axial forces of one linear solve: those that the changes from the start of an analysis to its end cause."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from petsc4py import PETSc

from ..errors import SimulationFailure
from ..solvers.linear import set_preconditioner
from .pencil import StateMatrices

if TYPE_CHECKING:
    from ..stepping.model import Model

_PREFIX = "pfem_linear_"
_DIRECT_UP_TO = 400_000  # unknowns; beyond, multigrid
_SMALL = 500  # unknowns up to which PETSc's own factorisation takes less time
_RTOL = 1e-12  # of iterative solves
_SOLVED = 1e-6  # residual relative to the load, above which the stiffness is singular


@dataclass(frozen=True)
class LinearForces:
    """Forces of a linear solve about the state at the start of an analysis.

    Attributes
    ----------
    stiffness : (5, b) of the bars at the start with its stresses, see ``Bars.linearise``
    start, change : (b,) axial forces at the start, and what is added up to the end [N]
    lengths : (b,) at the start [m]
    """

    stiffness: np.ndarray
    start: np.ndarray
    change: np.ndarray
    lengths: np.ndarray


class _Linear:
    """The state at the start. Methods are collective."""

    def __init__(self, model: Model, matrices: StateMatrices) -> None:
        self.model, self.matrices = model, matrices
        x = model.mesh.points.copy()
        if model.start is not None:
            x[: model.mesh.n_owned] = model.start.position
            model.mesh.update_ghosts(x)
        self.x = x

    def at(self, time: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Stiffness (5, b), axial forces (b,) and internal forces (owned, 3) at the start's positions and the
        temperatures and rest lengths of a time."""
        model, forces = self.model, np.zeros_like(self.x)
        model.change_bars(time)
        with model.bars.without_rates():
            model.bars.forces(self.x, forces, commit=False)
        bars = model.bars.state_stiffness(self.x)
        return bars, bars[4] * model.bars.lengths(self.x), forces[: model.mesh.n_owned]

    def solve(self, bars: np.ndarray, load: np.ndarray, moved: np.ndarray) -> np.ndarray:
        """Displacements (local, 3) by loads (owned, 3) and prescribed components (k,)."""
        model, holds = self.model, self.matrices.holds
        u = np.zeros_like(self.x)
        owned = u[: len(load)]
        model.supports.put(owned, moved)
        model.mesh.update_ghosts(u)
        rest = holds.to_own((load - self._product(bars, u))[None])[0]
        matrix = self.matrices.stiffness(bars, max(float(np.abs(bars[3] + bars[4]).max(initial=0.0)), 1.0))
        owned += holds.to_axes(self._free(matrix, rest)[None])[0]
        model.mesh.update_ghosts(u)
        return u

    def _product(self, bars: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Forces (owned, 3) that resist displacements (local, 3)."""
        ends, owned = self.model.mesh.bars, self.model.mesh.n_owned
        d = u[ends[:, 1]] - u[ends[:, 0]]
        force = bars[3] * (bars[:3].T * d).sum(axis=1) * bars[:3] + bars[4] * d.T
        out = np.zeros_like(u)
        np.subtract.at(out, ends[:, 0], force.T)
        np.add.at(out, ends[:, 1], force.T)
        for family in self.model.bars.families:
            family.add_product(1.0, u, out)
        return out[:owned]

    def _free(self, matrix: PETSc.Mat, load: np.ndarray) -> np.ndarray:
        """Solve for the components that are not held."""
        ksp, unknowns = PETSc.KSP().create(matrix.comm), 3 * self.model.mesh.n_nodes
        ksp.setOptionsPrefix(_PREFIX)
        direct = unknowns <= _DIRECT_UP_TO
        ksp.setType("preonly" if direct else "cg")
        ksp.setTolerances(rtol=_RTOL, max_it=4000)
        set_preconditioner(ksp.getPC(), "lu" if unknowns <= _SMALL else "mumps" if direct else "gamg")
        ksp.setOperators(matrix)
        ksp.setFromOptions()
        b, x = matrix.createVecs()
        b.array[:] = load.ravel()
        try:
            ksp.solve(b, x)
            found = x.array.reshape(load.shape).copy()
            residual = b.duplicate()
            matrix.mult(x, residual)
            residual.axpy(-1.0, b)
            sound = residual.norm() <= _SOLVED * b.norm()
        except PETSc.Error:
            sound = False
        if not sound:
            raise SimulationFailure(
                f"{self.model.case.source}: modes: the stiffness at the start is singular, so that no linear solve "
                "gives the forces of the loads: the truss is a mechanism or is not held; brace and support it"
            )
        return found


def linear_forces(model: Model, matrices: StateMatrices, begin: float, end: float, loaded: bool) -> LinearForces:
    """Return the axial forces of a linear solve for what changes from a load factor to another. Collective.

    What acts at the start, such as prestress, is brought to equilibrium by a linear solve as well. The bars are left as
    they are at ``end``.

    Parameters
    ----------
    model : Model
    matrices : StateMatrices
    begin, end : load factors or times
    loaded : whether loads act at the start; if not, all of those at the end are changes

    Raises
    ------
    SimulationFailure
        On all ranks, if the stiffness is singular.
    """
    bars, linear, supports = model.bars, _Linear(model, matrices), model.supports
    history, x = bars.history(), linear.x[: model.mesh.n_owned]

    def loads(time: float) -> np.ndarray:
        out = np.zeros_like(x)
        return model.external.at(time, out).copy() if model.external.active else out

    try:
        if model.start is None:
            bars.put_history(np.zeros_like(history))
        stiffness, force, internal = linear.at(begin)
        acting = loads(begin) if loaded else np.zeros_like(x)
        tangent = stiffness[3] + stiffness[4]

        def stretching(u: np.ndarray) -> np.ndarray:
            return tangent * ((u[model.mesh.bars[:, 1]] - u[model.mesh.bars[:, 0]]) * stiffness[:3].T).sum(axis=1)

        u = linear.solve(stiffness, acting - internal, supports.lacking(x, begin))
        start, lengths = force + stretching(u), bars.lengths(linear.x)
        stiffness[4] = start / lengths
        stiffness[3] = tangent - stiffness[4]
        _, forced, resisting = linear.at(end)
        added = loads(end) - acting - (resisting - internal)
        u = linear.solve(stiffness, added, supports.positions(end) - supports.positions(begin))
        return LinearForces(stiffness, start, forced - force + stretching(u), lengths)
    finally:
        bars.put_history(history)
        model.change_bars(end)

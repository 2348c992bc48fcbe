"""Equations of equilibrium as vectors and matrices of PETSc, for solvers of one's own."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from petsc4py import PETSc

from ..contact.transform import Transform
from ..errors import InputError
from ..parallel.agreement import agreed
from ..solvers.matrix import HessianMatrix
from ..stepping.problem import StepProblem
from .scheme import Equilibrium

if TYPE_CHECKING:
    from ..stepping.stepper import Stepper

__all__ = ["Equations", "WithEquations"]


class Equations:
    """The out-of-balance force g(x) = f_int(x) - f_ext of positions x, and its derivative. All methods are collective.

    Internal variables are those of the stepper's state and do not change. Walls, pairs and constraints, inertia and
    damping are not in it. A prescribed component has g = s (x - x_prescribed), with a scale s [N/m].

    Parameters
    ----------
    stepper : whose state and model are used
    """

    def __init__(self, stepper: Stepper) -> None:
        self.stepper = stepper
        self._transform = Transform(stepper.model.mesh)
        self._hessian: tuple[int, HessianMatrix] | None = None

    def positions(self, at: float) -> PETSc.Vec:
        """Return the positions of the state, with prescribed components at a load factor or time; see ``residual``."""
        stepper = self.stepper
        x = stepper.state.position.copy()
        supports = stepper.model.supports
        if supports.any:
            supports.place(x, supports.positions(at))
        made = self._vector()
        made.array[:] = x.ravel()
        return made

    def residual(self, x: Any, out: PETSc.Vec | None, at: float) -> PETSc.Vec:
        """Return g(x) [N] in ``out``, or in a new vector.

        Parameters
        ----------
        x : vector of PETSc, or this rank's (owned, 3) [m]
        out : vector for the result
        at : load factor of a static case, else the time [s], of loads, supports and temperatures

        Raises
        ------
        InputError
            On all ranks, if ``x`` has another size.
        """
        stepper = self.stepper
        model, state = stepper.model, stepper.state
        place = self._placed(x)
        problem, u = self._problem(place, at)
        g = np.empty_like(u)
        changed = model.bars_vary
        try:
            if changed:
                model.change_bars(at)
            problem.imbalance(u, g)
        finally:
            if changed:
                model.change_bars(state.time)
        supports = model.supports
        if supports.any:
            supports.put(g, problem.scale * (supports.coordinates(place) - supports.positions(at)))
        out = self._vector() if out is None else out
        out.setArray(g.ravel())
        return out

    def hessian(self, x: Any, at: float) -> PETSc.Mat:
        """Return dg/dx [N/m] in the matrix that earlier calls have returned; see :meth:`residual`."""
        stepper = self.stepper
        model = stepper.model
        problem, u = self._problem(self._placed(x), at)
        matrix = self._matrix()
        problem.place(u)
        changed = model.bars_vary
        try:
            if changed:
                model.change_bars(at)
            return matrix.fill(lambda values: problem.hessian_here(matrix, values))
        finally:
            if changed:
                model.change_bars(stepper.state.time)

    def destroy(self) -> None:
        """Free the matrix."""
        if self._hessian is not None:
            self._hessian[1].destroy()
            self._hessian = None

    def _vector(self) -> PETSc.Vec:
        mesh = self.stepper.model.mesh
        return PETSc.Vec().createMPI((3 * mesh.n_owned, 3 * mesh.n_nodes), bsize=3, comm=mesh.comm)

    def _placed(self, x: Any) -> np.ndarray:
        """Return positions as an array (owned, 3)."""
        mesh = self.stepper.model.mesh
        values = x.getArray(readonly=True) if isinstance(x, PETSc.Vec) else np.asarray(x, dtype=np.float64)
        with agreed(mesh.comm):
            if values.size != 3 * mesh.n_owned:
                raise InputError(
                    f"positions: {values.size} numbers on rank {mesh.comm.rank}, which has {mesh.n_owned} nodes: give "
                    "three for each, as a vector of Simulation.position_vector() has"
                )
        return values.reshape(-1, 3)

    def _problem(self, place: np.ndarray, at: float) -> tuple[StepProblem, np.ndarray]:
        """Return the problem of equilibrium at a load factor or time, and the increments to positions."""
        stepper = self.stepper
        model, state = stepper.model, stepper.state
        external = np.zeros_like(state.position)
        if model.external.active:
            if model.external.state_forces:
                model.external.follow(place, state.v)
            model.external.at(at, external)
        problem = StepProblem(model, state, Equilibrium().balance(state, 0.0), external, self._transform)
        return problem, place - problem.balance.predictor

    def _matrix(self) -> HessianMatrix:
        """Return the matrix, which is another one after supports have changed."""
        stepper = self.stepper
        if self._hessian is None or self._hessian[0] != stepper.support_changes:
            self.destroy()
            made = HessianMatrix(stepper.model.mesh, stepper.model.supports)
            self._hessian = stepper.support_changes, made
        return self._hessian[1]


class WithEquations:
    """Base of :class:`~pfem_petsc.simulation.Simulation`: its equations of equilibrium."""

    stepper: Stepper
    _of_equilibrium: Equations | None = None

    def _usable(self) -> None:
        """Refuse calls after the simulation was closed."""

    def position_vector(self, at: float | None = None) -> PETSc.Vec:
        """Return the positions of the state as a new vector of PETSc [m], prescribed components as ``at``. Collective.

        Node i of the mesh on this rank has the components 3 i to 3 i + 2 of this rank's part; ``mesh.node_ids`` has
        its mesh number. See :meth:`residual`.
        """
        return self._equations().positions(self._place(at))

    def residual(self, x: PETSc.Vec | np.ndarray, out: PETSc.Vec | None = None, at: float | None = None) -> PETSc.Vec:
        """Return the out-of-balance force f_int(x) - f_ext [N] of positions x as a vector of PETSc. Collective.

        Internal forces are those from the internal variables of the state, which stay as they are. Walls, pairs,
        constraints, inertia and damping are not part of it. For prescribed components it is s (x - x_prescribed) with a
        scale s [N/m], so that the equilibrium with supports is its zero.

        Parameters
        ----------
        x : vector as of :meth:`position_vector`, or this rank's positions (owned, 3) [m]
        out : vector for the result; default: a new one
        at : load factor of a static case (default: its end), else the time [s] (default: that of the state), of loads,
            supports, temperatures and rest lengths

        Raises
        ------
        InputError
            On all ranks, if ``x`` has another size.
        """
        return self._equations().residual(x, out, self._place(at))

    def hessian(self, x: PETSc.Vec | np.ndarray, at: float | None = None) -> PETSc.Mat:
        """Return the derivative of :meth:`residual` by x [N/m], an assembled symmetric matrix of PETSc. Collective.

        Each call fills and returns the same matrix, which belongs to the simulation; copy what you keep. Rows and
        columns of prescribed components are those of s times the identity.
        """
        return self._equations().hessian(x, self._place(at))

    def _equations(self) -> Equations:
        self._usable()
        if self._of_equilibrium is None or self._of_equilibrium.stepper is not self.stepper:
            self._free_equations()
            self._of_equilibrium = Equations(self.stepper)
        return self._of_equilibrium

    def _place(self, at: float | None) -> float:
        if at is not None:
            return float(at)
        static = self.stepper.model.case.static
        return self.stepper.state.time if static is None else float(getattr(static.parameters, "end", None) or 1.0)

    def _free_equations(self) -> None:
        equations, self._of_equilibrium = self._of_equilibrium, None
        if equations is not None:
            equations.destroy()

"""Equilibrium in the form of an integrator's balance, without inertia; its residual and stiffness for solvers of one's
own.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from petsc4py import PETSc

from ..errors import InputError
from ..integrators.base import Balance, NoParameters, Scheme, State
from ..parallel.agreement import agreed

if TYPE_CHECKING:
    from ..solvers.matrix import HessianMatrix, StepProblem
    from ..stepping.model import Model
    from ..stepping.stepper import Stepper

__all__ = ["Equilibrium", "PathEquilibrium", "WithEquations", "problem_at_rest"]


class Equilibrium(Scheme):
    """The balance f_int(x1) = f_ext(t1) + r, where t is the load factor; the unknown is the displacement increment.

    With viscosity C the balance is f_int(x1) + C u/h = f_ext(t1) + r for the displacement u over the increment h.

    The state's memory has ``rate``: displacement per load factor in the last increment, which predicts the next one.

    Parameters
    ----------
    lack : (owned,) viscosity over mass, None without viscosity

    Attributes
    ----------
    releases : whether the balance is that of the state's own load factor, without viscosity
    creeps : whether it is so with viscosity
    """

    inertial = False
    remembers = ("rate",)

    def __init__(self, lack: np.ndarray | None = None) -> None:
        super().__init__(NoParameters())
        self.lack, self.releases, self.creeps = lack, False, False

    def start(self, state: State, h: float) -> None:
        state.memory[self.remembers[0]] = np.zeros_like(state.v)

    def expected_move(self, state: State, h: float) -> np.ndarray:
        return h * state.memory[self.remembers[0]]

    def balance(self, state: State, h: float) -> Balance:
        end = state.time if self.releases or self.creeps else state.time + h
        return Balance(
            alpha=0.0,
            eta=0.0 if self.lack is None or self.releases or not h else 1.0 / h,
            predictor=state.position.copy(),
            v_hat=None,
            a_hat=None,
            time=end,
            loads=((1.0, end),),
            weight=1.0,
        )

    def finish(self, state: State, balance: Balance, u: np.ndarray, h: float) -> None:
        state.position[:] = balance.predictor + u
        if not self.releases and not self.creeps:
            state.memory["rate"] = u / h
        # the viscous force is what equilibrium lacks: the ledger books it as inertia
        state.a = self.lack[:, None] * (u * balance.eta) if balance.eta else np.zeros_like(u)


class PathEquilibrium(Equilibrium):
    """The balance of :class:`Equilibrium` for steps whose displacement and load factor are known in advance.

    ``reached`` is the load factor of the next point.
    The state's memory has ``tangent``: the displacement part of the unit tangent of the path at the state.
    """

    remembers = ("tangent",)

    def __init__(self) -> None:
        super().__init__()
        self.reached = 0.0

    def balance(self, state: State, h: float) -> Balance:
        """Return the balance at the load factor reached; ``h`` is a length, not an increment of the load factor."""
        return replace(super().balance(state, 0.0), time=self.reached, loads=((1.0, self.reached),))

    def finish(self, state: State, balance: Balance, u: np.ndarray, h: float) -> None:
        state.position[:] = balance.predictor + u
        state.a = np.zeros_like(u)


def problem_at_rest(model: Model, state: State, external: np.ndarray) -> StepProblem:
    """Return the problem of equilibrium of a state under external forces (owned, 3) [N], without walls. Collective."""
    from ..contact.transform import Transform
    from ..solvers.matrix import StepProblem

    return StepProblem(model, state, Equilibrium().balance(state, 0.0), external, Transform(model.mesh))


class WithEquations:
    """Base of :class:`~pfem_petsc.simulation.Simulation`: equations of equilibrium as vectors and matrices of PETSc.

    Internal variables are those of the stepper's state and do not change. Methods are collective.
    """

    stepper: Stepper
    _stiffness: tuple[Stepper, int, HessianMatrix] | None = None

    def _usable(self) -> None:
        """Refuse calls after the simulation was closed."""

    def position_vector(self, at: float | None = None) -> PETSc.Vec:
        """Return the positions of the state as a new vector of PETSc [m], prescribed components as ``at``. Collective.

        Node i of the mesh on this rank has the components 3 i to 3 i + 2 of this rank's part; ``mesh.node_ids`` has
        its mesh number. See :meth:`residual`.
        """
        self._usable()
        position, supports = self.stepper.state.position.copy(), self.stepper.model.supports
        supports.place(position, supports.positions(self._place(at)))
        made = self._vector()
        made.array[:] = position.ravel()
        return made

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
        supports = self.stepper.model.supports
        with self._problem(x, at) as (place, positions, problem):
            g = np.empty_like(positions)
            problem.imbalance(positions - problem.balance.predictor, g)
        supports.put(g, problem.scale * (supports.coordinates(positions) - supports.positions(place)))
        out = self._vector() if out is None else out
        out.setArray(g.ravel())
        return out

    def hessian(self, x: PETSc.Vec | np.ndarray, at: float | None = None) -> PETSc.Mat:
        """Return the derivative of :meth:`residual` by x [N/m], an assembled symmetric matrix of PETSc. Collective.

        Each call fills and returns the same matrix, which belongs to the simulation; copy what you keep. Rows and
        columns of prescribed components are those of s times the identity.
        """
        from ..solvers.matrix import HessianMatrix

        stepper = self.stepper
        with self._problem(x, at) as (_, positions, problem):
            if self._stiffness is None or self._stiffness[:2] != (stepper, stepper.support_changes):
                self._free_equations()
                made = HessianMatrix(stepper.model.mesh, stepper.model.supports)
                self._stiffness = stepper, stepper.support_changes, made
            matrix = self._stiffness[2]
            problem.place(positions - problem.balance.predictor)
            return matrix.assemble(problem)

    @contextmanager
    def _problem(self, x: Any, at: float | None) -> Iterator[tuple[float, np.ndarray, StepProblem]]:
        """Give the load factor or time, positions (owned, 3), and the problem, with the bars as they are there."""
        self._usable()
        model, state, place = self.stepper.model, self.stepper.state, self._place(at)
        values = x.getArray(readonly=True) if isinstance(x, PETSc.Vec) else np.asarray(x, dtype=np.float64)
        with agreed(model.comm):
            if values.size != 3 * model.mesh.n_owned:
                raise InputError(
                    f"positions: {values.size} numbers on rank {model.comm.rank}, which has {model.mesh.n_owned} "
                    "nodes: give three for each, as a vector of Simulation.position_vector() has"
                )
        positions = values.reshape(-1, 3)
        external = np.zeros_like(state.position)
        if model.external.active:
            if model.external.state_forces:
                model.external.follow(positions, state.v)
            model.external.at(place, external)
        problem = problem_at_rest(model, state, external)
        try:
            model.change_bars(place)
            yield place, positions, problem
        finally:
            model.change_bars(state.time)

    def _place(self, at: float | None) -> float:
        """The load factor or time that ``at`` means."""
        static = self.stepper.model.case.static
        if at is not None:
            return float(at)
        return self.stepper.state.time if static is None else float(getattr(static.parameters, "end", None) or 1.0)

    def _vector(self) -> PETSc.Vec:
        mesh = self.stepper.model.mesh
        return PETSc.Vec().createMPI((3 * mesh.n_owned, 3 * mesh.n_nodes), bsize=3, comm=mesh.comm)

    def _free_equations(self) -> None:
        if self._stiffness is not None:
            self._stiffness[2].destroy()
            self._stiffness = None

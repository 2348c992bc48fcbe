"""Increments of the load factor, each an equilibrium found by Newton's method, or by bounds where walls are near."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Protocol

import numpy as np
from mpi4py import MPI

from ..errors import NotConverged, SimulationFailure
from ..integrators.base import Balance
from ..solvers.linear import DIRECT, LinearChoice
from ..stepping.implicit import ImplicitStepper
from ..stepping.prescribed import NoRates
from ..stepping.solution import Solution
from ..tolerances import TIME
from .free_motions import free_motions
from .redistribution import hold_detached, redistribute
from .scheme import Equilibrium

if TYPE_CHECKING:
    from ..stepping.model import Model

__all__ = ["StaticStepper"]

_FEW = 5  # maximum number of Newton iterations after which the next increment is larger
_GROWTH = 1.5
_RESISTANCE = 1e-3  # viscosity over stiffness with which a truss that nothing holds yet is moved against walls


class Increments(Protocol):
    """First, smallest and largest increment of the load factor, and the last load factor."""

    step: float
    smallest: float
    largest: float
    end: float


class StaticStepper(ImplicitStepper):
    """Advances the equilibrium from one load factor to the next; the state's time is the load factor.

    An increment that does not converge, or that the guard rejects, is halved; after an increment with few Newton
    iterations the next one is larger, up to ``largest``.

    Parameters
    ----------
    model : Model
    choice : LinearChoice
    limits : first, smallest and largest increment of the load factor, and the last load factor
    stabilise : viscosity of the nodes over their stiffness

    Attributes
    ----------
    increment : the next increment
    dissipated : energy dissipated by the viscosity of ``stabilise`` [J]
    """

    kept_numbers = (*ImplicitStepper.kept_numbers, "increment", "dissipated")
    columns = ("load_factor",)
    remedy = "reduce static.step"

    def __init__(self, model: Model, choice: LinearChoice, limits: Increments, stabilise: float = 0.0) -> None:
        viscosity = stabilise * model.nodal_stiffness
        model.inertia.damp(viscosity)  # that of materials has no meaning without time
        lack = viscosity / model.inertia.mass if stabilise else None
        super().__init__(model, Equilibrium(lack), limits.step, choice)
        model.bars.step = np.inf  # laws that depend on the rate are at their limit of slow loading
        self.prescribed = NoRates(self)
        self.stabilise, self.dissipated = stabilise, 0.0
        self.limits, self.increment, self.end = limits, limits.step, limits.end

    @property
    def load_factor(self) -> float:
        """Load factor of the state."""
        return self.state.time

    @property
    def done(self) -> bool:
        """Whether the last load factor is reached."""
        return self.state.time >= self.end * (1.0 - TIME)

    def when(self, balance: Balance) -> str:
        return f"step {self.number + 1}, load factor {balance.time:.6g}"

    def arrived(self) -> str:
        return f"step {self.number + 1}, load factor {self.state.time:.6g}"

    def start(self) -> None:
        """Initialise the state at load factor zero; the first increment is equilibrated. Collective."""
        state, model = self.state, self.model
        model.bars.step = 0.0
        if model.bars.can_break:
            hold_detached(self)
        self.start_without_motion()
        model.bars.step = np.inf
        # the force that the state lacks to equilibrium (heat, a stage before) does work in the first increment, which
        # the ledger books as that of inertia
        lack = state.external - state.f[: model.mesh.n_owned] + state.contact + state.support
        state.a = lack / model.inertia.mass[:, None]
        self.totals_at_start = self.totals()
        self.scheme.start(state, self.h)
        model.contact.motion.start(self.h)

    def acceleration(self) -> np.ndarray:
        """See :class:`~pfem_petsc.stepping.stepper.Stepper`; zero."""
        return np.zeros_like(self.state.a)

    def step(self) -> None:
        """Find the equilibrium at the next load factor.

        Raises
        ------
        NotConverged
            On all ranks, if the smallest increment does not converge.
        """
        state, reached = self.state, min(self.end, self.removals.ends())
        left = reached - state.time
        size = self.increment if self.increment < left * (1.0 - TIME) else left
        while True:
            self._set_part(size)
            self.smallest = size
            end = reached if size == left else state.time + size
            try:
                self._make_part(end)
                break
            except NotConverged as failure:
                self.name_obstacle(failure)
                if self.model.bars_vary:
                    # the failed solve has applied the temperatures and rest lengths of its end
                    self.model.change_bars(state.time)
                if 0.5 * size < self.limits.smallest:
                    raise self._no_further(failure) from failure
                size *= 0.5
                self.message(f"{failure}; halving the increment, to {size:.4g}")
        self.increment = size
        if self.solution.newton <= _FEW:
            self.increment = max(size, min(_GROWTH * size, self.limits.largest))
        if self.stabilise:
            self._count_dissipation(size)
            if self.done:
                self._release()
        self.leave()
        state.step += 1

    def obstacle(self) -> str:
        """Return a message about motions that nothing resists at the start; empty if there are none. Collective.

        Nor where increments of any size may give the truss a stiffness, or need none.
        """
        model = self.model
        if self.stabilise or model.bars_vary or model.supports.moves or self._choice.preconditioner not in DIRECT:
            return ""
        found = free_motions(model, self.state)
        if not found:
            return ""
        return (
            f"{model.case.source}: static: the stiffness is singular at the start{found}; "
            'static.method = "relaxation" and [time] do not need them'
        )

    def name_obstacle(self, failure: NotConverged) -> None:
        """Raise an error about motions without stiffness if the first increment has failed by them. Collective."""
        obstacle = "" if self.state.step else self.obstacle()
        if obstacle:
            raise SimulationFailure(obstacle) from failure

    def _solve(self, balance: Balance, guess: np.ndarray) -> Solution:
        """Solve; a truss that nothing holds before contact forces act is first moved against walls and links.

        Their forces, and whether nodes stick, are not known before the first contact, and the stiffness may be
        singular without them. A viscous force makes it regular; its solution is the guess.
        """
        try:
            return super()._solve(balance, guess)
        except NotConverged:
            if balance.eta or not self._untouched():
                raise
        inertia = self.model.inertia
        damping = inertia.damping
        inertia.damp(_RESISTANCE * self.model.nodal_stiffness)
        try:
            approach = super()._solve(replace(balance, eta=1.0), guess)
        finally:
            inertia.damp(damping)
        return super()._solve(balance, approach.u)

    def _untouched(self) -> bool:
        """Return whether contact is possible and nothing is in contact at the start of the increment. Collective."""
        model = self.model
        return model.can_touch and not model.comm.allreduce(int(self.state.contact.any()), op=MPI.MAX)

    def leave(self) -> None:
        """See :func:`~pfem_petsc.statics.redistribution.redistribute`. Collective."""
        redistribute(self)

    def resume(self) -> None:
        """See :class:`~pfem_petsc.stepping.stepper.Stepper`. Collective."""
        super().resume()
        if self.model.bars.can_break:
            kept = self.lagged_count, self.lagged_place, self.lagged_history
            hold_detached(self)
            self.lagged_count, self.lagged_place, self.lagged_history = kept

    def _count_dissipation(self, size: float) -> None:
        u = self.solution.u
        local = float((self.model.inertia.damping[:, None] * u * u).sum()) / size
        self.dissipated += self.model.comm.allreduce(local)

    def _release(self) -> None:
        """Find the equilibrium at the last load factor without the viscosity. Collective."""
        self.scheme.releases = True
        try:
            self._make_part(self.end)
        except NotConverged as failure:
            raise SimulationFailure(
                f"load factor {self.end:.6g} was reached with static.stabilise, but there is no equilibrium "
                f"nearby without it: reduce static.stabilise or static.step. The last attempt: {failure}"
            ) from failure
        finally:
            self.scheme.releases = False

    def remarks(self) -> list[str]:
        """Return what the viscosity has dissipated. Collective."""
        if not self.stabilise:
            return []
        stored = self.model.comm.allreduce(self.energy.total)
        share = f", {100.0 * self.dissipated / stored:.3g} % of the energy of the bars" if stored > 0.0 else ""
        return [f"static.stabilise has dissipated {self.dissipated:.6g} J{share} (damping_dissipation)"]

    def settle(self) -> None:
        """Solve once more at the load factor that is reached, to rounding: motion that begins there begins at rest."""
        state, guard = self.state, self.guard
        balance = Equilibrium().balance(state, 0.0)
        self.accuracy, self.guard = 0.0, None
        try:
            self.solution = ImplicitStepper.solve(self, balance)
        except NotConverged:
            return
        finally:
            self.accuracy, self.guard = 1.0, guard
        state.position[:] = balance.predictor + self.solution.u
        self.evaluate(commit=True)

    def _no_further(self, failure: NotConverged) -> SimulationFailure:
        """Return the message about the load factor beyond which no equilibrium was found."""
        slips = ""
        others = (
            'static.method = "arc_length" follows the path beyond a limit point, static.stabilise and dynamic stages '
            'pass jumps, such as struts that snap, and "relaxation" finds the equilibrium of slack structures'
        )
        if self.model.can_touch:
            others = "static.stabilise, or supports that move the truss instead of loads, pass a limit point"
            if self.model.contact.any and self.model.contact.symmetric:
                others = f"walls without friction do not hold nodes along them: add supports; {others}"
            elif self.model.contact.any:
                slips = ", or the friction of walls does not hold it"
        return SimulationFailure(
            f"no equilibrium found beyond load factor {self.state.time:.6g} with increments down to "
            f"{self.limits.smallest:.3g}: it is a limit point, or part of the truss is a mechanism{slips}; "
            f"{others}. The last attempt: {failure}{free_motions(self.model, self.state)}"
        )

    def _guess(self, balance: Balance) -> np.ndarray:
        """Return the increment proportional to the last one, with prescribed components at exact positions."""
        guess = self.scheme.expected_move(self.state, balance.time - self.state.time)
        supports = self.model.supports
        if supports.any:
            supports.put(guess, supports.lacking(balance.predictor, balance.time))
        return guess

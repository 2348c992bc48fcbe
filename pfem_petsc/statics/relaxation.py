"""Increments of the load factor by dynamic relaxation, with the last digits by Newton's method."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ..contact.active_set import ActiveSet
from ..contact.candidates import Candidates, expected_candidates
from ..errors import InputError, NotConverged, SimulationFailure
from ..integrators.base import Balance
from ..stepping.solution import Solution
from ..tolerances import TIME
from .minimum import MinimumCheck
from .pseudo_motion import PseudoMotion
from .stepper import StaticStepper

if TYPE_CHECKING:
    from ..solvers.linear import LinearChoice
    from ..stepping.model import Model
    from .methods.relaxation import Parameters

__all__ = ["RelaxationStepper"]

# residuals relative to the load at which Newton's method is tried; the last one alone for large models
_HANDOVERS = (1e-2, 1e-4, 1e-6)
_NEAR = 0.05  # relative to the model's length: a solution farther from the relaxed positions is another equilibrium
_DOWN = 1e-10  # relative to the energies: allowed rise of the energy above the relaxed positions, by rounding


class RelaxationStepper(StaticStepper):
    """Finds each equilibrium from the positions of the previous one, at any distance, by a pseudo-motion.

    Internal variables of bars are updated once, from the previous equilibrium to the new one; the path of the
    pseudo-motion does not affect them. The solution of Newton's method, tried from the relaxed positions, is accepted
    if it is near, its energy is not higher, and it is a minimum: the residual is small near an unstable equilibrium,
    too. Otherwise relaxation continues to its own tolerance.

    Attributes
    ----------
    pseudo_steps : of the last increment
    residual : relative to the load, at the end of relaxation in the last increment
    """

    kept_numbers = (*StaticStepper.kept_numbers, "pseudo_steps", "residual")
    columns = (*StaticStepper.columns, "pseudo_steps", "residual")

    def __init__(self, model: Model, choice: LinearChoice, parameters: Parameters) -> None:
        _check(model)
        super().__init__(model, choice, parameters)
        self.parameters = parameters
        self.guard = None  # relaxation allows large rotations
        self.motion = PseudoMotion(model, parameters.damping)
        self.minimum = MinimumCheck(model) if parameters.newton else None
        self.pseudo_steps, self.residual = 0, 0.0

    def step(self) -> None:
        """Find the equilibrium at the next load factor.

        Raises
        ------
        SimulationFailure
            On all ranks, if relaxation does not converge in ``max_iterations`` pseudo-steps.
        """
        state, end = self.state, min(self.end, self.removals.ends())
        left = end - state.time
        last = left <= self.limits.step * (1.0 + TIME)
        size = left if last else self.limits.step
        self._set_part(size)
        self.smallest = size
        self._make_part(end if last else state.time + size)
        self.leave()
        state.step += 1

    def obstacle(self) -> str:
        """See :class:`StaticStepper`: relaxation needs no stiffness. Collective."""
        return ""

    def supports_changed(self) -> None:
        """See :class:`~pfem_petsc.stepping.stepper.Stepper`. Collective."""
        super().supports_changed()
        if self.minimum is not None:
            self.minimum.destroy()
            self.minimum = MinimumCheck(self.model)

    def settle(self) -> None:
        """See :class:`StaticStepper`. Collective."""
        self.motion.x[:] = self.state.x
        super().settle()

    def solve(self, balance: Balance) -> Solution:
        """See :meth:`~pfem_petsc.stepping.stepper.Stepper.solve`."""
        model, motion, parameters = self.model, self.motion, self.parameters
        if model.bars_vary:
            model.change_bars(balance.time)
        motion.begin(self.state, balance.time, self.state.external)
        stages = [share for share in self._handovers if share > parameters.tolerance]
        for share in (*stages, parameters.tolerance):
            done = motion.relax(share, parameters.max_iterations)
            if not done:
                raise self._unfinished()
            self.pseudo_steps, self.residual = motion.steps, motion.norm / (motion.load or 1.0)
            if parameters.newton:
                solution = self._polish(balance)
                if solution is not None:
                    return solution
        solution = self._relaxed(balance)
        if self.minimum is not None and self.minimum.refusal is None and balance.time < self.end * (1.0 - TIME):
            self.negatives = self.minimum.falling(motion.x, solution.walls, motion.time)
            for text in self._instability(motion.time):
                self.message(text)
        return solution

    @property
    def _handovers(self) -> tuple[float, ...]:
        """Residuals relative to the load at which Newton's method is tried."""
        if self.minimum is None:
            return ()
        return _HANDOVERS if self.minimum.refusal is None else _HANDOVERS[-1:]

    def _polish(self, balance: Balance) -> Solution | None:
        """Return the solution of Newton's method from the relaxed positions, None if none is near. Collective."""
        state, model, motion = self.state, self.model, self.motion
        kept = state.contact, state.support, self.held
        self.held = np.zeros_like(self.held)
        self.held[motion.held] = True
        try:
            solution = super().solve(balance)
        except NotConverged:
            state.contact, state.support, self.held = kept
            return None
        x = balance.predictor + solution.u
        away = np.linalg.norm(x - motion.x[: len(x)], axis=1).max(initial=0.0)
        after = self.with_ghosts(x)
        energy = model.bars.forces(after, np.empty_like(after), commit=False)
        here, size = motion.potential(motion.x[: len(x)], motion.energy)
        there, _ = motion.potential(x, energy)
        reached, collapsed = max(model.comm.allgather(float(away))), model.comm.allgather(energy.failed >= 0)
        failed = reached > _NEAR * model.length or there > here + _DOWN * size or sum(collapsed) > 0
        if not failed and self.minimum.refusal is None:
            failed = self.minimum.falling(after, solution.walls, balance.time) > 0
        if failed:
            state.contact, state.support, self.held = kept
            return None
        return solution

    def _relaxed(self, balance: Balance) -> Solution:
        """Return the relaxed positions as the solution."""
        state, model, motion = self.state, self.model, self.motion
        owned = model.mesh.n_owned
        state.contact = motion.contact.copy()
        state.support = model.supports.part(motion.f[:owned] - state.external - state.contact)
        pushed = (motion.contact[motion.held] != 0.0).any(axis=1)
        self.held = np.zeros_like(self.held)
        self.held[motion.held[pushed]] = True
        self.resolution.note(model, motion.x, motion.load, motion.norm, self.parameters.tolerance * motion.load)
        u = motion.x[:owned] - balance.predictor
        return Solution(u, motion.f.copy(), motion.walls, contacts=int(pushed.sum()))

    def _unfinished(self) -> SimulationFailure:
        """Return the message about an increment without convergence."""
        motion, most = self.motion, self.parameters.max_iterations
        size, node = motion.worst()
        return SimulationFailure(
            f"load factor {motion.time:.6g}: relaxation has not converged in {most} pseudo-steps: residual "
            f"{motion.norm:.3g} N, required {self.parameters.tolerance * motion.load:.3g} N; worst at node {node} "
            f"({size:.3g} N). Increase static.max_iterations or static.tolerance; if the residual does not fall, "
            "nothing balances the load there"
        )

    def _candidates(self, active_set: ActiveSet, balance: Balance) -> Candidates:
        """Return the nodes near walls at the relaxed positions. Collective."""
        model, motion = self.model, self.motion
        relaxed = replace(self.state, x=motion.x, v=np.zeros_like(self.state.v))
        displacements = model.contact.motion.displacements(balance.time)
        return expected_candidates(model, relaxed, balance, self.held, displacements)

    def destroy(self) -> None:
        super().destroy()
        if self.minimum is not None:
            self.minimum.destroy()

    def _guess(self, balance: Balance) -> np.ndarray:
        """Return the relaxed positions."""
        return self.motion.x[: self.model.mesh.n_owned] - balance.predictor


def _check(model: Model) -> None:
    """Refuse features that relaxation does not support."""
    case = model.case
    if model.links:
        what = "contact_pair" if case.contact_pair else "constraint"
        raise InputError(
            f'{case.source}: static.method = "relaxation" does not support [[{what}]]; use static.method = "newton"'
        )
    for k, name in enumerate(model.contact.names):
        if model.contact.static_friction[k]:
            raise InputError(
                f'{case.source}: wall {name!r}: friction: with static.method = "relaxation" walls are frictionless, '
                'because the pseudo-motion is not the path along which friction acts; use static.method = "newton", or '
                "remove friction"
            )

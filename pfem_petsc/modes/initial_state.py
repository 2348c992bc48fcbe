"""The state of a case without an analysis: the initial mesh at time zero, whose modes are wanted."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..integrators.base import Balance, NoParameters, Scheme, State
from ..output.units import TIME
from ..stepping.plan import Plan, refuse_motion
from ..stepping.stepper import Solution, Stepper

if TYPE_CHECKING:
    from ..stepping.model import Model

__all__ = ["InitialState"]


class _Nothing(Scheme):
    """A scheme that makes no steps."""

    inertial = False

    def balance(self, state: State, h: float) -> Balance:
        raise NotImplementedError


class InitialState(Stepper):
    """The initial state, which is also the last one: forces, loads and supports at time zero, without steps.
    Construction is collective.

    Raises
    ------
    InputError
        On all ranks, if the case has initial velocities.
    """

    def __init__(self, model: Model) -> None:
        refuse_motion(model.case, "a case with [modes] alone")
        super().__init__(model, _Nothing(NoParameters()), 0.0)
        self.plan = Plan(self.scheme, TIME, {"analysis": "none: modes of the initial state"}, steps=0)

    def start(self) -> None:
        self.start_without_motion()
        self.totals_at_start = self.totals()

    def solve(self, balance: Balance) -> Solution:
        raise NotImplementedError

"""The state of a case without an analysis: the initial mesh at time zero, whose modes are wanted."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..analysis import Analysis, PlanAtRest, Step, refuse_motion
from ..integrators.base import Balance, NoParameters, Scheme, State
from ..output.units import TIME
from ..stepping.stepper import NoRates, Solution, Stepper

if TYPE_CHECKING:
    from ..stepping.model import Model

__all__ = ["InitialState"]


class _Nothing(Scheme):
    """A scheme that makes no steps."""

    inertial = False

    def balance(self, state: State, h: float) -> Balance:
        raise NotImplementedError

    def finish(self, state: State, balance: Balance, u: np.ndarray, h: float) -> None:
        raise NotImplementedError


class _InitialStepper(Stepper):
    """Initialises internal forces, loads and supports at time zero; makes no steps."""

    def __init__(self, model: Model) -> None:
        super().__init__(model, _Nothing(NoParameters()), 0.0)
        self.prescribed = NoRates(self)

    def start(self) -> None:
        self.start_without_motion()
        self.totals_at_start = self.totals()

    def accelerate(self, load: np.ndarray) -> np.ndarray:
        return np.zeros_like(load)

    def solve(self, balance: Balance) -> Solution:
        raise NotImplementedError


class InitialState(Analysis):
    """The initial state, which is also the last one. Construction is collective.

    Parameters
    ----------
    model : Model

    Raises
    ------
    InputError
        On all ranks, if the case has initial velocities.
    """

    last_step = 0
    step_size = 0.0

    def __init__(self, model: Model) -> None:
        refuse_motion(model.case, "a case with [modes] alone")
        self.model = model
        self.stepper = _InitialStepper(model)
        texts = {"analysis": "none: modes of the initial state"}
        self.plan = PlanAtRest(self.stepper.scheme, TIME, texts, steps=0)

    def advance(self) -> Step:
        raise NotImplementedError("the initial state has no steps")

"""The state of a case without an analysis: the initial mesh at time zero."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from ..analysis import Analysis, Step
from ..errors import InputError
from ..integrators.base import Balance, NoParameters, Scheme, State
from ..output.units import TIME, Axis
from ..stepping.stepper import NoRates, Solution, Stepper

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..stepping.model import Model

__all__ = ["InitialState", "InitialStatePlan"]


class _Nothing(Scheme):
    """A scheme that makes no steps."""

    inertial = False

    def __init__(self) -> None:
        super().__init__(NoParameters())

    def balance(self, state: State, h: float) -> Balance:
        raise NotImplementedError

    def finish(self, state: State, balance: Balance, u: np.ndarray, h: float) -> None:
        raise NotImplementedError


class _InitialStepper(Stepper):
    """Initialises internal forces, loads and supports at time zero; makes no steps."""

    def __init__(self, model: Model) -> None:
        super().__init__(model, _Nothing(), 0.0)
        self.prescribed = NoRates(self)

    def start(self) -> None:
        self.start_without_motion()
        self.totals_at_start = self.totals()

    def accelerate(self, load: np.ndarray) -> np.ndarray:
        return np.zeros_like(load)

    def solve(self, balance: Balance) -> Solution:
        raise NotImplementedError


@dataclass(frozen=True)
class InitialStatePlan:
    """The plan of a run without an analysis, which has no steps.

    Attributes
    ----------
    scheme, step, end, steps, linear, axis : as of other plans
    """

    scheme: Scheme = field(default_factory=_Nothing)
    step: float = 0.0
    end: float = 0.0
    steps: int = 0
    linear: None = None
    axis: Axis = TIME

    def beyond(self, steps: np.ndarray, times: np.ndarray) -> np.ndarray:
        """Return which of the recorded steps and times are beyond the end."""
        return steps > 0

    def entries(self, case: Case) -> dict[str, str]:
        """Return label and text of a summary for the user before a run."""
        return {"analysis": "none: modes of the initial state"}

    def record(self) -> dict[str, Any]:
        """Return the numbers that a restart must not compute again."""
        return {}


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
        case = model.case
        if any(any(entry.velocity) or any(entry.angular_velocity) for entry in case.initial):
            raise InputError(
                f"{case.source}: initial: a case with [modes] alone has no velocities; remove the table [initial], or "
                "give the case a table [time]"
            )
        if case.contact.treatment != "scheme":
            raise InputError(
                f'{case.source}: contact.treatment = "{case.contact.treatment}" treats impacts, and a case with '
                "[modes] alone has none; remove the key"
            )
        self.model = model
        self.plan = InitialStatePlan()
        self.stepper = _InitialStepper(model)

    def advance(self) -> Step:
        raise NotImplementedError("the initial state has no steps")

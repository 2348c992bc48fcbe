"""The interface of all analyses, which advance the state of a model."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from .errors import InputError, PfemError
from .integrators.base import Scheme, State
from .tolerances import TIME

if TYPE_CHECKING:
    from .case.schema import Case
    from .output.units import Axis
    from .solvers.linear import LinearChoice

__all__ = ["Analysis", "PlanAtRest", "Step", "refuse_motion"]


class Step(NamedTuple):
    """Report of a finished step.

    Attributes
    ----------
    step, time : number and time [s] of the state after the step
    newton, linear : numbers of iterations
    row : of the history, None if the step has none
    """

    step: int
    time: float
    newton: int
    linear: int
    row: dict[str, Any] | None


class Analysis:
    """Advances a state step by step to its last step, by a stepper.

    Examples are time stepping and static paths, whose time is the load factor. Recording, checkpoints, requests to stop
    and progress use this interface only and do not depend on the analysis. All methods are collective.

    Attributes
    ----------
    plan : resolved settings of the run: ``end``, ``steps``, ``linear``, ``entries``, ``beyond``, ``record``
    stepper : makes the steps
    last_step : number of the last step; larger than any step while it is unknown
    step_size : of the steps, in the unit of the state's time [s]
    """

    plan: Any
    stepper: Any
    last_step: int
    step_size: float

    @property
    def state(self) -> State:
        """The state of this rank's nodes, complete after :meth:`start` and after each step."""
        return self.stepper.state

    @property
    def fault(self) -> PfemError | None:
        """A failure that only this rank knows; raised on all ranks at the next synchronisation."""
        return self.stepper.fault

    def start(self) -> None:
        """Initialise the state; not called if a checkpoint is restored instead.

        Raises
        ------
        PfemError
            On all ranks.
        """
        self.stepper.start()
        self.stepper.leave()

    def obstacle(self) -> str:
        """Return why no step can be made, as far as it is known before the first; empty otherwise."""
        return ""

    def advance(self, most: int = 1) -> Step:
        """Make one step, or up to ``most`` if nothing needs Python between them, and return the last one; its ``row``
        is None, because rows are made by recording.

        Raises
        ------
        SimulationFailure
            On all ranks; the state is the last complete one, or undefined.
        """
        self.stepper.steps(min(most, self.last_step - self.state.step))
        solution = self.stepper.solution
        return Step(self.stepper.number, self.stepper.place, solution.newton, solution.linear, None)

    def close(self) -> None:
        """Free resources that are not freed automatically; the state remains accessible."""
        self.stepper.destroy()


@dataclass(frozen=True)
class PlanAtRest:
    """The plan of a run without motion, for which nothing is computed before.

    Attributes
    ----------
    scheme : the balance without inertia
    axis : of the times in the results
    texts : summary for the user before a run, by label
    step : first increment on the axis
    end : last place on the axis, None where it is not known before
    linear : linear solver, None without equations
    steps : largest number of steps, None where it is not known before
    """

    scheme: Scheme
    axis: Axis
    texts: dict[str, str] = field(default_factory=dict)
    step: float = 0.0
    end: float | None = 0.0
    linear: LinearChoice | None = None
    steps: int | None = None

    def beyond(self, steps: np.ndarray, times: np.ndarray) -> np.ndarray:
        """Return which of the recorded steps and times are beyond the end."""
        return times > (np.inf if self.end is None else self.end * (1.0 + TIME))

    def entries(self, case: Case) -> dict[str, str]:
        """Return label and text of a summary for the user before a run."""
        return self.texts

    def record(self) -> dict[str, Any]:
        """Return the numbers that a restart must not compute again."""
        return {}


def refuse_motion(case: Case, what: str) -> None:
    """Refuse initial velocities and treatments of impact, which ``what`` does not have."""
    if any(any(entry.velocity) or any(entry.angular_velocity) for entry in case.initial):
        raise InputError(f"{case.source}: initial: {what} has no velocities; remove the table [initial], or use [time]")
    if case.contact.treatment != "scheme":
        raise InputError(
            f'{case.source}: contact.treatment = "{case.contact.treatment}" treats impacts, and {what} has none; '
            "remove the key"
        )

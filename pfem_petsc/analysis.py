"""The interface of all analyses, which advance the state of a model."""

from __future__ import annotations

from typing import Any, NamedTuple

from .errors import PfemError
from .integrators.base import State

__all__ = ["Analysis", "Step"]


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

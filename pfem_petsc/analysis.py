"""What advances the state of a model: one interface, whatever the analysis."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, NamedTuple

from .errors import PfemError
from .integrators.base import State

__all__ = ["Analysis", "Step"]


class Step(NamedTuple):
    """What a finished step reports.

    Attributes
    ----------
    step, time : number and time [s] of the state that was reached
    newton, linear : iterations
    row : of the history, None where the step has none
    """

    step: int
    time: float
    newton: int
    linear: int
    row: dict[str, Any] | None


class Analysis(ABC):
    """Advances a state step by step to its last step.

    Time stepping is one; a static path (whose time is the load factor), a relaxation and the modes of vibration of a
    state are others. Recording, checkpoints, requests to stop and progress know nothing but this interface, so that
    none of them asks which analysis runs. All methods are collective.

    Attributes
    ----------
    plan : what the run will do: ``end``, ``steps``, ``linear``, ``entries``, ``beyond``, ``record``
    stepper : makes the steps
    last_step : number of the last step; a number beyond all as long as it is not known
    step_size : of the steps, in the unit of the state's time [s]
    """

    plan: Any
    stepper: Any
    last_step: int
    step_size: float

    @property
    @abstractmethod
    def state(self) -> State:
        """The state of this rank's nodes: complete after :meth:`start` and after each step."""

    @property
    @abstractmethod
    def fault(self) -> PfemError | None:
        """A failure that only this rank knows of yet; raised on all ranks when they next synchronise."""

    @abstractmethod
    def start(self) -> None:
        """Complete the state at the start; not called where a checkpoint is restored instead.

        Raises
        ------
        PfemError
            On all ranks.
        """

    @abstractmethod
    def advance(self) -> Step:
        """Make one step; its ``row`` is None, which only recording knows.

        Raises
        ------
        SimulationFailure
            On all ranks; the state is the last one that was complete, or lost.
        """

    @abstractmethod
    def close(self) -> None:
        """Free what is not freed by itself; the state can still be looked at."""

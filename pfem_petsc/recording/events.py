"""Events of a run that lie between steps: recorded in a table of their own, and told."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from ..analysis import Step
from ..output.vtkhdf import ResultWriter
from .observer import NEVER, Observer

if TYPE_CHECKING:
    from ..stepping.stepper import Stepper

__all__ = ["Events"]


class Events(Observer):
    """Records what a stepper found on the way to its last state: its ``events``, the same on all ranks.

    Parameters
    ----------
    stepper : Stepper
    tell : takes a message

    Attributes
    ----------
    writer : of the result file
    """

    def __init__(self, stepper: Stepper, tell: Callable[[str], None]) -> None:
        self._stepper, self._tell = stepper, tell
        self._root = stepper.model.comm.rank == 0
        self.writer: ResultWriter | None = None

    def due(self, step: int) -> bool:
        """After steps with events."""
        return bool(self._stepper.events)

    def steps_left(self, step: int) -> int:
        """None must be waited for: steppers with events make their steps one by one."""
        return NEVER

    def observe(self, made: Step) -> None:
        """Record and tell them."""
        events, self._stepper.events = self._stepper.events, []
        for event in events:
            self.writer.append_event(event.row() if self._root else None)
            self._tell(str(event))

    def remarks(self) -> list[str]:
        """Where the analysis ended, where that is not known before."""
        return self._stepper.remarks()

"""Events of a run between steps, recorded in a separate table and reported."""

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
    """Records the ``events`` that a stepper found before its last state, the same on all ranks.

    Parameters
    ----------
    stepper : Stepper
    tell : receives a message

    Attributes
    ----------
    writer : of the result file
    """

    def __init__(self, stepper: Stepper, tell: Callable[[str], None]) -> None:
        self._stepper, self._tell = stepper, tell
        self._root = stepper.model.comm.rank == 0
        self.writer: ResultWriter | None = None

    def due(self, step: int) -> bool:
        """Return whether the step has events."""
        return bool(self._stepper.events)

    def steps_left(self, step: int) -> int:
        """Return no limit: steppers with events make single steps."""
        return NEVER

    def observe(self, made: Step) -> None:
        """Record and report the events."""
        events, self._stepper.events = self._stepper.events, []
        for event in events:
            self.writer.append_event(event.row() if self._root else None)
            self._tell(str(event))

    def remarks(self) -> list[str]:
        """Return a remark about the end of the analysis, if it is not known in advance."""
        return self._stepper.remarks()

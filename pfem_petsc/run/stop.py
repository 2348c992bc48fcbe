"""Requests to stop early: signals and the wall time."""

from __future__ import annotations

import signal
import time

from ..output.units import duration
from ..signals import SignalNotes, early

__all__ = ["StopRequest"]

_WALL_TIME = 1000  # code of the wall time, beyond all signals


class StopRequest(SignalNotes):
    """Asks a run to end at the end of a step: because of a signal, or of the wall time, but not before its first step.

    Parameters
    ----------
    wall_time : [s], from now on; None for no limit

    Attributes
    ----------
    stepped : whether the run has made a step
    """

    def __init__(self, wall_time: float | None = None) -> None:
        super().__init__()
        self.wall_time = wall_time
        self.stepped = False
        self._begin = time.monotonic()

    def watch(self) -> None:
        """Take the signals over, those included that came since the program began."""
        super().watch()
        self.adopt(early())

    @property
    def code(self) -> int:
        """Zero while the run may go on."""
        if self._signal:
            return self._signal
        if self.wall_time is not None and self.stepped and time.monotonic() - self._begin >= self.wall_time:
            return _WALL_TIME
        return 0

    def reason(self, code: int) -> str:
        """In words."""
        if code == _WALL_TIME:
            return f"the wall time of {duration(self.wall_time or 0.0)} is over"
        return f"{signal.Signals(code).name} received"

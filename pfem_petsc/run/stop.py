"""Requests to stop early: signals and the wall time."""

from __future__ import annotations

import signal
import time

from ..output.units import duration
from ..signals import SignalNotes, early

__all__ = ["StopRequest"]

_WALL_TIME = 1000  # code of the wall time, larger than all signal numbers


class StopRequest(SignalNotes):
    """Requests that a run stops at the end of a step, after a signal or the wall time, but not before its first step.

    Parameters
    ----------
    wall_time : limit from now on [s]; None for no limit

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
        """Install the signal handlers; signals received since the start of the program count."""
        super().watch()
        self.adopt(early())

    @property
    def code(self) -> int:
        """Code of the request, zero if there is none."""
        if self._signal:
            return self._signal
        if self.wall_time is not None and self.stepped and time.monotonic() - self._begin >= self.wall_time:
            return _WALL_TIME
        return 0

    def reason(self, code: int) -> str:
        """Describe a code."""
        if code == _WALL_TIME:
            return f"the wall time of {duration(self.wall_time or 0.0)} has elapsed"
        return f"{signal.Signals(code).name} received"

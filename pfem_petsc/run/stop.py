"""Requests to stop early: signals and the wall time, and how the ranks agree on them at little cost."""

from __future__ import annotations

import signal
import time

import numpy as np
from mpi4py import MPI

from ..errors import PfemError
from ..output.units import duration
from ..signals import SignalNotes, early

__all__ = ["Meetings", "StopRequest"]

_INTERVAL = 0.2  # seconds between meetings
_MOST = 100  # steps between meetings, so that a fault is known to all within a bounded number of steps
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


class Meetings:
    """Rare agreements of all ranks on what some may know alone: a fault, a request to stop, a checkpoint that is due.

    Every few tenths of a second, and at most every hundred steps, one reduction of four numbers; the ranks agree on the
    step of the next.

    Parameters
    ----------
    comm : MPI.Comm
    stop : StopRequest
    interval : wall-clock time between checkpoints [s], None for none
    """

    def __init__(self, comm: MPI.Comm, stop: StopRequest, interval: float | None = None) -> None:
        self.comm, self.stop, self.interval = comm, stop, interval
        self.checkpoint_due = False
        self._last_checkpoint = time.monotonic()
        self._last = (0, time.monotonic())
        self._next = 0

    def due(self, step: int) -> bool:
        """Whether all ranks meet after this step: the same answer on all."""
        return step >= self._next

    def steps_left(self, step: int) -> int:
        """Steps from here to the next meeting."""
        return self._next - step

    def meet(self, step: int, fault: PfemError | None) -> int:
        """Agree; gives the code of a request to stop, or zero. Collective.

        Raises
        ------
        PfemError
            On all ranks, the fault of the lowest rank that has one.
        """
        now = time.monotonic()
        steps, seconds = step - self._last[0], now - self._last[1]
        ahead = int(np.clip(steps * _INTERVAL / seconds, 1, _MOST)) if steps > 0 and seconds > 0.0 else 1
        late = self.interval is not None and now - self._last_checkpoint >= self.interval
        mine = np.array([self.comm.size - self.comm.rank if fault is not None else 0, self.stop.code, late, -ahead])
        self.comm.Allreduce(MPI.IN_PLACE, mine, op=MPI.MAX)
        first, code, late, ahead = (int(number) for number in mine)
        if first:
            raise self.comm.bcast(fault, root=self.comm.size - first)
        self.checkpoint_due = bool(late)
        self._last = (step, now)
        self._next = step - ahead
        return code

    def checkpoint_written(self) -> None:
        """Count the interval from now."""
        self.checkpoint_due = False
        self._last_checkpoint = time.monotonic()

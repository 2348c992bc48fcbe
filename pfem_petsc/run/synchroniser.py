"""Synchronisation of the ranks about faults and requests to stop that only some of them know."""

from __future__ import annotations

import signal
import time

import numpy as np
from mpi4py import MPI

from ..errors import SimulationFailure
from ..output.lock import FolderLock
from ..output.units import duration
from ..signals import SignalNotes, early
from .stages import Stages

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


_INTERVAL = 0.2  # seconds between synchronisations
_NONE = -(2**62)  # for ranks without a fault
_MOST = 100  # maximum number of steps between them, so that all ranks know of a fault within a bounded number of steps


class Synchroniser:
    """Infrequent agreement of all ranks on faults, requests to stop, and checkpoints that are due.

    About every 0.2 s, and at most every hundred steps, the ranks make one reduction of four numbers, in which they also
    agree on the step of the next one.

    Parameters
    ----------
    stages : Stages
    stop : StopRequest
    lock : FolderLock, renewed at each synchronisation
    interval : wall-clock time between checkpoints [s], None for none

    Attributes
    ----------
    request : code of a request to stop that all ranks know, zero for none
    checkpoint_due : whether the time between checkpoints has elapsed
    """

    def __init__(self, stages: Stages, stop: StopRequest, lock: FolderLock, interval: float | None = None) -> None:
        self.comm, self.stop, self.interval = stages.comm, stop, interval
        self._stages, self.lock = stages, lock
        self.request = 0
        self.checkpoint_due = False
        self._last_checkpoint = time.monotonic()
        self._last = (0, time.monotonic())
        self._next = 0

    @property
    def alarm(self) -> bool:
        """Whether this rank has a fault."""
        return self._stages.stepper.fault is not None or self.stop.code != 0

    def due(self, step: int) -> bool:
        """Return whether all ranks synchronise after this step; equal on all ranks."""
        return step >= self._next or (self.comm.size == 1 and self.alarm)

    def steps_left(self, step: int) -> int:
        """Return the number of steps to the next synchronisation."""
        return self._next - step

    def synchronise(self) -> int:
        """Synchronise; return the code of a request to stop, or zero. Collective.

        Raises
        ------
        PfemError
            On all ranks: the earliest fault, of the lowest rank that has one; later ones may be its consequences.
        """
        stepper = self._stages.stepper
        fault, step = stepper.fault, stepper.number
        since = stepper.fault_step if fault is not None else step
        try:
            self.lock.renew()
        except SimulationFailure as lost:
            fault = fault or lost
        now = time.monotonic()
        steps, seconds = step - self._last[0], now - self._last[1]
        ahead = int(np.clip(steps * _INTERVAL / seconds, 1, _MOST)) if steps > 0 and seconds > 0.0 else 1
        late = self.interval is not None and now - self._last_checkpoint >= self.interval
        order = -(since * self.comm.size + self.comm.rank) if fault is not None else _NONE
        mine = np.array([order, self.stop.code, late, -ahead])
        self.comm.Allreduce(MPI.IN_PLACE, mine, op=MPI.MAX)
        first, code, late, ahead = (int(number) for number in mine)
        if first != _NONE:
            raise self.comm.bcast(fault, root=-first % self.comm.size)
        self.checkpoint_due = bool(late)
        self._last = (step, now)
        self._next = step - ahead
        self.request = code
        return code

    def checkpoint_written(self) -> None:
        """Restart the interval between checkpoints."""
        self.checkpoint_due = False
        self._last_checkpoint = time.monotonic()

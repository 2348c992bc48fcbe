"""How the ranks agree, at little cost, on what only some of them know: faults, requests to stop."""

from __future__ import annotations

import time

import numpy as np
from mpi4py import MPI

from ..analysis import Analysis
from ..errors import SimulationFailure
from ..output.lock import FolderLock
from .stop import StopRequest

__all__ = ["Synchroniser"]

_INTERVAL = 0.2  # seconds between synchronisations
_MOST = 100  # steps between them, so that a fault is known to all within a bounded number of steps


class Synchroniser:
    """Rare agreements of all ranks on what some may know alone: a fault, a request to stop, a checkpoint that is due.

    Every few tenths of a second, and at most every hundred steps, one reduction of four numbers; the ranks agree on the
    step of the next.

    Parameters
    ----------
    comm : MPI.Comm
    analysis : Analysis
    stop : StopRequest
    lock : FolderLock, renewed each time
    interval : wall-clock time between checkpoints [s], None for none

    Attributes
    ----------
    request : code of a request to stop that all ranks know of, zero for none
    checkpoint_due : whether the time between checkpoints is over
    """

    def __init__(
        self,
        comm: MPI.Comm,
        analysis: Analysis,
        stop: StopRequest,
        lock: FolderLock,
        interval: float | None = None,
    ) -> None:
        self.comm, self.stop, self.interval = comm, stop, interval
        self._analysis, self._lock = analysis, lock
        self.request = 0
        self.checkpoint_due = False
        self._last_checkpoint = time.monotonic()
        self._last = (0, time.monotonic())
        self._next = 0

    @property
    def alarm(self) -> bool:
        """Whether this rank has something that all must know of."""
        return self._analysis.fault is not None or self.stop.code != 0

    def due(self, step: int) -> bool:
        """Whether all ranks synchronise after this step: the same answer on all."""
        return step >= self._next

    def steps_left(self, step: int) -> int:
        """Steps from here to the next synchronisation."""
        return self._next - step

    def synchronise(self) -> int:
        """Agree; gives the code of a request to stop, or zero. Collective.

        Raises
        ------
        PfemError
            On all ranks, the fault of the lowest rank that has one.
        """
        fault, step = self._analysis.fault, self._analysis.state.step
        try:
            self._lock.renew()
        except SimulationFailure as lost:
            fault = fault or lost
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
        self.request = code
        return code

    def checkpoint_written(self) -> None:
        """Count the interval from now."""
        self.checkpoint_due = False
        self._last_checkpoint = time.monotonic()

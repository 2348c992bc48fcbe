"""The end of all ranks after a failure of one: the others may wait for it in a collective call, forever.

Where ranks can agree, they do (:mod:`~pfem_petsc.parallel.agreement`). A rank that others do not join within the grace
time is alone: the exception goes up to where it is told, and all ranks are ended there.
"""

from __future__ import annotations

import atexit
import gc
import os
import sys
import time
from collections.abc import Callable
from functools import cache
from types import FrameType, TracebackType

from mpi4py import MPI

__all__ = ["GRACE", "all_arrive", "arrives", "aside", "is_alone", "passes_exception", "watch"]

GRACE = 3.0
"""Seconds in which other ranks must arrive where a rank has failed; after that the job is aborted."""

_TAG = 32001  # of messages at the end


@cache
def _key() -> int:
    """The key of what :func:`aside` attaches; MPI may start after the import of this module, or not at all."""
    return MPI.Comm.Create_keyval()


def aside(comm: MPI.Comm) -> MPI.Comm:
    """Return a communicator of the same ranks, always the same one, whose messages match no others. The first call is
    collective."""
    found = comm.Get_attr(_key())
    if found is None:
        found = comm.Dup()
        comm.Set_attr(_key(), found)
    return found


class _Watch:
    """Ends all ranks where this one ends by a failure that others do not share.

    Attributes
    ----------
    alone : whether others did not arrive where this rank has failed
    """

    def __init__(self) -> None:
        self.alone = False
        self._process, self._status = 0, 0

    def begin(self) -> None:
        """Take over exceptions that nobody catches and the status with which the program ends."""
        if not MPI.Is_initialized() or MPI.COMM_WORLD.size == 1 or self._process:
            return
        self._process = os.getpid()
        self._tell, sys.excepthook = sys.excepthook, self._uncaught
        self._exit, sys.exit = sys.exit, self._leave
        atexit.register(self._at_exit)

    def _uncaught(self, kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        self._tell(kind, error, trace)
        if not (hasattr(sys, "ps1") or sys.flags.interactive):  # the user goes on
            self._end(1)

    def _leave(self, status: object = None) -> None:
        # the command line ends all ranks itself
        if f"{__package__.partition('.')[0]}.cli.main" not in sys.modules:
            self._status = status if isinstance(status, int) else int(status is not None)
        self._exit(status)

    def _at_exit(self) -> None:
        if self.alone or self._status:
            self._end(self._status or 1)

    def _end(self, status: int) -> None:
        if os.getpid() != self._process or MPI.Is_finalized() or self._all_fail():
            return
        sys.stdout.flush()
        text = f"rank {MPI.COMM_WORLD.rank} has failed alone: the other ranks, which may wait for it, are ended"
        print(text, file=sys.stderr, flush=True)
        MPI.COMM_WORLD.Abort(status)

    @staticmethod
    def _all_fail() -> bool:
        """Return whether all ranks of the job come here within the grace time. Others may be in a collective call: only
        messages from rank to rank match nothing else."""
        world, room = MPI.COMM_WORLD, bytearray(1)
        if world.rank:
            world.Isend(room, 0, _TAG)
            return arrives(world.Irecv(bytearray(1), 0, _TAG).Test)
        requests = [world.Irecv(bytearray(1), rank, _TAG) for rank in range(1, world.size)]
        if not arrives(lambda: MPI.Request.Testall(requests)):
            return False
        MPI.Request.Waitall([world.Isend(room, rank, _TAG) for rank in range(1, world.size)])
        return True


_WATCH = _Watch()


def watch() -> None:
    """End all ranks from now on if this one ends by an exception that nobody catches, or by ``sys.exit`` with a status
    that is not zero, and others do not. Programs on one rank end as ever."""
    _WATCH.begin()


def is_alone() -> bool:
    """Return whether others have not arrived where this rank has failed, so that nothing collective is possible."""
    return _WATCH.alone


def arrives(test: Callable[[], bool], hopeless: Callable[[], bool] = lambda: True) -> bool:
    """Return whether the other ranks complete an operation, by a ``test`` of it, after a failure here: within the grace
    time, if it is ``hopeless`` to wait for longer."""
    deadline = time.monotonic() + GRACE
    while not _WATCH.alone and not test():
        if time.monotonic() > deadline:
            _WATCH.alone, deadline = hopeless(), float("inf")
        time.sleep(0.005)
    return not _WATCH.alone


def all_arrive(comm: MPI.Comm) -> bool:
    """Return whether every rank arrives here within the grace time."""
    return not _WATCH.alone and arrives(comm.Ibarrier().Test)


def passes_exception(frame: FrameType | None) -> bool:
    """Return whether an exception is on its way through a frame that ends an iteration; else it has been left by
    ``break`` or ``return``. Python does not tell, but an exception has a traceback, with the place in the frame."""
    found = (one for one in gc.get_referrers(frame) if isinstance(one, TracebackType))
    return any(one.tb_frame is frame and one.tb_lasti == frame.f_lasti for one in found)

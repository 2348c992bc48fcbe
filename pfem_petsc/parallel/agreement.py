"""Collective handling of errors, and the end of all ranks after a failure of one.

If one rank raises a known error, all ranks raise the same one. Others may wait for a rank that has failed in a
collective call, forever: a rank that they do not join within the grace time is alone; the exception goes up to where it
is told, and all ranks are ended there.
"""

from __future__ import annotations

import atexit
import gc
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr
from functools import cache
from io import StringIO
from types import FrameType, TracebackType
from typing import Any, TypeVar

import numpy as np
from mpi4py import MPI

from ..errors import PfemError, SimulationFailure, raised

__all__ = [
    "GRACE",
    "agreed",
    "agreed_call",
    "all_arrive",
    "arrives",
    "aside",
    "is_alone",
    "on_root",
    "outcome",
    "passes_exception",
    "watch",
]


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
        with redirect_stderr(
            StringIO()
        ) as told:  # in one piece: ranks that fail together write into one another's lines
            self._tell(kind, error, trace)
        print(told.getvalue(), end="", file=sys.stderr, flush=True)
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


T = TypeVar("T")


@contextmanager
def agreed(comm: MPI.Comm) -> Iterator[None]:
    """Context that runs a block on all ranks; if any raises a :class:`PfemError`, all raise that of the lowest rank.

    The block must not communicate, because ranks may leave it early. Collective.
    """
    error: PfemError | None = None
    try:
        yield
    except PfemError as caught:
        error = caught
    first = comm.allreduce(comm.rank if error is not None else comm.size, op=MPI.MIN)
    if first < comm.size:
        raise comm.bcast(error, root=first)


def outcome(comm: MPI.Comm, fails: bool, hopeless: Callable[[], bool] = lambda: True) -> tuple[int, bool] | None:
    """Return the lowest rank that fails, the number of ranks if none does, and whether all do. Collective.

    Where this rank fails and the others do not arrive within the grace time, it is None if that is ``hopeless``, and
    this rank waits on otherwise.
    """
    both = np.array([comm.rank if fails else comm.size, fails])
    request = aside(comm).Iallreduce(MPI.IN_PLACE, both, op=MPI.MIN)
    if not fails:
        request.Wait()
    elif not arrives(request.Test, hopeless):
        return None
    return int(both[0]), bool(both[1])


@contextmanager
def agreed_call(comm: MPI.Comm, what: str) -> Iterator[None]:
    """Context in which all ranks call code of a user; what it raises on some ranks, all ranks raise.

    If all ranks raise, each raises its own exception. Otherwise all raise that of the lowest rank that has one: a
    :class:`PfemError` as it is, any other as a :class:`SimulationFailure` that says ``what`` has raised it. The code
    may communicate; if others wait there for a rank that has raised, that rank raises its own exception after the grace
    time. Collective.
    """
    error: BaseException | None = None
    try:
        yield
    except BaseException as caught:  # noqa: BLE001 - of a user; the other ranks would wait
        error = caught
    found = outcome(comm, error is not None)
    if found is None or found[1]:
        raise error
    first = found[0]
    if first < comm.size:
        if error is not None and not isinstance(error, PfemError):
            failure = SimulationFailure(f"{what}: the function {raised(error)} on rank {comm.rank}")
            failure.__cause__, error = error, failure
        raise comm.bcast(error, root=first)


def on_root(comm: MPI.Comm, function: Callable[..., T], *arguments: Any) -> T:
    """Call a function on rank 0 and broadcast its result (pickled); its :class:`PfemError` is raised on all ranks."""
    result = None
    with agreed(comm):
        if comm.rank == 0:
            result = function(*arguments)
    return comm.bcast(result, root=0)

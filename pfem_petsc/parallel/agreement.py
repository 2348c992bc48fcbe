"""Collective handling of errors: if one rank raises a known error, all ranks raise the same error."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import numpy as np
from mpi4py import MPI

from ..errors import PfemError, SimulationFailure, raised
from .ending import arrives, aside

__all__ = ["agreed", "agreed_call", "on_root", "outcome"]

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

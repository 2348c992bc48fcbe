"""Collective handling of errors: if one rank raises a known error, all ranks raise the same error."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import numpy as np
from mpi4py import MPI

from ..errors import PfemError, SimulationFailure, raised

__all__ = ["agreed", "agreed_call", "on_root"]

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


@contextmanager
def agreed_call(comm: MPI.Comm, step: int) -> Iterator[None]:
    """Context in which all ranks call a function of a user after a step; what it raises on some ranks, all ranks raise.

    If all ranks raise, each raises its own exception. Otherwise all raise that of the lowest rank that has one: a
    :class:`PfemError` as it is, any other as a :class:`SimulationFailure`. Collective; a function that communicates
    must not raise while others wait for its rank.
    """
    error: BaseException | None = None
    try:
        yield
    except BaseException as caught:  # noqa: BLE001 - of a user; the other ranks would wait
        error = caught
    outcome = np.array([comm.size if error is None else comm.rank, error is not None])
    comm.Allreduce(MPI.IN_PLACE, outcome, op=MPI.MIN)
    first, everywhere = outcome.tolist()
    if everywhere:
        raise error
    if first < comm.size:
        if error is not None and not isinstance(error, PfemError):
            failure = SimulationFailure(f"step {step}: on_step: the function {raised(error)} on rank {comm.rank}")
            failure.__cause__, error = error, failure
        raise comm.bcast(error, root=first)


def on_root(comm: MPI.Comm, function: Callable[..., T], *arguments: Any) -> T:
    """Call a function on rank 0 and broadcast its result (pickled); its :class:`PfemError` is raised on all ranks."""
    result = None
    with agreed(comm):
        if comm.rank == 0:
            result = function(*arguments)
    return comm.bcast(result, root=0)

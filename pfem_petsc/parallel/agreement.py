"""Collective handling of errors: if one rank raises a known error, all ranks raise the same error."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from mpi4py import MPI

from ..errors import PfemError

__all__ = ["agreed", "on_root"]

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


def on_root(comm: MPI.Comm, function: Callable[..., T], *arguments: Any) -> T:
    """Call a function on rank 0 and broadcast its result (pickled); its :class:`PfemError` is raised on all ranks."""
    result = None
    with agreed(comm):
        if comm.rank == 0:
            result = function(*arguments)
    return comm.bcast(result, root=0)

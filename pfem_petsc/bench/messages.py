"""Cost of messages between ranks, as parameters of a performance model for larger machines."""

from __future__ import annotations

from time import perf_counter
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from mpi4py import MPI

__all__ = ["Messages", "measure_messages"]

_SUMMED = 40  # approximate number of values in the reduction of a history row
_LARGE = 1 << 20  # B


class Messages(NamedTuple):
    """Cost of messages between ranks of this run, over their network or shared memory.

    Attributes
    ----------
    latency : of a message of 8 B between the first and the last rank, half a round trip [s]
    bandwidth : of messages of 1 MiB between these ranks [B/s]
    reduction : of a sum of 40 numbers over all ranks [s]
    """

    latency: float
    bandwidth: float
    reduction: float


def measure_messages(comm: MPI.Comm, repeats: int = 300) -> Messages | None:
    """Measure and return medians; None on one rank. Collective."""
    if comm.size == 1:
        return None
    small = _one_way(comm, np.zeros(1), repeats)
    large = _one_way(comm, np.zeros(_LARGE // 8), max(repeats // 10, 10))
    sums, times = np.ones(_SUMMED), np.empty(repeats)
    total = np.empty_like(sums)
    for k in range(repeats):
        comm.Barrier()
        start = perf_counter()
        comm.Allreduce(sums, total)
        times[k] = perf_counter() - start
    mine = float(np.median(times))
    return Messages(comm.bcast(small), _LARGE / comm.bcast(max(large - small, 1e-12)), max(comm.allgather(mine)))


def _one_way(comm: MPI.Comm, data: np.ndarray, repeats: int) -> float:
    """Return the median of half a round trip [s] on rank 0, zero elsewhere."""
    last = comm.size - 1
    times = np.zeros(repeats)
    comm.Barrier()
    for k in range(repeats):
        start = perf_counter()
        if comm.rank == 0:
            comm.Send(data, last)
            comm.Recv(data, last)
        elif comm.rank == last:
            comm.Recv(data, 0)
            comm.Send(data, 0)
        times[k] = 0.5 * (perf_counter() - start)
    return float(np.median(times)) if comm.rank == 0 else 0.0

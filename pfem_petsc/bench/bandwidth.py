"""Memory bandwidth of the machine by the STREAM triad, for one process and for all at once."""

from __future__ import annotations

from time import perf_counter
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..mechanics.compiled import kernel

if TYPE_CHECKING:
    from mpi4py import MPI

__all__ = ["BYTES_PER_ELEMENT", "Bandwidth", "measure_bandwidth"]

BYTES_PER_ELEMENT = 24
"""As STREAM counts: two reads and a write of 8 B. Cache lines read before they are overwritten are not counted."""

_ELEMENTS = 8_000_000  # 64 MB per array and process, larger than the share of a core in any current cache


class Bandwidth(NamedTuple):
    """STREAM triad [B/s], best of several: of one process alone, and of all ranks at once."""

    alone: float
    together: float
    ranks: int

    @property
    def ratio(self) -> float:
        """Bandwidth of all ranks relative to one: the maximum speed-up of memory-bound work."""
        return self.together / self.alone


@kernel
def _triad(a, b, c, scalar):
    for i in range(len(a)):
        a[i] = b[i] + scalar * c[i]


def measure_bandwidth(comm: MPI.Comm, repeats: int = 10) -> Bandwidth:
    """Measure both. Collective; the other ranks sleep while one is measured."""
    a, b, c = np.zeros(_ELEMENTS), np.full(_ELEMENTS, 1.0), np.full(_ELEMENTS, 2.0)
    _triad(a, b, c, 3.0)  # compile, and touch every page
    size = BYTES_PER_ELEMENT * _ELEMENTS
    alone = 0.0
    if comm.rank == 0:
        alone = size / min(_timed(a, b, c) for _ in range(repeats))
    _sleep_until_all(comm)
    alone = comm.bcast(alone)
    together = alone
    if comm.size > 1:
        slowest = []
        for _ in range(repeats):
            comm.Barrier()
            # the slowest of a round, because all share the memory until it has finished
            slowest.append(max(comm.allgather(_timed(a, b, c))))
        together = comm.size * size / min(slowest)
    return Bandwidth(alone, together, comm.size)


def _timed(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> float:
    start = perf_counter()
    _triad(a, b, c, 3.0)
    return perf_counter() - start


def _sleep_until_all(comm: MPI.Comm) -> None:
    """Wait at a barrier without using the cores."""
    from time import sleep

    request = comm.Ibarrier()
    while not request.Test():
        sleep(0.01)

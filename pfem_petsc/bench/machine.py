"""What a machine can do: memory bandwidth, operations of a core, and the cost of messages between ranks."""

from __future__ import annotations

import contextlib
import platform
import re
from collections.abc import Callable
from pathlib import Path
from time import perf_counter, sleep
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..mechanics.compiled import kernel

if TYPE_CHECKING:
    from mpi4py import MPI

BYTES_PER_ELEMENT = 24
"""As STREAM counts: two reads and a write of 8 B. Cache lines read before they are overwritten are not counted."""

_ELEMENTS = 8_000_000  # 64 MB per array and process, larger than the share of a core in any current cache
_CACHED, _TERMS = 2048, 32  # elements in the cache, and polynomials of each
_SUMMED = 40  # approximate number of values in the reduction of a history row
_LARGE = 1 << 20  # B


class Bandwidth(NamedTuple):
    """STREAM triad [B/s], best of several: of one process alone, and of all ranks at once."""

    alone: float
    together: float
    ranks: int

    @property
    def ratio(self) -> float:
        """Bandwidth of all ranks relative to one: the maximum speed-up of memory-bound work."""
        return self.together / self.alone


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


@kernel
def _triad(a, b, c, scalar):
    for i in range(len(a)):
        a[i] = b[i] + scalar * c[i]


@kernel
def _polynomial(x, y, terms):
    for i in range(len(x)):
        y[i] = 1.0
    for _ in range(terms):
        for i in range(len(x)):
            value = y[i]
            for _ in range(7):
                value = value * x[i] + 0.5
            y[i] = value


def measure_bandwidth(comm: MPI.Comm, repeats: int = 10) -> Bandwidth:
    """Measure both. Collective; the other ranks sleep while one is measured."""
    a, b, c = np.zeros(_ELEMENTS), np.full(_ELEMENTS, 1.0), np.full(_ELEMENTS, 2.0)
    size = BYTES_PER_ELEMENT * _ELEMENTS

    def triad() -> None:
        _triad(a, b, c, 3.0)

    triad()  # compile, and touch every page
    alone = size / _seconds(triad, repeats).min() if comm.rank == 0 else 0.0
    waiting = comm.Ibarrier()
    while not waiting.Test():
        sleep(0.01)
    alone = together = comm.bcast(alone)
    if comm.size > 1:
        # the slowest of a round, because all share the memory until it has finished
        slowest = np.max(comm.allgather(_seconds(triad, repeats, comm.Barrier)), axis=0)
        together = comm.size * size / slowest.min()
    return Bandwidth(float(alone), float(together), comm.size)


def measure_operations(comm: MPI.Comm, repeats: int = 50) -> float:
    """Return the products and sums a second [1/s] of a compiled loop over arrays in the cache, of all ranks at once.
    Collective."""
    x, y = np.full(_CACHED, 1e-3), np.empty(_CACHED)
    _polynomial(x, y, _TERMS)
    best = _seconds(lambda: _polynomial(x, y, _TERMS), repeats, comm.Barrier).min()
    return comm.allreduce(14.0 * _CACHED * _TERMS / best)


def measure_messages(comm: MPI.Comm, repeats: int = 300) -> Messages | None:
    """Measure and return medians; None on one rank. Collective."""
    if comm.size == 1:
        return None
    last = comm.size - 1

    def one_way(data: np.ndarray, count: int) -> float:
        """Half a round trip between the first and the last rank [s], of rank 0."""

        def there_and_back() -> None:
            if comm.rank == 0:
                comm.Send(data, last)
                comm.Recv(data, last)
            elif comm.rank == last:
                comm.Recv(data, 0)
                comm.Send(data, 0)

        comm.Barrier()
        return comm.bcast(0.5 * float(np.median(_seconds(there_and_back, count))))

    small = one_way(np.zeros(1), repeats)
    large = one_way(np.zeros(_LARGE // 8), max(repeats // 10, 10))
    sums, total = np.ones(_SUMMED), np.empty(_SUMMED)
    mine = float(np.median(_seconds(lambda: comm.Allreduce(sums, total), repeats, comm.Barrier)))
    return Messages(small, _LARGE / max(large - small, 1e-12), max(comm.allgather(mine)))


def processor() -> str:
    """Return the name of the processor."""
    with contextlib.suppress(OSError):
        if found := re.search(r"^model name\s*:(.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE):
            return found[1].strip()
    return platform.processor() or platform.machine()


def _seconds(work: Callable[[], object], repeats: int, before: Callable[[], object] = lambda: None) -> np.ndarray:
    """Return the time of each of some calls [s]; ``before`` is called before each and not timed."""
    times = np.empty(repeats)
    for k in range(repeats):
        before()
        start = perf_counter()
        work()
        times[k] = perf_counter() - start
    return times

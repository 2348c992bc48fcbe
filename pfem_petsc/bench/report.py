"""The memory bandwidth of a machine, and tables and JSON of the bench."""

from __future__ import annotations

import contextlib
import json
import os
import platform
import re
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from time import perf_counter, sleep
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..mechanics.compiled import kernel
from .measure import Record

if TYPE_CHECKING:
    from mpi4py import MPI

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


_FORMAT = "{:18} {:>11} {:>9} {:>9} {:>9} {:>8} {:>6} {:>7} {:>6} {:>6}"
_NAMES = ("job", "bars", "step ms", "best ms", "cpu ms", "bars/s", "memory", "newton", "setup", "first")
_UNITS = ("", "", "median", "", "", "", "B/bar", "/cg", "s", "step s")
HEADER = f"{_FORMAT.format(*_NAMES)}\n{_FORMAT.format(*_UNITS)}"
"""Two lines over the table."""


def line(record: Record) -> str:
    """Return a row of the table."""
    return _FORMAT.format(
        record.job,
        f"{record.bars:,}",
        f"{1e3 * record.median:.4g}",
        f"{1e3 * record.best:.4g}",
        f"{1e3 * record.cpu:.4g}",
        f"{record.rate:.3g}",
        f"{record.memory / record.bars:.0f}",
        f"{record.newton:.1f}/{record.linear:.0f}" if record.newton or record.linear else "-",
        f"{record.setup:.2f}",
        f"{record.first:.2f}",
    )


def machine_lines(bandwidth: Bandwidth) -> str:
    """Describe the bandwidth."""
    text = f"STREAM triad ({BYTES_PER_ELEMENT} B an element): one process {bandwidth.alone / 1e9:.1f} GB/s"
    if bandwidth.ranks > 1:
        text += f", {bandwidth.ranks} at once {bandwidth.together / 1e9:.1f} GB/s ({bandwidth.ratio:.2f} x)"
    return text + "\n"


def memory_slopes(records: list[Record]) -> dict[str, float]:
    """Return bytes per bar from the two largest sizes of each job with at least two sizes."""
    slopes = {}
    for name in dict.fromkeys(record.job for record in records):
        *_, less, more = [None, None, *sorted((r for r in records if r.job == name), key=lambda r: r.bars)]
        if less is not None and more.bars > less.bars:
            slopes[name] = (more.memory - less.memory) / (more.bars - less.bars)
    return slopes


def document(comm: MPI.Comm, bandwidth: Bandwidth, records: list[Record], tiny: list[Record]) -> str:
    """Return all measurements as JSON."""
    from ..output.layout import describe_run

    content: dict[str, Any] = {
        "machine": {"processor": processor(), "cores": os.cpu_count(), "system": platform.platform()},
        "program": describe_run(comm, {}),
        "ranks": bandwidth.ranks,
        "bandwidth": {
            "alone": bandwidth.alone,
            "together": bandwidth.together,
            "ratio": bandwidth.ratio,
            "bytes_per_element": BYTES_PER_ELEMENT,
        },
        "runs": [asdict(record) | {"bars_per_second": record.rate} for record in records],
        "memory_slopes": memory_slopes(records),
        "overhead": [asdict(record) for record in tiny],
    }
    return json.dumps(content, indent=1) + "\n"

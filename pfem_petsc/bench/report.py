"""What a machine can do (memory bandwidth, operations of a core), and tables, JSON and roofline of the bench."""

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
from .measure import ASSUMED, OPERATIONS, Record

if TYPE_CHECKING:
    from mpi4py import MPI

BYTES_PER_ELEMENT = 24
"""As STREAM counts: two reads and a write of 8 B. Cache lines read before they are overwritten are not counted."""

_ELEMENTS = 8_000_000  # 64 MB per array and process, larger than the share of a core in any current cache
_CACHED, _TERMS = 2048, 32  # elements in the cache, and polynomials of each


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


_FORMAT = "{:18} {:>11} {:>9} {:>9} {:>9} {:>8} {:>6} {:>6} {:>6} {:>7} {:>6} {:>6}"
_NAMES = (
    *("job", "bars", "step ms", "best ms", "cpu ms", "bars/s"),
    *("moved", "bound", "memory", "newton", "setup", "first"),
)
_UNITS = ("", "", "median", "", "", "", "B/bar", "%", "B/bar", "/cg", "s", "step s")
HEADER = f"{_FORMAT.format(*_NAMES)}\n{_FORMAT.format(*_UNITS)}"
"""Two lines over the table."""

_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")  # Okabe and Ito
_MARKS = "os^Dv<>p"


def line(record: Record) -> str:
    """Return a row of the table."""
    return _FORMAT.format(
        record.job,
        f"{record.bars:,}",
        f"{1e3 * record.median:.4g}",
        f"{1e3 * record.best:.4g}",
        f"{1e3 * record.cpu:.4g}",
        f"{record.rate:.3g}",
        f"{record.traffic / record.bars:.0f}",
        f"{record.share:.0f}" if record.share else "-",
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


def document(
    comm: MPI.Comm,
    bandwidth: Bandwidth,
    records: list[Record],
    tiny: list[Record],
    operations: float | None,
) -> str:
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
        "bytes_assumed": ASSUMED,
        "operations_assumed": OPERATIONS,
        "operations_a_second": operations,
        "runs": [asdict(record) | {"bars_per_second": record.rate} for record in records],
        "memory_slopes": memory_slopes(records),
        "overhead": [asdict(record) for record in tiny],
    }
    return json.dumps(content, indent=1) + "\n"


def draw_roofline(path: Path, bandwidth: Bandwidth, operations: float, records: list[Record], title: str) -> None:
    """Draw operations a second over operations a byte: the limits of the machine, and each job and size, as a PNG.

    S. Williams, A. Waterman, D. Patterson, "Roofline: an insightful visual performance model for multicore
    architectures", Communications of the ACM 52(4), 2009.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from matplotlib.ticker import NullFormatter

    figure, axes = pyplot.subplots(figsize=(8.0, 5.5), layout="constrained")
    ridge, low = operations / bandwidth.together, 0.06
    intensity = np.geomspace(0.05, max(5.0, 20.0 * ridge), 200)
    axes.plot(intensity, 1e-9 * np.minimum(operations, bandwidth.together * intensity), "k", linewidth=1.5)
    for text, at, offset in (
        (f"STREAM triad {bandwidth.together / 1e9:.1f} GB/s", (low, 1e-9 * bandwidth.together * low), (14, -4)),
        (f"compiled loop in the cache {operations / 1e9:.1f} GFLOP/s", (1.2 * ridge, 1e-9 * operations), (0, -6)),
    ):
        axes.annotate(text, at, fontsize=9, xytext=offset, textcoords="offset points", va="top")
    sizes = sorted({record.bars for record in records})
    jobs = list(dict.fromkeys(record.job for record in records))
    for record in records:
        number = jobs.index(record.job)
        axes.plot(
            record.operations / record.traffic,
            1e-9 * record.operations / record.best,
            _MARKS[number % len(_MARKS)],
            color=_COLOURS[number % len(_COLOURS)],
            markersize=6.0 + 3.0 * sizes.index(record.bars),
            alpha=0.85,
            label=record.job if record.bars == sizes[0] else None,
        )
    axes.set(xscale="log", yscale="log", xlabel="floating-point operations a byte", ylabel="GFLOP/s", title=title)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    axes.grid(True, which="both", alpha=0.25)
    bars = ", ".join(f"{size:,}" for size in sizes)
    axes.legend(title=f"larger marks, more bars:\n{bars}" if len(sizes) > 1 else f"{bars} bars", fontsize=9)
    figure.savefig(path, dpi=150)
    pyplot.close(figure)

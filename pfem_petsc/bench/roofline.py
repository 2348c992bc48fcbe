"""The roofline of a machine and what steps reach of it: operations a second over operations a byte.

S. Williams, A. Waterman, D. Patterson, "Roofline: an insightful visual performance model for multicore architectures",
Communications of the ACM 52(4), 2009.
"""

from __future__ import annotations

from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from ..mechanics.compiled import kernel

if TYPE_CHECKING:
    from mpi4py import MPI

    from .bandwidth import Bandwidth
    from .measure import Record

__all__ = ["draw", "measure_operations"]

_ELEMENTS, _TERMS = 2048, 32
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")  # Okabe and Ito
_MARKS = "os^Dv<>p"


@kernel
def _polynomial(x, y, terms):
    for i in range(len(x)):
        y[i] = 1.0
    for _ in range(terms):
        for i in range(len(x)):
            value = y[i]
            value = value * x[i] + 0.5
            value = value * x[i] + 0.25
            value = value * x[i] + 0.5
            value = value * x[i] + 0.25
            value = value * x[i] + 0.5
            value = value * x[i] + 0.25
            y[i] = value * x[i] + 0.5


def measure_operations(comm: MPI.Comm, repeats: int = 50) -> float:
    """Return the products and sums a second [1/s] of a compiled loop over arrays in the cache, of all ranks at once.
    Collective."""
    x, y = np.full(_ELEMENTS, 1e-3), np.empty(_ELEMENTS)
    _polynomial(x, y, _TERMS)
    best = np.inf
    for _ in range(repeats):
        comm.Barrier()
        start = perf_counter()
        _polynomial(x, y, _TERMS)
        best = min(best, perf_counter() - start)
    return comm.allreduce(14.0 * _ELEMENTS * _TERMS / best)


def draw(path: Path, bandwidth: Bandwidth, operations: float, records: list[Record], title: str) -> None:
    """Draw the roofline and a point for each job and size, as a PNG."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from matplotlib.ticker import NullFormatter

    figure, axes = pyplot.subplots(figsize=(8.0, 5.5), layout="constrained")
    intensity = np.geomspace(0.05, max(5.0, 20.0 * operations / bandwidth.together), 200)
    axes.plot(intensity, 1e-9 * np.minimum(operations, bandwidth.together * intensity), "k", linewidth=1.5)
    ridge = operations / bandwidth.together
    low = 0.06
    for text, at, offset in (
        (f"STREAM triad {bandwidth.together / 1e9:.1f} GB/s", (low, 1e-9 * bandwidth.together * low), (14, -4)),
        (f"compiled loop in the cache {operations / 1e9:.1f} GFLOP/s", (1.2 * ridge, 1e-9 * operations), (0, -6)),
    ):
        axes.annotate(text, at, fontsize=9, xytext=offset, textcoords="offset points", va="top")
    sizes = sorted({record.bars for record in records})
    for number, job in enumerate(dict.fromkeys(record.job for record in records)):
        own = [record for record in records if record.job == job]
        for record in own:
            axes.plot(
                record.operations / record.traffic,
                1e-9 * record.operations / record.best,
                _MARKS[number % len(_MARKS)],
                color=_COLOURS[number % len(_COLOURS)],
                markersize=6.0 + 3.0 * sizes.index(record.bars),
                alpha=0.85,
                label=job if record is own[0] else None,
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

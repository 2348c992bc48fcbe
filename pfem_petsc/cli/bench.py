"""Measure this machine: memory bandwidth, then explicit, implicit and contact steps of lattices."""

from __future__ import annotations

import argparse
import contextlib
import time
from pathlib import Path
from typing import TYPE_CHECKING

from ..bench.measure import JOBS, KINDS, cells_for, jobs, tiny_jobs
from ..errors import InputError
from .parser import PROGRAM, Verb, argument, start_petsc

if TYPE_CHECKING:
    from mpi4py import MPI

EXAMPLE = f"""\
examples:
  {PROGRAM} bench
  mpirun -n 2 {PROGRAM} bench --sizes 100000 1000000 --jobs explicit matrix_free -o bench.json

Steps are wall-clock times (median and best), cpu the processor time of all ranks; see docs/performance.md. Nothing else
should run during the measurement.

exit status: 0 done, 2 invalid input, 3 a run failed"""


_MOST = 10**12
"""Bars of the largest lattice that can be asked for; no machine has the memory."""


def _size(text: str) -> int:
    with contextlib.suppress(ValueError, OverflowError):
        if 0 < float(text) == int(float(text)) <= _MOST:
            return int(float(text))
    raise argparse.ArgumentTypeError(f"{text!r} is not a positive whole number up to {_MOST:,}")


ARGUMENTS = (
    argument(
        "--sizes",
        metavar="BARS",
        type=_size,
        nargs="+",
        default=[10_000, 100_000, 1_000_000],
        help="approximate numbers of bars",
    ),
    argument("--kind", choices=list(KINDS), default="cubic", help="cells of the lattice"),
    argument("--jobs", choices=list(JOBS), nargs="+", default=list(JOBS), help="what to time; default: all"),
    argument("--explicit", metavar="NAME", default="central_differences", help="explicit integrator"),
    argument("--implicit", metavar="NAME", default="newmark", help="implicit integrator"),
    argument("--mass", choices=("lumped", "consistent"), default="lumped", help="mass matrix"),
    argument(
        "--plastic",
        action=argparse.BooleanOptionalAction,
        help="bars that yield; default: in explicit_contact only",
    ),
    argument("--history-every", metavar="N", type=_size, default=1, help="steps between rows of the history"),
    argument("--seconds", metavar="T", type=float, default=2.0, help="approximate time for each job"),
    argument(
        "--compile",
        action="store_true",
        help="only compile the loops of the jobs and of all material laws for later runs; measure nothing",
    ),
    argument("-o", "--output", metavar="FILE", type=Path, help="write all figures as JSON"),
)


def run(arguments: argparse.Namespace, comm: MPI.Comm) -> int:
    """Measure and print. Collective."""
    start_petsc(arguments.petsc_options, comm.rank)
    from ..bench import report
    from ..bench.measure import compile_loops, time_job
    from ..parallel.agreement import on_root

    if not 0.0 < arguments.seconds < float("inf"):
        raise InputError(f"--seconds {arguments.seconds}: give a positive time")
    on_root(comm, _require_writable, arguments.output)

    def say(text: str) -> None:
        if comm.rank == 0:
            print(text, flush=True)

    kind, seconds, explicit = arguments.kind, arguments.seconds, arguments.explicit
    chosen = jobs(
        arguments.jobs, explicit, arguments.implicit, arguments.mass, arguments.plastic, arguments.history_every
    )
    if arguments.compile:
        begin = time.perf_counter()
        compile_loops(chosen, kind, explicit, comm)
        say(f"loops for this machine are compiled: {time.perf_counter() - begin:.1f} s")
        return 0
    for job in chosen:  # compile or load kernels and start libraries before the measurements
        time_job(job, kind, 2, comm, 0.0)
    title = f"{report.processor()}, {comm.size} rank{'s' if comm.size > 1 else ''}, {kind} lattices"
    say(title)
    bandwidth = report.measure_bandwidth(comm)
    say(report.machine_lines(bandwidth))
    say(report.HEADER)
    records = []
    for size in sorted(arguments.sizes):
        for job in chosen:
            records.append(time_job(job, kind, cells_for(kind, size), comm, seconds))
            say(report.line(records[-1]))
    say("")
    for name, slope in report.memory_slopes(records).items():
        say(f"memory of {name}: {slope:.0f} B per additional bar")
    tiny = [time_job(job, "cubic", 2, comm, seconds, 3000) for job in tiny_jobs(explicit)]
    for record in tiny:
        say(f"outside the loops over bars and nodes: {1e6 * record.median:.0f} us a step ({record.job})")
    if arguments.output and comm.rank == 0:
        arguments.output.write_text(report.document(comm, bandwidth, records, tiny), encoding="utf-8")
    return 0


def _require_writable(path: Path | None) -> None:
    """Open the output file before the measurements, which take minutes."""
    try:
        if path is not None:
            path.open("a").close()
    except OSError as error:
        raise InputError(f"--output {path}: cannot be written: {error.strerror}") from error


VERBS = (Verb("bench", str(__doc__), EXAMPLE, "all", ARGUMENTS, run),)

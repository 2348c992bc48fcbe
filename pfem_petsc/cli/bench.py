"""Measure this machine: memory bandwidth, then explicit, implicit and contact steps of lattices."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import InputError
from .parser import PROGRAM
from .petsc_options import start_petsc

if TYPE_CHECKING:
    from mpi4py import MPI

RANKS = "all"

EXAMPLE = f"""\
examples:
  {PROGRAM} bench
  mpirun -n 2 {PROGRAM} bench --sizes 100000 1000000 --jobs explicit matrix_free -o bench.json

Steps are wall-clock times (median and best), cpu the processor time of all ranks. 'moved' is the minimum memory traffic
of a step, as STREAM counts, and 'bound' the share of the median step that it would take at the measured bandwidth; see
docs/performance.md. Nothing else should run during the measurement.

exit status: 0 done, 2 invalid input, 3 a run failed"""

JOBS = ("explicit", "explicit_contact", "matrix_free", "assembled", "implicit_contact")
KINDS = ("cubic", "octet", "bcc")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    parser.add_argument(
        "--sizes",
        metavar="BARS",
        type=_size,
        nargs="+",
        default=[10_000, 100_000, 1_000_000],
        help="approximate numbers of bars",
    )
    parser.add_argument("--kind", choices=KINDS, default="cubic", help="cells of the lattice")
    parser.add_argument("--jobs", choices=JOBS, nargs="+", default=list(JOBS), help="what to time; default: all")
    parser.add_argument("--explicit", metavar="NAME", default="central_differences", help="explicit integrator")
    parser.add_argument("--implicit", metavar="NAME", default="newmark", help="implicit integrator")
    parser.add_argument("--mass", choices=("lumped", "consistent"), default="lumped", help="mass matrix")
    parser.add_argument(
        "--plastic",
        action=argparse.BooleanOptionalAction,
        help="bars that yield; default: in explicit_contact only",
    )
    parser.add_argument("--history-every", metavar="N", type=_size, default=1, help="steps between rows of the history")
    parser.add_argument("--seconds", metavar="T", type=float, default=2.0, help="approximate time for each job")
    parser.add_argument(
        "--compile", action="store_true", help="only compile the loops of the jobs for later runs; measure nothing"
    )
    parser.add_argument("--roofline", metavar="FILE.png", type=Path, help="draw a roofline plot of the jobs")
    parser.add_argument("-o", "--output", metavar="FILE", type=Path, help="write all figures as JSON")


def run(arguments: argparse.Namespace, comm: MPI.Comm) -> int:
    """Measure and print. Collective."""
    start_petsc(arguments.petsc_options, comm.rank)
    from ..bench.bandwidth import measure_bandwidth
    from ..bench.cases import cells_for
    from ..bench.jobs import jobs, tiny_jobs
    from ..bench.measure import time_job
    from ..bench.messages import measure_messages
    from ..bench.report import (
        HEADER,
        bandwidth_line,
        document,
        line,
        memory_parts,
        memory_slopes,
        messages_line,
        processor,
    )

    if not 0.0 < arguments.seconds < float("inf"):
        raise InputError(f"--seconds {arguments.seconds}: give a positive time")
    _check_output(arguments.output, comm)
    _check_output(arguments.roofline, comm)

    def say(text: str) -> None:
        if comm.rank == 0:
            print(text, flush=True)

    chosen = jobs(
        arguments.jobs,
        arguments.explicit,
        arguments.implicit,
        arguments.mass,
        arguments.plastic,
        arguments.history_every,
    )
    if arguments.compile:
        begin = time.perf_counter()
        for job in chosen:
            time_job(job, arguments.kind, 2, comm, None, 0.0)
        time_job(tiny_jobs(arguments.explicit)[0], "cubic", 2, comm, None, 0.0, 3000)
        say(f"loops for this machine are compiled: {time.perf_counter() - begin:.1f} s")
        return 0
    say(f"{processor()}, {comm.size} rank{'s' if comm.size > 1 else ''}, {arguments.kind} lattices")
    bandwidth = measure_bandwidth(comm)
    say(bandwidth_line(bandwidth))
    messages = measure_messages(comm)
    say(messages_line(messages) + "\n" if messages is not None else "")
    for job in chosen:  # compile or load kernels and start libraries before the measurements
        time_job(job, arguments.kind, 2, comm, None, 0.0)
    say(HEADER)
    records = []
    for size in sorted(arguments.sizes):
        for job in chosen:
            record = time_job(job, arguments.kind, cells_for(arguments.kind, size), comm, bandwidth, arguments.seconds)
            records.append(record)
            say(line(record))
    say("")
    for job in chosen:
        say(memory_parts(max((r for r in records if r.job == job.name), key=lambda r: r.bars)))
    for name, slope in memory_slopes(records).items():
        say(f"memory of {name}: {slope:.0f} B per additional bar")
    tiny = [time_job(job, "cubic", 2, comm, None, arguments.seconds, 3000) for job in tiny_jobs(arguments.explicit)]
    for record in tiny:
        say(f"outside the loops over bars and nodes: {1e6 * record.median:.0f} us a step ({record.job})")
    operations = None
    if arguments.roofline is not None:
        from ..bench.roofline import draw, measure_operations

        operations = measure_operations(comm)
        if comm.rank == 0:
            title = f"{processor()}, {comm.size} rank{'s' if comm.size > 1 else ''}, {arguments.kind} lattices"
            draw(arguments.roofline, bandwidth, operations, records, title)
    if arguments.output is not None and comm.rank == 0:
        arguments.output.write_text(document(comm, bandwidth, messages, records, tiny, operations), encoding="utf-8")
    return 0


def _size(text: str) -> int:
    try:
        size = int(float(text)) if float(text) == int(float(text)) else 0
    except (ValueError, OverflowError):
        size = 0
    if size < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive whole number")
    return size


def _check_output(path: Path | None, comm: MPI.Comm) -> None:
    """Check that the output file can be written before the measurements, which take minutes. Collective."""
    from ..parallel.agreement import on_root

    def try_it() -> None:
        if path is None:
            return
        try:
            path.open("a").close()
        except OSError as error:
            raise InputError(f"--output {path}: cannot be written: {error.strerror}") from error

    on_root(comm, try_it)

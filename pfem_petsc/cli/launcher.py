"""Ranks on the command line: who prints, and how a failure on any of them ends all of them.

Nothing here imports MPI before it is needed: ``--help``, ``list`` and refused options know their rank from the
environment that the launcher made.
"""

from __future__ import annotations

import errno
import os
import sys
import time
import traceback
from collections.abc import Callable
from typing import TYPE_CHECKING, TextIO

from ..errors import EarlyStop, InputError, PfemError, SimulationFailure, printable

if TYPE_CHECKING:
    from mpi4py import MPI

__all__ = ["collectively", "launched_rank", "on_first_rank", "refuse"]

RANK_VARIABLES = ("OMPI_COMM_WORLD_RANK", "PMIX_RANK", "PMI_RANK", "SLURM_PROCID")

_PETSC_REFUSED = (62, 63, 83, 86)
"""Codes of PETSc's errors: wrong or out of range argument, file cannot be opened, unknown type."""

GRACE = 3.0
"""Seconds in which all ranks must report the same failure; after that the job is aborted."""


def launched_rank() -> int | None:
    """Rank of this process as its launcher says, None where it was started alone."""
    for variable in RANK_VARIABLES:
        value = os.environ.get(variable, "")
        if value.isdigit():
            return int(value)
    return None


def refuse(error: PfemError, debug: bool) -> int:
    """Print an error that every rank has found by itself, once, and give its exit status."""
    rank = launched_rank()
    if not rank:
        _print(error, debug)
    if rank is not None:
        # A launcher kills the other ranks as soon as one ends with an error: wait until it is printed.
        from mpi4py import MPI

        MPI.COMM_WORLD.Barrier()
    return error.exit_status


def on_first_rank(function: Callable[[], int], debug: bool, uses_mpi: bool) -> int:
    """Run what needs one process; further ranks, where there are any, do nothing.

    Parameters
    ----------
    function : gives the exit status
    debug : whether a failure prints its traceback
    uses_mpi : whether the function's imports may start MPI, which must then be started on every rank
    """
    rank = launched_rank()
    if rank is not None and uses_mpi:
        from mpi4py import MPI

        rank = MPI.COMM_WORLD.rank
    if rank:
        return 0
    try:
        status = function()
        sys.stdout.flush()  # what cannot be written is told, not lost at the end of the process
        return status
    except BrokenPipeError:
        # Who reads the output has seen enough (``list | head``); the interpreter must not flush into the closed pipe.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001 - whatever it is becomes a message and a status
        return _print(error, debug)


def collectively(function: Callable[[MPI.Comm], int], debug: bool) -> int:
    """Run what all ranks do together, and give the exit status, the same on all.

    Where all ranks fail, the lowest prints its message. Where only some do, the others may wait for them for ever:
    each of the failed prints its message and ends the job.
    """
    try:
        from mpi4py import MPI
    except ImportError as error:
        return _print(error, debug)

    comm = MPI.COMM_WORLD
    # Of its own, so that it matches whatever else the ranks are waiting in.
    failures = comm.Dup()
    try:
        status = function(comm)
        sys.stdout.flush()
    except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001 - whatever it is becomes a message and a status
        if not _all_arrive(failures):
            comm.Abort(_print(error, debug, f"rank {comm.rank}: "))
        status = _print(error, debug) if comm.rank == 0 else None
        status = failures.bcast(status, root=0)
    failures.Free()
    _let_go_of_closed_streams()
    return status


def _all_arrive(comm: MPI.Comm) -> bool:
    """Whether every rank gets here within the grace time."""
    request = comm.Ibarrier()
    deadline = time.monotonic() + GRACE
    while not request.Test():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.005)
    return True


def _print(error: BaseException, debug: bool, who: str = "") -> int:
    """Print one message for an error and give its exit status."""
    status, text = _message(error)
    if debug:
        text = "".join(traceback.format_exception(error)) + text
    try:
        sys.stdout.flush()
    except OSError:
        _to_nowhere(sys.stdout)
    try:
        print(f"{who}{printable(text)}", file=sys.stderr, flush=True)
    except OSError:
        _to_nowhere(sys.stderr)
    return status


def _let_go_of_closed_streams() -> None:
    """Python flushes both streams at its end, and exits with 120 where that fails."""
    for stream in (sys.stdout, sys.stderr):
        try:
            number = stream.fileno()
        except (OSError, ValueError):  # not a file: captured, or closed
            continue
        try:
            stream.flush()
            os.write(number, b"")  # a terminal that has gone refuses even nothing
        except OSError:
            _to_nowhere(stream)


def _to_nowhere(stream: TextIO) -> None:
    """The terminal has gone, or its disk is full: the interpreter must not flush into it at its end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _message(error: BaseException) -> tuple[int, str]:
    if isinstance(error, EarlyStop):
        return error.exit_status, f"stopped: {error}"
    if isinstance(error, PfemError):
        return error.exit_status, f"error: {error}"
    if isinstance(error, KeyboardInterrupt):
        return SimulationFailure.exit_status, "stopped: interrupted; no checkpoint was written"
    if isinstance(error, MemoryError):
        return SimulationFailure.exit_status, f"error: out of memory: {error}; use more machines or a smaller mesh"
    if isinstance(error, ModuleNotFoundError) and not str(error.name).startswith(__package__.partition(".")[0]):
        way = "scripts/setup.sh makes an environment that has it: source .venv/bin/activate"
        return InputError.exit_status, f"error: {error}; {way}"
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EIO):
        where = f"{error.filename}: " if error.filename else "standard output, or a file that is being written: "
        return SimulationFailure.exit_status, f"error: {where}{error.strerror}; make room, or write elsewhere"
    if type(error).__module__ == "petsc4py.PETSc" and getattr(error, "ierr", 0) in _PETSC_REFUSED:
        reason = " ".join(str(error).split())
        return (
            InputError.exit_status,
            f"error: PETSc refuses an option: {reason}; check what follows -- (docs/linear_solvers.md)",
        )
    detail = " ".join(str(error).split()) or "no message"

    return (
        SimulationFailure.exit_status,
        f"internal error: {type(error).__name__}: {detail[:500]}; run with --debug to see where",
    )

"""Ranks on the command line: which rank prints, and how a failure on one rank ends all of them.

MPI is not imported before it is needed: ``--help``, ``list`` and invalid options determine their rank from the
environment of the launcher.
"""

from __future__ import annotations

import errno
import os
import sys
import time
import traceback
from collections.abc import Callable
from typing import TYPE_CHECKING, TextIO

from ..errors import NUMPY_REMEDY, EarlyStop, InputError, PfemError, SimulationFailure, numpy_is_too_new, printable

if TYPE_CHECKING:
    from mpi4py import MPI

__all__ = ["collectively", "launched_rank", "on_first_rank", "refuse"]

RANK_VARIABLES = ("OMPI_COMM_WORLD_RANK", "PMIX_RANK", "PMI_RANK", "SLURM_PROCID")

_PETSC_REFUSED = (62, 63, 83, 86)
"""Codes of PETSc errors: wrong or out of range argument, file cannot be opened, unknown type."""

GRACE = 3.0
"""Seconds in which all ranks must report the same failure; after that the job is aborted."""


def launched_rank() -> int | None:
    """Return the rank of this process according to its launcher, None without a launcher."""
    for variable in RANK_VARIABLES:
        value = os.environ.get(variable, "")
        if value.isdigit():
            return int(value)
    return None


def refuse(error: PfemError, debug: bool) -> int:
    """Print once an error that every rank has found, and return its exit status."""
    rank = launched_rank()
    if not rank:
        _print(error, debug)
    if rank is not None:
        # A launcher kills the other ranks as soon as one exits with an error: wait until it is printed.
        from mpi4py import MPI

        MPI.COMM_WORLD.Barrier()
    return error.exit_status


def on_first_rank(function: Callable[[], int], debug: bool, uses_mpi: bool) -> int:
    """Run a function on one process; further ranks, if there are any, do nothing.

    Parameters
    ----------
    function : returns the exit status
    debug : whether a failure prints its traceback
    uses_mpi : whether imports of the function may start MPI, which must then be started on every rank
    """
    rank = launched_rank()
    if rank is not None and uses_mpi:
        from mpi4py import MPI

        rank = MPI.COMM_WORLD.rank
    if rank:
        return 0
    try:
        status = function()
        sys.stdout.flush()  # errors of writing are reported here, not lost at the end of the process
        return status
    except BrokenPipeError:
        # The reader of the output has exited (``list | head``); the interpreter must not flush into the closed pipe.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001 - whatever it is becomes a message and a status
        return _print(error, debug)


def collectively(function: Callable[[MPI.Comm], int], debug: bool) -> int:
    """Run a collective function and return the exit status, equal on all ranks.

    If all ranks fail, the lowest prints its message. If only some fail, the others may wait for them forever: each of
    the failed ranks prints its message and ends the job.
    """
    try:
        from mpi4py import MPI
    except ImportError as error:
        return _print(error, debug)

    comm = MPI.COMM_WORLD
    # A separate communicator, so that messages do not match those that other ranks wait for.
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
    """Return whether every rank arrives within the grace time."""
    request = comm.Ibarrier()
    deadline = time.monotonic() + GRACE
    while not request.Test():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.005)
    return True


def _print(error: BaseException, debug: bool, who: str = "") -> int:
    """Print one message for an error and return its exit status."""
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
    """Redirect closed streams: Python flushes both at exit, and exits with status 120 if that fails."""
    for stream in (sys.stdout, sys.stderr):
        try:
            number = stream.fileno()
        except (OSError, ValueError):  # not a file: captured, or closed
            continue
        try:
            stream.flush()
            os.write(number, b"")  # writing to a closed terminal fails even without data
        except OSError:
            _to_nowhere(stream)


def _to_nowhere(stream: TextIO) -> None:
    """Redirect a stream whose terminal is closed or disk is full, into which the interpreter must not flush at exit."""
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
    if numpy_is_too_new(error):
        return InputError.exit_status, f"error: {NUMPY_REMEDY}"
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EIO):
        where = f"{error.filename}: " if error.filename else "standard output, or a file that is being written: "
        return SimulationFailure.exit_status, f"error: {where}{error.strerror}; make room, or write elsewhere"
    if type(error).__module__ == "petsc4py.PETSc" and getattr(error, "ierr", 0) in _PETSC_REFUSED:
        reason = " ".join(str(error).split())
        return (
            InputError.exit_status,
            f"error: PETSc rejects an option: {reason}; check what follows -- (docs/linear_solvers.md)",
        )
    detail = " ".join(str(error).split()) or "no message"

    return (
        SimulationFailure.exit_status,
        f"internal error: {type(error).__name__}: {detail[:500]}; run with --debug to see where",
    )

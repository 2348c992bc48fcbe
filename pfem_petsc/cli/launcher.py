"""Ranks on the command line: which rank prints, and how a failure on one rank ends all of them.

MPI is not imported before it is needed: ``--help``, ``list`` and invalid options determine their rank from the
environment of the launcher.
"""

from __future__ import annotations

import contextlib
import errno
import os
import sys
import time
import traceback
from collections.abc import Callable
from typing import TYPE_CHECKING

from ..errors import NUMPY_REMEDY, EarlyStop, InputError, PfemError, SimulationFailure, numpy_is_too_new, printable

if TYPE_CHECKING:
    from mpi4py import MPI

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
    except BrokenPipeError:  # the reader of the output has exited (``list | head``)
        status = 0
    except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001 - whatever it is becomes a message and a status
        status = _print(error, debug)
    _let_go_of_closed_streams()
    return status


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
        status = failures.bcast(_print(error, debug) if comm.rank == 0 else None, root=0)
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
    status, text = exit_message(error)
    if debug:
        text = "".join(traceback.format_exception(error)) + text
    for stream, shown in ((sys.stdout, ""), (sys.stderr, f"{who}{printable(text)}\n")):
        with contextlib.suppress(OSError):
            stream.write(shown)
            stream.flush()
    _let_go_of_closed_streams()
    return status


def _let_go_of_closed_streams() -> None:
    """Redirect streams whose terminal is closed or disk is full: Python flushes both at exit, and a failure there
    is exit status 120."""
    for stream in (sys.stdout, sys.stderr):
        try:
            number = stream.fileno()
        except (OSError, ValueError):  # not a file: captured, or closed
            continue
        try:
            stream.flush()
            os.write(number, b"")  # writing to a closed terminal fails even without data
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), number)


def exit_message(error: BaseException) -> tuple[int, str]:
    """Return the exit status of an error and its message, with the remedy."""
    reason = " ".join(str(error).split())
    match error:
        case EarlyStop():
            return error.exit_status, f"stopped: {error}"
        case PfemError():
            return error.exit_status, f"error: {error}"
        case KeyboardInterrupt():
            return SimulationFailure.exit_status, "stopped: interrupted; no checkpoint was written"
        case MemoryError():
            return SimulationFailure.exit_status, f"error: out of memory: {error}; use more machines or a smaller mesh"
        case ModuleNotFoundError() if not str(error.name).startswith(__package__.partition(".")[0]):
            way = "scripts/setup.sh makes an environment that has it: source .venv/bin/activate"
            return InputError.exit_status, f"error: {error}; {way}"
        case _ if numpy_is_too_new(error):
            return InputError.exit_status, f"error: {NUMPY_REMEDY}"
        case OSError(errno=errno.ENOSPC | errno.EDQUOT | errno.EIO):
            where = f"{error.filename}: " if error.filename else "standard output, or a file that is being written: "
            return SimulationFailure.exit_status, f"error: {where}{error.strerror}; make room, or write elsewhere"
        case _ if type(error).__module__ == "petsc4py.PETSc" and getattr(error, "ierr", 0) in _PETSC_REFUSED:
            check = "check what follows -- (docs/linear_solvers.md)"
            return InputError.exit_status, f"error: PETSc rejects an option: {reason}; {check}"
    detail = f"{type(error).__name__}: {(reason or 'no message')[:500]}"
    return SimulationFailure.exit_status, f"internal error: {detail}; run with --debug to see where"

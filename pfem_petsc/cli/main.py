"""The command line: finds the verb, runs it on its ranks, and converts errors to messages and exit status.

One rank prints, and a failure on one rank ends all of them. MPI is not imported before it is needed: ``--help``,
``list`` and invalid options determine their rank from the environment of the launcher.
"""

from __future__ import annotations

import argparse
import contextlib
import difflib
import errno
import importlib
import importlib.util
import io
import os
import sys
import traceback
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ..case.toml import built_in_cases
from ..errors import (
    NUMPY_REMEDY,
    EarlyStop,
    InputError,
    PfemError,
    SimulationFailure,
    lacking_module,
    numpy_is_too_new,
    printable,
)
from ..registry import add_plugin, blame
from ..signals import give_back_early, launched_rank
from .parser import PLUGINS, PROGRAM, Parser, Verb, fill

if TYPE_CHECKING:
    from mpi4py import MPI

HOMES = {"run": "cases", "list": "cases", "check": "cases", "mesh": "mesh", "render": "results", "plot": "results"}
HOMES |= {
    "report": "results",
    "members": "results",
    "crush": "results",
    "info": "results",
    "sweep": "cases",
    "bench": "machine",
    "completion": "cases",
}
"""Verbs, and the modules of this package whose ``VERBS`` have them."""

EXAMPLES = f"""\
examples:
  mpirun -n 2 {PROGRAM} rod_impact
  {PROGRAM} list
  {PROGRAM} check my_case.toml
  mpirun -n 2 {PROGRAM} my_case.toml -o results/fine --set time.step=1e-5 -- -log_view
  {PROGRAM} info results/rod_impact
  mpirun -n 2 {PROGRAM} bench --sizes 100000

CASE alone means run. Everything after -- goes to PETSc. VERB --help shows more."""


_PETSC_REFUSED = (62, 63, 83, 86)
"""Codes of PETSc errors: wrong or out of range argument, file cannot be opened, unknown type."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status.

    Parameters
    ----------
    argv : arguments without the name of the program; default: those of this process
    """
    words = list(sys.argv[1:] if argv is None else argv)
    cut = words.index("--") if "--" in words else len(words)
    debug = "--debug" in words[:cut]
    # overflows are reported by their consequences
    warnings.filterwarnings("default" if debug else "ignore", category=RuntimeWarning)
    told: set[str] = set()

    def once(message: Warning | str, *_: object, **__: object) -> str:
        """Python's filter "once" forgets what it has told whenever a library changes filters."""
        text = f"warning: {message}\n"
        new = text not in told
        told.add(text)
        return text if new else ""

    warnings.formatwarning = once
    try:
        arguments, verb = _parse(words[:cut], words[cut + 1 :])
    except InputError as error:
        return refuse(error, debug)
    except SystemExit as done:  # --help and --version
        return int(done.code or 0)

    def run_verb(*comm: MPI.Comm) -> int:
        if arguments.verb != "run":
            give_back_early()
        for file in arguments.plugins:
            try:
                add_plugin(file)
            except InputError as error:
                raise InputError(f"--plugin {file}: {error}") from error
        return verb.run(arguments, *comm)

    if arguments.ranks == "all":
        return collectively(run_verb, debug)
    return on_first_rank(run_verb, debug, uses_mpi=arguments.ranks == "one")


def _parse(words: Sequence[str], petsc_options: Sequence[str] = ()) -> tuple[argparse.Namespace, Verb]:
    for word in (*words, *petsc_options):
        try:
            word.encode()
        except UnicodeEncodeError as error:
            shown = word.encode(errors="surrogateescape").decode(errors="backslashreplace")
            raise InputError(f"{shown}: has bytes that are not UTF-8: rename the file, or give other text") from error
    if not words:
        raise InputError(f"CASE or a verb is missing: {', '.join(HOMES)}; see {PROGRAM} --help")
    if words[0] not in (*HOMES, "-h", "--help", "--version"):
        near = difflib.get_close_matches(words[0], HOMES, n=1, cutoff=0.7)
        if near and not Path(words[0]).exists() and words[0] not in built_in_cases():
            raise InputError(f"{words[0]}: there is no such verb or case; did you mean '{near[0]}'?")
        words = ["run", *words]
    parser, verbs = make_parser(words[0])
    # One rank prints help.
    with contextlib.redirect_stdout(io.StringIO()) if launched_rank() else contextlib.nullcontext():
        arguments, unknown = parser.parse_known_args(words)
    verb = verbs[arguments.verb]
    if unknown:
        # the common parser would refer to its own help
        raise InputError(f"unrecognized arguments: {' '.join(unknown)}; see {PROGRAM} {arguments.verb} --help")
    arguments.ranks = verb.ranks(arguments) if callable(verb.ranks) else verb.ranks
    if petsc_options and arguments.ranks != "all":
        raise InputError(f"{arguments.verb} takes no PETSc options: {' '.join(petsc_options)}")
    arguments.petsc_options = list(petsc_options)
    return arguments, verb


def make_parser(only: str = "") -> tuple[Parser, dict[str, Verb]]:
    """Return the parser of a verb, or of all, and the verbs by name; the modules of others are not imported."""
    from .. import __version__

    parser = Parser(
        prog=PROGRAM,
        description="Dynamics and statics of large trusses: impact, buckling, yielding, form finding.",
        epilog=EXAMPLES,
    )
    parser.add_argument("--version", action="version", version=f"pfem_petsc {__version__}")
    subparsers = parser.add_subparsers(dest="verb", metavar="VERB", required=True)
    verbs = {}
    for name, home in ((only, HOMES[only]),) if only in HOMES else HOMES.items():
        module = importlib.import_module(f"{__package__}.{home}")
        verbs[name] = verb = next(each for each in module.VERBS if each.name == name)
        sub = subparsers.add_parser(
            name,
            help=verb.text.partition("\n")[0],
            description=verb.text,
            epilog=verb.example,
            prog=f"{PROGRAM} {name}",
        )
        fill(sub, verb.arguments if verb.actions else (*verb.arguments, PLUGINS))
        actions = sub.add_subparsers(dest="action", metavar="ACTION", required=True) if verb.actions else None
        for action, text, arguments in verb.actions:
            prog = f"{PROGRAM} {name} {action}"
            fill(actions.add_parser(action, help=text, description=text, prog=prog), (*arguments, PLUGINS))
    return parser, verbs


def refuse(error: PfemError, debug: bool) -> int:
    """Print once an error that every rank has found, and return its exit status."""
    rank = launched_rank()
    if not rank:
        _print(error, debug)
    if rank is not None and importlib.util.find_spec("mpi4py"):
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
    # where a verb imports PETSc, its handlers would end the process at a closed pipe
    os.environ["PETSC_OPTIONS"] = f"{os.environ.get('PETSC_OPTIONS', '')} -no_signal_handler".strip()
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
        from ..parallel.agreement import all_arrive

        if not all_arrive(failures):
            comm.Abort(_print(error, debug, f"rank {comm.rank}: "))
        status = failures.bcast(_print(error, debug) if comm.rank == 0 else None, root=0)
    failures.Free()
    _let_go_of_closed_streams()
    return status


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
            return InputError.exit_status, f"error: {lacking_module(error)}"
        case _ if numpy_is_too_new(error):
            return InputError.exit_status, f"error: {NUMPY_REMEDY}"
        case OSError(errno=errno.ENOSPC | errno.EDQUOT | errno.EIO):
            where = f"{error.filename}: " if error.filename else "standard output, or a file that is being written: "
            return SimulationFailure.exit_status, f"error: {where}{error.strerror}; make room, or write elsewhere"
        case _ if type(error).__module__ == "petsc4py.PETSc" and getattr(error, "ierr", 0) in _PETSC_REFUSED:
            check = "check what follows -- (docs/linear_solvers.md)"
            return InputError.exit_status, f"error: PETSc rejects an option: {reason}; {check}"
    if place := blame(error):
        kind = InputError if type(error).__module__.startswith("numba.") else SimulationFailure
        return kind.exit_status, f"error: the plugin {place}"
    if isinstance(error, ImportError) and not str(error.name).startswith(__package__.partition(".")[0]):
        return InputError.exit_status, f"error: {lacking_module(error)}"  # a library that is damaged, or half installed
    detail = f"{type(error).__name__}: {(reason or 'no message')[:500]}"
    return SimulationFailure.exit_status, f"internal error: {detail}; run with --debug to see where"

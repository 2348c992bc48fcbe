"""The command line: finds the verb, runs it on its ranks, and converts errors to messages and exit status; the options
that several verbs share, and those after ``--`` for PETSc.

One rank prints, and a failure on one rank ends all of them. MPI is not imported before it is needed: ``--help``,
``list`` and invalid options determine their rank from the environment of the launcher.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import difflib
import errno
import importlib
import importlib.util
import io
import os
import re
import sys
import traceback
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

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
from ..signals import early, give_back_early, launched_rank

if TYPE_CHECKING:
    from mpi4py import MPI

PROGRAM = "python -m pfem_petsc"

PREFIXES = ("pfem_contact_", "pfem_assembled_", "pfem_coarse_", "pfem_mass_", "pfem_")
"""Prefixes of the program's solvers, described in docs/linear_solvers.md."""

_SOLVER = ("snes_", "ksp_", "pc_", "mg_", "sub_", "mat_mumps_", "esteig_", "linesearch_")
_FILES = ("-options_file", "-options_file_yaml")


_NUMBER = r"(\d+\.?\d*|\.\d+)(e[-+]?\d+)?"
_OF_EXPRESSIONS = {"--curves", "--against", "--spectrum", "--inset", "--displacement", "--results"}
"""Options whose values are computed from columns of the history."""


class Argument(NamedTuple):
    """An argument of a verb: what ``argparse`` takes."""

    flags: tuple[str, ...]
    settings: Mapping[str, Any]


def argument(*flags: str, **settings: Any) -> Argument:
    """Declare an argument."""
    return Argument(flags, settings)


def options_of(kind: type) -> list[Argument]:
    """Return the options that the fields of a class declare; see :mod:`pfem_petsc.post.options`."""
    found = []
    for each in dataclasses.fields(kind):
        settings = {"dest": each.name, "default": each.default, **each.metadata}
        found.append(argument(settings.pop("flag", f"--{each.name.replace('_', '-')}"), **settings))
    return found


class Action(NamedTuple):
    """A part of a verb with arguments of its own: name, help and arguments."""

    name: str
    text: str
    arguments: Sequence[Argument]


class Verb(NamedTuple):
    """A verb of the command line.

    Attributes
    ----------
    name : on the command line
    text : of its help; the first line is in the list of verbs
    example : below its help
    ranks : ``all`` run it together; ``one`` runs it, with MPI or ``one, without MPI``; or a function of the arguments
    arguments : besides ``--debug``, which every verb has
    run : function of the arguments, and of the communicator for ``all``, that returns the exit status
    actions : its parts, one of which must be named
    """

    name: str
    text: str
    example: str
    ranks: str | Callable[[argparse.Namespace], str]
    arguments: Sequence[Argument]
    run: Callable[..., int]
    actions: Sequence[Action] = ()


class Parser(argparse.ArgumentParser):
    """Parser that raises errors instead of printing them, so that one rank can print them."""

    def __init__(self, **settings: object) -> None:
        settings.setdefault("formatter_class", argparse.RawDescriptionHelpFormatter)
        super().__init__(allow_abbrev=False, **settings)  # type: ignore[arg-type]
        # argparse treats -1 as a number and -1e8 as an option.
        self._negative_number_matcher = re.compile(rf"^-{_NUMBER}$", re.IGNORECASE)

    def take_expressions(self) -> None:
        """Take words like ``-wall/floor/force.z`` and ``-(a-b)``, which begin with no option, as values."""
        self._negative_number_matcher = re.compile(rf"^-({_NUMBER}$|\(|[a-z][a-z_]+)", re.IGNORECASE)

    def error(self, message: str) -> NoReturn:
        """Raise the error as invalid input."""
        hint = " (give it before --set and --restart)" if "required: CASE" in message else ""
        raise InputError(f"{message}{hint}; see {self.prog} --help")


def setting(text: str) -> Argument:
    """Declare --set with its help."""
    options = {"dest": "overrides", "metavar": "KEY=VALUE", "nargs": "+", "action": "extend", "default": []}
    return argument("--set", help=text, **options)


CASE = (
    argument("case", metavar="CASE", help="TOML file, or name of a built-in case (see list)"),
    setting("values that replace those of the case: time.step=1e-5 wall.0.point=[1,0,0]; KEY= removes a key"),
)
PLUGINS = argument(
    "--plugin",
    dest="plugins",
    metavar="FILE",
    nargs="+",
    action="extend",
    default=[],
    help="files with laws, integrators, walls and so on of your own, as the key plugins of a case",
)
_DEBUG = argument("--debug", action="store_true", help="print the traceback of a failure")


def fill(parser: Parser, arguments: Sequence[Argument]) -> None:
    """Add arguments to a parser, and --debug."""
    for flags, settings in (*arguments, _DEBUG):
        parser.add_argument(*flags, **settings)
        if _OF_EXPRESSIONS & set(flags):
            parser.take_expressions()


def surviving(result: str, deep: bool | None = None, refuse: bool = False) -> Path:
    """Return the result file of RESULT after a separate process has read it, because HDF5 may crash on a damaged file.

    Values that do not match their checksums are a warning on stderr, or refused.

    Raises
    ------
    InputError
        If there is no such file, or it cannot be read; with ``refuse`` also if values do not match.
    """
    from ..output.integrity import SHOWN, examine
    from ..output.result import result_file

    path = result_file(result)
    wrong = examine(path, deep) if path.is_file() else []
    if wrong:
        lines = wrong if len(wrong) <= SHOWN else [*wrong[:SHOWN], f"... and {len(wrong) - SHOWN} more"]
        text = f"{path}: damaged: " + "\n  ".join(lines)
        if refuse:
            raise InputError(f"{text}\nrestore it from a copy; everything that is not named is undamaged")
        print(f"warning: {text}", file=sys.stderr, flush=True)
    return path


def seconds(text: str) -> float:
    """Convert a duration, ``90``, ``1:30`` or ``0:01:30``, to seconds.

    Raises
    ------
    argparse.ArgumentTypeError
        If it is not a duration, or not positive.
    """
    try:
        parts = [float(part) for part in text.split(":")]
    except ValueError:
        parts = []
    total = sum(part * 60.0**k for k, part in enumerate(reversed(parts)))
    if not 1 <= len(parts) <= 3 or min(parts) < 0.0 or not 0.0 < total < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a duration: give seconds, or hours:minutes:seconds")
    return total


def start_petsc(options: Sequence[str], rank: int) -> None:
    """Start PETSc with options; rank 0 warns about those without effect.

    Raises
    ------
    InputError
        If an options file is missing, or PETSc rejects an option.
    """
    import petsc4py

    for word, file in zip(options, [*options[1:], ""], strict=False):
        if word in _FILES and not Path(file).is_file():
            raise InputError(f"{word} {file}: there is no such file; name a file of PETSc options after {word}")
    try:
        petsc4py.init([PROGRAM, *options])
        from petsc4py import PETSc  # noqa: F401 - PETSc is started here
    except Exception as error:
        if type(error).__name__ != "Error":  # PETSc.Error cannot be imported before PETSc is started
            raise
        raise InputError(f"PETSc does not start with the options {' '.join(options)}: {error}") from error
    early().keep_watching()  # PETSc installs its own for hang-ups
    if rank == 0:
        for line in without_effect(options):
            print(f"warning: {line}", file=sys.stderr, flush=True)


def without_effect(options: Sequence[str]) -> list[str]:
    """Return one line for each solver option that none of the program's solvers reads."""
    lines = []
    for word in options:
        name = word.lstrip("-")
        if not re.match(r"--?[A-Za-z]", word) or not (name.startswith("pfem_") or name.startswith(_SOLVER)):
            continue
        prefix = next((p for p in PREFIXES if name.startswith(p)), "")
        rest = name.removeprefix(prefix)
        if prefix and rest.startswith(_SOLVER):
            continue
        at = min((found.start() for found in re.finditer("|".join(_SOLVER), rest)), default=None)
        wanted = difflib.get_close_matches(rest[:at] if at else "", PREFIXES, n=1, cutoff=0.4) if prefix else []
        near = f"; did you mean -{(wanted or ['pfem_'])[0]}{rest[at:]}?" if at is not None else ""
        lines.append(
            f"the PETSc option {word} has no effect: options of the solvers begin with one of "
            f"{', '.join('-' + p for p in reversed(PREFIXES))} (docs/linear_solvers.md){near}"
        )
    return lines


HOMES = {
    **dict.fromkeys(("run", "list", "check", "mesh"), "cases"),
    **dict.fromkeys(("render", "plot", "report", "members", "crush", "info"), "results"),
    **dict.fromkeys(("sweep", "completion"), "cases"),
    "bench": "machine",
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

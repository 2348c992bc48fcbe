"""The command line: finds the verb, runs it on its ranks, and converts errors to messages and exit status."""

from __future__ import annotations

import argparse
import contextlib
import difflib
import importlib
import io
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from ..case.toml import built_in_cases
from ..errors import InputError
from ..signals import give_back_early
from .launcher import collectively, launched_rank, on_first_rank, refuse
from .parser import PROGRAM, Parser, add_debug

if TYPE_CHECKING:
    from mpi4py import MPI

VERBS = ("run", "list", "check", "mesh", "render", "plot", "report", "info", "sweep", "bench", "completion")
"""Modules of this package: ``EXAMPLE``, ``RANKS``, ``add_arguments(parser)`` and ``run(arguments[, comm])``."""

EXAMPLES = f"""\
examples:
  mpirun -n 2 {PROGRAM} rod_impact
  {PROGRAM} list
  {PROGRAM} check my_case.toml
  mpirun -n 2 {PROGRAM} my_case.toml -o results/fine --set time.step=1e-5 -- -log_view
  {PROGRAM} info results/rod_impact
  mpirun -n 2 {PROGRAM} bench --sizes 100000

CASE alone means run. Everything after -- goes to PETSc. VERB --help shows more."""


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
    warnings.formatwarning = lambda message, *_, **__: f"warning: {message}\n"
    try:
        arguments, verb = _parse(words[:cut], words[cut + 1 :])
    except InputError as error:
        return refuse(error, debug)
    except SystemExit as done:  # --help and --version
        return int(done.code or 0)

    def run_verb(*comm: MPI.Comm) -> int:
        if arguments.verb != "run":
            give_back_early()
        return verb.run(arguments, *comm)

    ranks = verb.ranks(arguments) if hasattr(verb, "ranks") else verb.RANKS
    if ranks == "all":
        return collectively(run_verb, debug)
    return on_first_rank(run_verb, debug, uses_mpi=ranks == "one")


def _parse(words: Sequence[str], petsc_options: Sequence[str] = ()) -> tuple[argparse.Namespace, ModuleType]:
    for word in (*words, *petsc_options):
        try:
            word.encode()
        except UnicodeEncodeError as error:
            shown = word.encode(errors="surrogateescape").decode(errors="backslashreplace")
            raise InputError(f"{shown}: has bytes that are not UTF-8: rename the file, or give other text") from error
    if not words:
        raise InputError(f"CASE or a verb is missing: {', '.join(VERBS)}; see {PROGRAM} --help")
    if words[0] not in (*VERBS, "-h", "--help", "--version"):
        near = difflib.get_close_matches(words[0], VERBS, n=1, cutoff=0.7)
        if near and not Path(words[0]).exists() and words[0] not in built_in_cases():
            raise InputError(f"{words[0]}: there is no such verb or case; did you mean '{near[0]}'?")
        words = ["run", *words]
    parser, verbs = make_parser()
    # One rank prints help.
    with contextlib.redirect_stdout(io.StringIO()) if launched_rank() else contextlib.nullcontext():
        arguments, unknown = parser.parse_known_args(words)
    verb = verbs[arguments.verb]
    if unknown:
        # the common parser would refer to its own help
        raise InputError(f"unrecognized arguments: {' '.join(unknown)}; see {PROGRAM} {arguments.verb} --help")
    if petsc_options and verb.RANKS != "all":
        raise InputError(f"{arguments.verb} takes no PETSc options: {' '.join(petsc_options)}")
    arguments.petsc_options = list(petsc_options)
    return arguments, verb


def make_parser() -> tuple[Parser, dict[str, ModuleType]]:
    """Return the parser of all verbs, and their modules by name."""
    from .. import __version__

    parser = Parser(
        prog=PROGRAM,
        description="Dynamics and statics of large trusses: impact, buckling, yielding, form finding.",
        epilog=EXAMPLES,
    )
    parser.add_argument("--version", action="version", version=f"pfem_petsc {__version__}")
    subparsers = parser.add_subparsers(dest="verb", metavar="VERB", required=True)
    verbs = {name: importlib.import_module(f"{__package__}.{name}") for name in VERBS}
    for name, module in verbs.items():
        text = (module.__doc__ or "").strip()
        sub = subparsers.add_parser(
            name, help=text.partition("\n")[0], description=text, epilog=module.EXAMPLE, prog=f"{PROGRAM} {name}"
        )
        module.add_arguments(sub)
        add_debug(sub)
    return parser, verbs

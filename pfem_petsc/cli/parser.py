"""The words of the command line: parser, options that several verbs share, and those after ``--`` for PETSc."""

from __future__ import annotations

import argparse
import dataclasses
import difflib
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from ..errors import InputError
from ..signals import early

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

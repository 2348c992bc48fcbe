"""Print a script that completes verbs, options, built-in cases and keys of --set in a shell."""

from __future__ import annotations

import argparse
from collections.abc import Iterator

from ..case.toml import built_in_cases
from .parser import PROGRAM

RANKS = "one, without MPI"

EXAMPLE = f"""\
examples:
  source <({PROGRAM} completion bash)
  {PROGRAM} completion zsh > ~/.zsh/completions/_pfem-petsc

It completes the command pfem-petsc, and pfem where that is an alias: alias pfem='{PROGRAM}'"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    parser.add_argument("shell", choices=("bash", "zsh"), help="the shell")


def run(arguments: argparse.Namespace) -> int:
    """Print the script."""
    import shtab

    from ..registry import choices
    from . import run as run_verb
    from .main import make_parser

    parser, _ = make_parser()
    words = " ".join(f"{key}=" for key in sorted(set(keys())))
    preamble = {
        "bash": f'_pfem_keys() {{ compopt -o nospace; compgen -W "{words}" -- "$1"; }}',
        "zsh": f"_pfem_keys() {{ compadd -S '' -- {words} }}",
    }
    verbs = next(action for action in parser._actions if isinstance(action, argparse._SubParsersAction)).choices
    verbs |= dict.fromkeys(built_in_cases(), verbs["run"])
    run_verb.add_arguments(parser)
    for each in _parsers(parser):
        for action in each._actions:
            if action.dest in ("overrides", "vary"):
                action.complete = dict.fromkeys(preamble, "_pfem_keys")
            elif action.dest == "case":
                action.choices = built_in_cases()
            elif action.dest == "what":
                action.choices = [*choices("pfem_petsc.mesh.generators"), *built_in_cases()]
            elif action.choices is None and action.nargs != 0 and action.type is None:
                action.complete = shtab.FILE
    parser.prog = "pfem-petsc"
    script = shtab.complete(parser, arguments.shell, root_prefix="pfem", preamble=preamble)
    if arguments.shell == "bash":
        script += "\ncomplete -o bashdefault -F _shtab_pfem pfem"
    print(script.replace("#compdef pfem-petsc", "#compdef pfem-petsc pfem"))
    return 0


def _parsers(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    yield parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for each in action.choices.values():
                yield from _parsers(each)


def keys() -> Iterator[str]:
    """Yield the keys of --set: of lists those of the first entry, of named tables those of the built-in cases."""
    from ..case.model import CaseModel, shape_of
    from ..case.schema import Case

    cases = [Case.load(name) for name in built_in_cases()]
    for table, field in CaseModel.model_fields.items():
        shape = shape_of(field)
        many, found = shape.many, shape.keys()
        names = {name for case in cases for name in case.__dict__[table]} if many is dict else ["0"] if many else []
        if not found:
            yield table
        yield from (".".join((table, name, key)) for name in names for key in found)
        yield from (f"{table}.{key}" for key in found if not many)

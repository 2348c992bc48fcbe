"""Verbs about cases and this program: check a case or the machine, list what is built in, complete words in a shell."""

from __future__ import annotations

import argparse
import tomllib
from collections.abc import Iterator
from typing import TYPE_CHECKING

from ..case.toml import built_in_cases, built_in_path
from ..errors import InputError, printable
from ..registry import choices, description
from .parser import CASE, PLUGINS, PROGRAM, Verb, argument, fill
from .run import load_case

if TYPE_CHECKING:
    from mpi4py import MPI

CHECK = f"""\
examples:
  {PROGRAM} check my_case.toml --set time.step=1e-5
  {PROGRAM} check --env

exit status: 0 it can run, 2 invalid input, or something that runs need is missing here"""

LIST = f"""\
example:
  {PROGRAM} list"""

COMPLETION = f"""\
examples:
  source <({PROGRAM} completion bash)
  {PROGRAM} completion zsh > ~/.zsh/completions/_pfem-petsc

It completes the command pfem-petsc, and pfem where that is an alias: alias pfem='{PROGRAM}'"""

KINDS = {
    "integrators": "pfem_petsc.integrators",
    "mesh generators": "pfem_petsc.mesh.generators",
    "mesh formats": "pfem_petsc.formats",
    "material laws": "pfem_petsc.mechanics.materials",
    "walls": "pfem_petsc.contact.walls",
    "constraints": "pfem_petsc.contact.constraints",
    "treatments of impact": "pfem_petsc.contact.treatments",
    "methods of static analyses": "pfem_petsc.statics.methods",
}


OF_CHECK = (
    argument("case", **{**CASE[0].settings, "nargs": "?"}),
    CASE[1],
    PLUGINS,
    argument(
        "--env",
        action="store_true",
        help="check this machine instead: versions, MPI, HDF5, PETSc, OpenGL, and how to install what is missing",
    ),
)


def _ranks_of_check(arguments: argparse.Namespace) -> str:
    """Return which ranks the verb needs: the check of a machine must not start an MPI that may be broken."""
    return "one, without MPI" if arguments.env else "all"


def check(arguments: argparse.Namespace, comm: MPI.Comm | None = None) -> int:
    """Build the simulation without a step, and print its summary. Collective."""
    if arguments.env:
        if arguments.case is not None or arguments.overrides:
            raise InputError("check --env checks the machine and takes no case: give one of the two")
        return _check_machine()
    if arguments.case is None:
        raise InputError(
            f"the following arguments are required: CASE (give it before --set), or --env; see {PROGRAM} check --help"
        )
    case = load_case(arguments, comm)
    from ..simulation import Simulation

    simulation = Simulation(case, comm, check_only=True)
    summary = simulation.summary()
    closer, warnings = simulation.inspect()
    summary |= closer
    obstacle, notice = simulation.obstacle(), simulation.plan.scheme.notice
    if comm.rank == 0:
        width = max(map(len, summary), default=0)
        lines = [printable(case.title), *(f"  {label:{width}}  {text}" for label, text in summary.items())]
        lines += [f"warning: {text}" for text in warnings]
        lines += [f"note: {notice}"] if notice else []
        print("\n".join(lines if obstacle else [*lines, "This case can run."]))
    if obstacle:
        raise InputError(obstacle)
    return 0


def _check_machine() -> int:
    from .environment import inspect_environment, report

    found = inspect_environment()
    print("\n".join(printable(line) for line in report(found)))
    missing = [each.name for each in found if each.state == "missing"]
    if missing:
        raise InputError(f"check --env: missing: {', '.join(missing)}; the list above has the commands to install it")
    print("This machine has everything that runs need.")
    return 0


def list_all(arguments: argparse.Namespace) -> int:
    """Print the lists."""
    sections = {
        "built-in cases": {
            name: tomllib.loads(built_in_path(name).read_text(encoding="utf-8"))["title"] for name in built_in_cases()
        }
    }
    for kind, package in KINDS.items():
        sections[kind] = {name: description(package, name) for name in choices(package)}
    width = max(len(name) for lines in sections.values() for name in lines)
    for kind, lines in sections.items():
        print(f"{kind}:")
        if not lines:
            print("  none is built in; CONTRIBUTING.md has an example and says how to add one")
        for name, text in lines.items():
            print(f"  {name:{width}}  {text}")
    return 0


OF_COMPLETION = (argument("shell", choices=("bash", "zsh"), help="the shell"),)


def completion(arguments: argparse.Namespace) -> int:
    """Print the script."""
    import shtab

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
    fill(parser, run_verb.ARGUMENTS)
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


VERBS = (
    Verb(
        "list",
        "List the built-in cases, integrators, mesh generators and formats, walls, constraints, treatments, methods.",
        LIST,
        "one, without MPI",
        (),
        list_all,
    ),
    Verb(
        "check",
        "Check a case: read it, build its mesh and model, and summarise the run. Or, by --env, check this machine.",
        CHECK,
        _ranks_of_check,
        OF_CHECK,
        check,
    ),
    Verb(
        "completion",
        "Print a script that completes verbs, options, built-in cases and keys of --set in a shell.",
        COMPLETION,
        "one, without MPI",
        OF_COMPLETION,
        completion,
    ),
)

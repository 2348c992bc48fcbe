"""Print a script that completes verbs, options, built-in cases and keys of --set in a shell."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import Any

from ..case.builtin import built_in_cases
from .parser import PROGRAM, Parser

RANKS = "one, without MPI"
SHELLS = ("bash", "zsh", "fish")

EXAMPLE = f"""\
examples:
  source <({PROGRAM} completion bash)
  {PROGRAM} completion zsh > ~/.zsh/completions/_pfem-petsc
  {PROGRAM} completion fish > ~/.config/fish/completions/pfem-petsc.fish

It completes the command pfem-petsc, and pfem where that is an alias: alias pfem='{PROGRAM}'"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    parser.add_argument("shell", choices=SHELLS, help="the shell")


def run(arguments: argparse.Namespace) -> int:
    """Print the script."""
    from .main import make_parser

    parser, _ = make_parser()
    words = words_of(parser)
    print({"bash": bash, "zsh": zsh, "fish": fish}[arguments.shell](words), end="")
    return 0


def words_of(parser: Parser) -> dict[str, Any]:
    """Return ``verbs``, ``cases``, ``keys`` of --set, ``options`` of each verb, and the ``choices`` of options."""
    (verbs,) = (action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    options: dict[str, list[str]] = {}
    chosen: dict[tuple[str, str], list[str]] = {}
    with_case = []
    for verb, sub in verbs.choices.items():
        options[verb] = [text for action in sub._actions for text in action.option_strings if text.startswith("--")]
        if any(action.dest == "case" for action in sub._actions):
            with_case.append(verb)
        for action in sub._actions:
            for text in action.option_strings if action.choices else ():
                chosen[verb, text] = [str(value) for value in action.choices or ()]
    return {
        "verbs": list(verbs.choices),
        "cases": list(built_in_cases()),
        "keys": sorted(set(keys())),
        "options": options,
        "choices": chosen,
        "with_case": with_case,
    }


def keys() -> Iterator[str]:
    """Yield the keys of --set: of lists those of the first entry, of named tables those of the built-in cases."""
    from ..case import settings, tables
    from ..case.materials import LAWS
    from ..case.reading import GENERATORS, INTEGRATORS, STATIC_METHODS, WALLS
    from ..case.schema import Case
    from ..contact.walls.base import WallKeys
    from ..mechanics.materials.base import MaterialKeys

    yield "title"
    families = {
        "mesh": (GENERATORS, tables.MeshKeys),
        "time": (INTEGRATORS, settings.TimeKeys),
        "static": (STATIC_METHODS, settings.StaticKeys),
        "wall.0": (WALLS, WallKeys),
    }
    for table, (package, common) in families.items():
        yield from (f"{table}.{key}" for key in (*common.model_fields, *_of_modules(package)))
    yield from ("wall.0.type", "wall.0.name", "wall.0.node_set")
    alone = {"solver": settings.Solver, "output": settings.OutputKeys, "contact": settings.ContactSettings}
    alone |= {"modes": settings.Modes, "gravity": tables.Gravity, "wind": tables.Wind, "initial": tables.Initial}
    listed = {"load": tables.Load, "support": tables.Support, "temperature": tables.Temperature}
    listed |= {"contact_pair": tables.ContactPair, "remove": tables.Remove, "mass": tables.NodalMass}
    listed |= {"spring": tables.Spring, "dashpot": tables.Dashpot}
    for table, model in {**alone, **{f"{name}.0": model for name, model in listed.items()}}.items():
        yield from (f"{table}.{key}" for key in model.model_fields)
    materials = (*MaterialKeys.model_fields, *_of_modules(LAWS))
    for name in built_in_cases():
        case = Case.load(name)
        yield from (f"material.{each}.{key}" for each in case.material for key in materials)
        yield from (f"section.{each}.{key}" for each in case.section for key in tables.Section.model_fields)
        yield from (f"node_set.{each}.{key}" for each in case.node_set for key in tables.NodeSet.model_fields)


def _of_modules(package: str) -> Iterator[str]:
    from ..registry import choices, lookup

    for name in choices(package):
        model = getattr(lookup(package, name, ""), "Parameters", None)
        yield from getattr(model, "model_fields", ())


def bash(words: dict[str, Any]) -> str:
    """Return the script for bash."""
    options = "\n".join(f'        {verb}) options="{" ".join(found)}" ;;' for verb, found in words["options"].items())
    chosen = "\n".join(
        f'        "{verb} {option}") words="{" ".join(found)}" ;;' for (verb, option), found in words["choices"].items()
    )
    return f"""\
# Completion of pfem-petsc for bash: source it.
_pfem_petsc() {{
    local line=$COMP_LINE current verb option words options word k
    # words as typed: the shell itself also splits them at "=" and ":"
    line=${{line:0:COMP_POINT}}
    read -ra typed <<< "$line"
    if [[ $line == *[[:space:]] ]]; then typed+=(""); fi
    current=${{typed[-1]}}
    verb=run option=
    for ((k = 1; k < ${{#typed[@]}} - 1; k++)); do
        word=${{typed[k]}}
        if [[ $k == 1 && " {" ".join(words["verbs"])} " == *" $word "* ]]; then verb=$word; fi
        if [[ $word == -* ]]; then option=$word; fi
    done
    case $verb in
{options}
    esac
    words=
    if [[ $current == -* ]]; then
        words=$options
    elif [[ $option == --set || $option == --vary ]]; then
        words="{" ".join(key + "=" for key in words["keys"])}"
        if [[ $current == *=* ]]; then words=; fi
        compopt -o nospace
    else
        case "$verb $option" in
{chosen}
        *)
            if [[ ${{#typed[@]}} == 2 ]]; then words="{" ".join([*words["verbs"], *words["cases"]])}"
            elif [[ " {" ".join(words["with_case"])} " == *" $verb "* && -z $option ]]; then
                words="{" ".join(words["cases"])}"
            elif [[ $verb == completion ]]; then words="{" ".join(SHELLS)}"
            fi ;;
        esac
        compopt -o default
    fi
    mapfile -t COMPREPLY < <(compgen -W "$words" -- "$current")
}}
complete -F _pfem_petsc pfem-petsc pfem
"""


def zsh(words: dict[str, Any]) -> str:
    """Return the script for zsh: that of bash by its compatible completion."""
    return f"""\
#compdef pfem-petsc pfem
# Completion of pfem-petsc for zsh: source it, or put it as _pfem-petsc into a folder of $fpath.
_pfem_petsc_zsh() {{
    local verb=run option= word k
    for ((k = 2; k < CURRENT; k++)); do
        word=$words[k]
        if [[ $k == 2 && " {" ".join(words["verbs"])} " == *" $word "* ]]; then verb=$word; fi
        if [[ $word == -* ]]; then option=$word; fi
    done
    local -A options=({" ".join(f"{verb} '{' '.join(found)}'" for verb, found in words["options"].items())})
    if [[ $PREFIX == -* ]]; then
        compadd -- ${{=options[$verb]}}
    elif [[ $option == --set || $option == --vary ]]; then
        compadd -S '' -- {" ".join(key + "=" for key in words["keys"])}
    elif [[ $CURRENT == 2 ]]; then
        compadd -- {" ".join([*words["verbs"], *words["cases"]])}; _files
    else
        if [[ " {" ".join(words["with_case"])} " == *" $verb "* && -z $option ]]; then
            compadd -- {" ".join(words["cases"])}
        elif [[ $verb == completion ]]; then
            compadd -- {" ".join(SHELLS)}
        fi
        _files
    fi
}}
compdef _pfem_petsc_zsh pfem-petsc pfem
"""


def fish(words: dict[str, Any]) -> str:
    """Return the script for fish."""
    verbs = " ".join(words["verbs"])
    lines = [
        "# Completion of pfem-petsc for fish.",
        f"complete -c pfem-petsc -n 'not __fish_seen_subcommand_from {verbs}' -a '{verbs}'",
    ]
    cases = " ".join(words["cases"])
    lines.append(f"complete -c pfem-petsc -n 'test (count (commandline -opc)) -le 2' -a '{cases}'")
    for verb, options in words["options"].items():
        seen = f"__fish_seen_subcommand_from {verb}" if verb != "run" else f"not __fish_seen_subcommand_from {verbs}"
        for option in options:
            found = words["choices"].get((verb, option))
            extra = f" -x -a '{' '.join(found)}'" if found else ""
            if option in ("--set", "--vary"):
                extra = f" -x -a '{' '.join(key + '=' for key in words['keys'])}'"
            lines.append(f"complete -c pfem-petsc -n '{seen}' -l {option.removeprefix('--')}{extra}")
    lines.append(f"complete -c pfem-petsc -n '__fish_seen_subcommand_from completion' -a '{' '.join(SHELLS)}'")
    return "\n".join([*lines, ""])

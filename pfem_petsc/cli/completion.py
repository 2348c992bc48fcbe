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
    """Return what there is to complete.

    Returns
    -------
    ``verbs``, ``keys`` of --set, and by verb, or by verb and action as "mesh generate": ``options``, ``first``, the
    words that the first argument may be, and ``choices`` of options by (verb, option).
    """
    from ..registry import choices

    cases = list(built_in_cases())
    generators = list(choices("pfem_petsc.mesh.generators"))
    options: dict[str, list[str]] = {}
    first: dict[str, list[str]] = {}
    chosen: dict[tuple[str, str], list[str]] = {}
    verbs = _subparsers(parser)
    actions = {f"{verb} {name}": each for verb, sub in verbs.items() for name, each in _subparsers(sub).items()}
    for verb, sub in {**verbs, **actions}.items():
        options[verb] = [text for action in sub._actions for text in action.option_strings if text.startswith("--")]
        dests = {action.dest: action for action in sub._actions}
        if _subparsers(sub):
            first[verb] = list(_subparsers(sub))
        elif "case" in dests and not dests["case"].option_strings:
            first[verb] = cases
        elif "what" in dests:
            first[verb] = [*generators, *cases]
        elif "shell" in dests:
            first[verb] = list(SHELLS)
        for action in sub._actions:
            for text in action.option_strings if action.choices else ():
                chosen[verb, text] = [str(value) for value in action.choices or ()]
    return {"verbs": list(verbs), "keys": sorted(set(keys())), "options": options, "first": first, "choices": chosen}


def _subparsers(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    found = [action.choices for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    return found[0] if found else {}


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
    options = "\n".join(f'        "{verb}") options="{" ".join(found)}" ;;' for verb, found in words["options"].items())
    first = "\n".join(f'        "{verb}") first="{" ".join(found)}" ;;' for verb, found in words["first"].items())
    chosen = "\n".join(
        f'        "{verb} {option}") words="{" ".join(found)}" ;;' for (verb, option), found in words["choices"].items()
    )
    return f"""\
# Completion of pfem-petsc for bash: source it.
_pfem_petsc() {{
    local line=$COMP_LINE current verb=run option= words= options= first= arguments=0 word k
    # words as typed: the shell itself also splits them at "=" and ":"
    line=${{line:0:COMP_POINT}}
    read -ra typed <<< "$line"
    if [[ $line == *[[:space:]] ]]; then typed+=(""); fi
    current=${{typed[-1]}}
    for ((k = 1; k < ${{#typed[@]}} - 1; k++)); do
        word=${{typed[k]}}
        if [[ $k == 1 && " {" ".join(words["verbs"])} " == *" $word "* ]]; then verb=$word
        elif [[ $k == 2 && " {_compound(words)} " == *" $verb/$word "* ]]; then verb="$verb $word"
        elif [[ $word == -* ]]; then option=$word
        elif [[ -z $option ]]; then arguments=1
        fi
    done
    case $verb in
{options}
    esac
    case $verb in
{first}
    esac
    if [[ ${{#typed[@]}} == 2 ]]; then first="{" ".join([*words["verbs"], *words["first"]["run"]])}"; fi
    if [[ $current == -* ]]; then
        words=$options
    elif [[ $option == --set || $option == --vary ]]; then
        words="{_keys(words)}"
        if [[ $current == *=* ]]; then words=; fi
        compopt -o nospace
    else
        case "$verb $option" in
{chosen}
        *)
            if [[ -z $option && $arguments == 0 ]]; then words=$first; fi ;;
        esac
        compopt -o default
    fi
    mapfile -t COMPREPLY < <(compgen -W "$words" -- "$current")
}}
complete -F _pfem_petsc pfem-petsc pfem
"""


def _keys(words: dict[str, Any]) -> str:
    return " ".join(key + "=" for key in words["keys"])


def _compound(words: dict[str, Any]) -> str:
    """Return verbs with their actions, as mesh/generate."""
    return " ".join(verb.replace(" ", "/") for verb in words["options"] if " " in verb)


def zsh(words: dict[str, Any]) -> str:
    """Return the script for zsh."""
    chosen = {f"{verb} {option}": found for (verb, option), found in words["choices"].items()}
    return f"""\
#compdef pfem-petsc pfem
# Completion of pfem-petsc for zsh: source it, or put it as _pfem-petsc into a folder of $fpath.
_pfem_petsc_zsh() {{
    local verb=run option= word k arguments=0
    for ((k = 2; k < CURRENT; k++)); do
        word=$words[k]
        if [[ $k == 2 && " {" ".join(words["verbs"])} " == *" $word "* ]]; then verb=$word
        elif [[ $k == 3 && " {_compound(words)} " == *" $verb/$word "* ]]; then verb="$verb $word"
        elif [[ $word == -* ]]; then option=$word
        elif [[ -z $option ]]; then arguments=1
        fi
    done
    local -A options=({_table(words["options"])})
    local -A first=({_table(words["first"])})
    local -A chosen=({_table(chosen)})
    if [[ $CURRENT == 2 ]]; then first[run]="{" ".join([*words["verbs"], *words["first"]["run"]])}"; fi
    if [[ $PREFIX == -* ]]; then
        compadd -- ${{=options[$verb]}}
    elif [[ $option == --set || $option == --vary ]]; then
        compadd -S '' -- {_keys(words)}
    elif [[ -n ${{chosen[$verb $option]}} ]]; then
        compadd -- ${{=chosen[$verb $option]}}
    else
        if [[ -z $option && $arguments == 0 ]]; then compadd -- ${{=first[$verb]}}; fi
        _files
    fi
}}
if [[ $funcstack[1] == _pfem-petsc ]]; then
    _pfem_petsc_zsh "$@"
else
    if ! whence compdef > /dev/null; then autoload -Uz compinit; compinit; fi
    compdef _pfem_petsc_zsh pfem-petsc pfem
fi
"""


def _table(named: dict[str, list[str]]) -> str:
    return " ".join(f"'{name}' '{' '.join(found)}'" for name, found in named.items())


def fish(words: dict[str, Any]) -> str:
    """Return the script for fish."""
    verbs, named = " ".join(words["verbs"]), "complete -c pfem-petsc"
    lines = [
        "# Completion of pfem-petsc for fish.",
        "function __pfem_petsc_at  # verb, number of words before this one",
        "    set -l typed (commandline -opc)",
        '    test (count $typed) = $argv[2]; and string match -q -- "$argv[1]*" "$typed[2..]"',
        "end",
        "function __pfem_petsc_keys",
        "    set -l typed (commandline -opc)",
        "    set -l last (string match -- '-*' $typed)[-1]",
        "    contains -- $last --set --vary",
        "end",
        f"{named} -n '__pfem_petsc_at \"\" 1' -a '{verbs} {' '.join(words['first']['run'])}'",
        f"{named} -n '__pfem_petsc_keys' -f -a '{_keys(words)}'",
    ]
    for verb, found in words["first"].items():
        at = len(verb.split()) + 1
        lines.append(f"{named} -n '__pfem_petsc_at \"{verb}\" {at}' -a '{' '.join(found)}'")
    for verb, options in words["options"].items():
        seen = "; and ".join(f"__fish_seen_subcommand_from {word}" for word in verb.split())
        seen = seen if verb != "run" else f"not __fish_seen_subcommand_from {verbs}; or {seen}"
        for option in options:
            found = words["choices"].get((verb, option))
            extra = f" -x -a '{' '.join(found)}'" if found else ""
            lines.append(f"{named} -n '{seen}' -l {option.removeprefix('--')}{extra}")
    return "\n".join([*lines, "complete -c pfem -w pfem-petsc", ""])

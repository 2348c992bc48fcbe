"""Run a case for all combinations of values of some keys, and write a table."""

from __future__ import annotations

import argparse
import tomllib
from pathlib import Path
from typing import Any

from ..errors import InputError, printable
from .parser import CASE, PROGRAM, Verb, argument, seconds

EXAMPLE = f"""\
examples:
  {PROGRAM} sweep rod_impact --vary time.step=0.005,0.01,0.02
  {PROGRAM} sweep my_case.toml --vary "initial.velocity=[1,0,0],[2,0,0]" --vary section.leg.area=1e-4,2e-4 --processes 4

exit status: 0 all runs are done, 3 some are not (see the column status of the table)"""


ARGUMENTS = (
    *CASE,
    argument(
        "--vary",
        metavar="KEY=VALUES",
        nargs="+",
        action="extend",
        required=True,
        help="values of a key, separated by commas; with several keys, all combinations",
    ),
    argument("-o", "--output", metavar="DIR", type=Path, help="output folder; default: results/NAME OF THE CASE-sweep"),
    argument("--processes", metavar="N", type=int, default=1, help="number of runs at a time; default: 1"),
    argument(
        "--results",
        metavar="NAME",
        nargs="+",
        help="columns of the history whose last values are in the table; vectors have a column for each component, "
        "wall/floor/force.z is one of them",
    ),
    argument("--remove", action="store_true", help="remove the results of the runs, and keep the table only"),
    argument("--wall-time", metavar="TIME", type=seconds, help="stop a run after this time"),
    argument("--quiet", action="store_true", help="print no progress"),
)


def run(arguments: argparse.Namespace) -> int:
    """Make the runs, and print the table and the name of its file."""
    from ..case.schema import Case
    from ..studies.sweep import sweep

    vary: dict[str, list[Any]] = {}
    for key, values in map(_values, arguments.vary):
        if vary.setdefault(key, values) is not values:
            raise InputError(f"--vary {key}=...: given twice; give all its values in one list, {key}=VALUE,VALUE,VALUE")
    case = Case.load(arguments.case, arguments.overrides)
    output = arguments.output or Path("results") / f"{case.name}-sweep"
    table = sweep(
        case,
        vary,
        processes=arguments.processes,
        results={name: name for name in arguments.results} if arguments.results else None,
        output=output,
        keep=not arguments.remove,
        wall_time=arguments.wall_time,
        quiet=arguments.quiet,
    )
    print(printable(str(table)))
    print(output / "sweep.csv")
    return 3 if table["status"].any() else 0


def _values(text: str) -> tuple[str, list[Any]]:
    """Return key and values of ``KEY=VALUE,VALUE``; each value is TOML, or else plain text."""
    key, _, values = text.partition("=")
    found = _toml(f"[{values}]")
    if not values.strip() or found == []:
        raise InputError(f"--vary {text}: expected KEY=VALUES, like time.step=1e-5,2e-5")
    if found is not None:
        return key.strip(), found
    parts, begun = [], ""
    for piece in values.split(","):
        begun = f"{begun},{piece}" if begun else piece
        # a comma within a list, a table or a text in quotes divides no values
        if all(begun.count(a) == begun.count(b) for a, b in ("[]", "{}")) and begun.count('"') % 2 == 0:
            parts.append(begun.strip())
            begun = ""
    parts += [begun.strip()] if begun else []
    return key.strip(), [part if (value := _toml(part)) is None else value for part in parts]


def _toml(text: str) -> Any:
    """Return the value of a text, None if it is none."""
    try:
        (value,) = tomllib.loads(f"value = {text}").values()
    except (ValueError, RecursionError):  # also that of several keys
        return None
    return value


VERBS = (Verb("sweep", str(__doc__), EXAMPLE, "one", ARGUMENTS, run),)

"""Show the content of a result: case, versions, snapshots, history and energy balance."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import TYPE_CHECKING

from ..columns import LOST, STORED, SUPPLIED
from ..errors import printable
from .parser import PROGRAM, add_result, surviving

if TYPE_CHECKING:
    import numpy as np

    from ..output.result import Modes, Result

RANKS = "one"

EXAMPLE = f"""\
examples:
  {PROGRAM} info results/rod_impact
  {PROGRAM} info results/rod_impact --verify"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    add_result(parser)
    parser.add_argument(
        "--verify", action="store_true", help="compare all values with their checksums; status 2 if one differs"
    )


def run(arguments: argparse.Namespace) -> int:
    """Print the summary of a result."""
    path = surviving(arguments.result, deep=arguments.verify or None, refuse=arguments.verify)
    from ..output.result import open_result

    with open_result(path) as result:
        print("\n".join(printable(line) for line in describe(result)))
    if arguments.verify:
        print("All values match their checksums.")
    return 0


def describe(result: Result) -> list[str]:
    """Return a description of a result, as lines."""
    rows = {"file": str(result.path), "mesh": f"{result.n_nodes:,} nodes, {result.n_bars:,} bars"}
    rows |= {key: str(value) for key, value in result.attributes.items() if value not in ("", {}, [])}
    times, axis, history = result.times, result.axis, result.history
    names = list(history)
    time = history["time"] if "time" in names else ()
    rows["snapshots"] = f"{len(times)}: {axis.span(times[0], times[-1])}" if len(times) else "0"
    rows["history"] = f"{len(time)} rows: {axis.span(time[0], time[-1])}" if len(time) else "0 rows"
    width = max(map(len, rows))
    lines = [result.case.title, *(f"  {label:{width}}  {text}" for label, text in rows.items())]
    lines += _modes(result.modes) if result.n_modes else []
    lines += ["history columns:", "  " + " ".join(names)]
    if len(time):
        lines += _energies(history, [name for name in (*STORED, *LOST, *SUPPLIED) if name in names])
    broken = history["broken_bars"] if len(time) and "broken_bars" in names else [0]
    if broken[-1]:
        first = axis.place(float(time[(broken > 0).argmax()]))
        lines.append(f"{int(broken[-1]):,} of {result.n_bars:,} bars broke, the first at {first}")
    return lines


def _modes(modes: Modes) -> list[str]:
    """The frequencies or load factors, some in a line."""
    from ..output.layout import MODE_VALUES

    name, unit = MODE_VALUES[modes.kind]
    values = [f"{value:.6g}" for value in modes.values]
    heading = f"modes of {modes.kind}, {name.replace('_', ' ')}{f' [{unit}]' if unit else ''}:"
    return [heading, *("  " + "  ".join(values[k : k + 8]) for k in range(0, len(values), 8))]


def _energies(history: Mapping[str, np.ndarray], present: list[str]) -> list[str]:
    """Return energies [J] at start and end and their imbalance, also relative to the largest energy in between."""
    from ..output.units import engineering

    if not present:
        return []
    width = max(map(len, (*present, "balance error")))
    lines, error = [f"{'energy':{width + 2}}  {'start':>12}  {'end':>12}"], 0.0
    for name in present:
        start, end = float(history[name][0]), float(history[name][-1])
        error += (start - end) if name in SUPPLIED else (end - start)
        lines.append(f"  {name:{width}}  {engineering(start, 'J'):>12}  {engineering(end, 'J'):>12}")
    scale = max(float(abs(history[name]).max()) for name in present)
    relative = f" ({error / scale:.1e} of the largest)" if scale > 0.0 else ""
    return [*lines, f"  {'balance error':{width}}  {engineering(error, 'J'):>26}{relative}"]

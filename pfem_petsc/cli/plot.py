"""Plot the history of a result: energies, momentum, probes, walls, solver."""

from __future__ import annotations

import argparse
from pathlib import Path

from .parser import PROGRAM, add_result, surviving

RANKS = "one"

EXAMPLE = f"""\
examples:
  {PROGRAM} plot results/rod_impact
  {PROGRAM} plot results/rod_impact --curves wall/wall/force probe/tip/velocity"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    add_result(parser)
    parser.add_argument(
        "-o", "--output", metavar="DIR", type=Path, help="folder of the pictures; default: the result's"
    )
    parser.add_argument(
        "--curves",
        metavar="NAME",
        nargs="+",
        action="extend",
        help="columns of the history to plot in one picture (info lists them); default: the usual pictures",
    )


def run(arguments: argparse.Namespace) -> int:
    """Plot, and print the names of the files written."""
    from ..post.plot import plot

    for path in plot(surviving(arguments.result), arguments.output, curves=arguments.curves):
        print(path)
    return 0

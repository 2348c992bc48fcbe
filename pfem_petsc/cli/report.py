"""Write a report of a run, one HTML file: case, summary, warnings, pictures, curves, energies, cost."""

from __future__ import annotations

import argparse
from pathlib import Path

from .parser import PROGRAM, add_result, surviving

RANKS = "one"

EXAMPLE = f"""\
examples:
  {PROGRAM} report results/rod_impact
  {PROGRAM} report results/ring_impact -o ring.html --filter cfc:180"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    add_result(parser)
    parser.add_argument(
        "-o",
        "--output",
        metavar="FILE",
        type=Path,
        help="file name; default: report.html in the folder of the result",
    )
    parser.add_argument(
        "--no-pictures", dest="pictures", action="store_false", help="do not draw the truss, which takes some seconds"
    )
    parser.add_argument("--field", default="stress", help="field that colours the bars; default: %(default)s")
    parser.add_argument(
        "--filter", dest="force_filter", metavar="FILTER", help="filter of forces, like cfc:180: see plot --help"
    )


def run(arguments: argparse.Namespace) -> int:
    """Write the report, and print its name."""
    from ..post.report import write_report

    options = {name: getattr(arguments, name) for name in ("pictures", "field", "force_filter")}
    print(write_report(surviving(arguments.result), arguments.output, **options))
    return 0

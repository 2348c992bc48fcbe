"""Plot the history of results: energies, momentum, probes, walls, force-displacement, spectra, comparisons."""

from __future__ import annotations

import argparse
from pathlib import Path

from .parser import PROGRAM, surviving

RANKS = "one"

EXAMPLE = f"""\
examples:
  {PROGRAM} plot results/rod_impact
  {PROGRAM} plot results/rod_impact --format png svg pdf csv --filter cfc:60
  {PROGRAM} plot results/rod_impact --curves wall/wall/force probe/tip/velocity
  {PROGRAM} plot results/rod_impact --curves wall/wall/force.x --against centre_of_mass.x
  {PROGRAM} plot results/rod_impact --spectrum probe/tip/velocity.x --window flattop
  {PROGRAM} plot results/coarse results/fine"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    parser.add_argument(
        "results", metavar="RESULT", nargs="+", help="result file, or its folder; several are drawn in one picture"
    )
    parser.add_argument(
        "-o", "--output", metavar="DIR", type=Path, help="folder of the pictures; default: that of the first result"
    )
    parser.add_argument(
        "--curves",
        metavar="NAME",
        nargs="+",
        action="extend",
        help="columns of the history to plot in one picture (info lists them), or components: probe/tip/velocity.x, "
        "momentum.norm; default: the usual pictures",
    )
    parser.add_argument(
        "--against", metavar="NAME", help="column or component over which the curves are drawn; default: time"
    )
    parser.add_argument(
        "--spectrum", metavar="NAME", nargs="+", action="extend", help="columns whose amplitude spectra are drawn"
    )
    parser.add_argument(
        "--window",
        default="hann",
        help="window of spectra: hann, flattop, hamming, blackman, rectangular; default: %(default)s",
    )
    parser.add_argument("--highest", metavar="HZ", type=float, help="frequency at which the spectra end")
    parser.add_argument(
        "--filter",
        dest="force_filter",
        metavar="FILTER",
        help="filter of forces and of --curves: cfc:CLASS (SAE J211), butterworth:HZ[:ORDER], mean:SECONDS, none; "
        "default: forces by the mean of 2 %% of the run",
    )
    parser.add_argument(
        "--format",
        dest="formats",
        metavar="FORMAT",
        nargs="+",
        action="extend",
        help="png, svg, pdf; csv writes what the pictures show as tables; default: png",
    )
    parser.add_argument("--no-closed-form", dest="closed_forms", action="store_false", help="do not draw closed forms")


def run(arguments: argparse.Namespace) -> int:
    """Plot, and print the names of the files written."""
    from ..post.plot import plot

    paths = [surviving(result) for result in arguments.results]
    names = ("curves", "against", "spectrum", "window", "highest", "force_filter", "closed_forms")
    options = {name: getattr(arguments, name) for name in names}
    for path in plot(paths, arguments.output, formats=arguments.formats or ("png",), **options):
        print(path)
    return 0

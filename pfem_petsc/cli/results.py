"""Verbs about results: what is in them, curves of their history, pictures and films, and reports."""

from __future__ import annotations

import argparse
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InputError, printable
from ..post.options import PER, WINDOW, Options, PlotOptions, reader
from .main import PROGRAM, Verb, argument, options_of, surviving

if TYPE_CHECKING:
    from mpi4py import MPI

    from ..output.result import Result

INFO = f"""\
examples:
  {PROGRAM} info results/rod_impact
  {PROGRAM} info results/rod_impact --verify"""

PLOT = f"""\
examples:
  {PROGRAM} plot results/rod_impact
  {PROGRAM} plot results/rod_impact --format png svg pdf csv --filter cfc:60
  {PROGRAM} plot results/rod_impact --curves wall/wall/force probe/tip/velocity
  {PROGRAM} plot results/rod_impact --curves wall/wall/force.x --against centre_of_mass.x
  {PROGRAM} plot results/rod_impact --spectrum probe/tip/velocity.x --window flattop
  {PROGRAM} plot results/coarse results/fine"""

REPORT = f"""\
examples:
  {PROGRAM} report results/rod_impact
  {PROGRAM} report results/ring_impact -o ring.html --filter cfc:180"""


OF_INFO = (
    argument("result", metavar="RESULT", help="result file, or its folder"),
    argument("--verify", action="store_true", help="compare all values with their checksums; status 2 if one differs"),
)


def info(arguments: argparse.Namespace) -> int:
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
    from ..output.table import aligned

    about = {key: str(value) for key, value in result.attributes.items() if value not in ("", {}, [])}
    lines = [result.case.title, *aligned((result.summary() | about).items())]
    if result.n_modes:
        lines += [f"modes of {result.modes.kind}:", result.modes.table().text()]
    return [*lines, "history columns:", "  " + " ".join(result.history)]


OF_PLOT = (
    argument(
        "results", metavar="RESULT", nargs="+", help="result file, or its folder; several are drawn in one picture"
    ),
    argument(
        "-o", "--output", metavar="DIR", type=Path, help="folder of the pictures; default: that of the first result"
    ),
    *options_of(PlotOptions),
)


def plot_history(arguments: argparse.Namespace) -> int:
    """Plot, and print the names of the files written."""
    from ..post.plot import plot

    paths = [surviving(result) for result in arguments.results]
    options = {each.name: getattr(arguments, each.name) for each in fields(PlotOptions)}
    for path in plot(paths, arguments.output, **options):
        print(path)
    return 0


OF_REPORT = (
    argument("result", metavar="RESULT", help="result file, or its folder"),
    argument(
        "-o",
        "--output",
        metavar="FILE",
        type=Path,
        help="file name; default: report.html in the folder of the result",
    ),
    argument(
        "--no-pictures", dest="pictures", action="store_false", help="do not draw the truss, which takes some seconds"
    ),
    argument("--field", default="stress", help="field that colours the bars; default: %(default)s"),
    argument("--filter", dest="force_filter", metavar="FILTER", help="filter of forces, like cfc:180: see plot --help"),
)


def report(arguments: argparse.Namespace) -> int:
    """Write the report, and print its name."""
    from ..post.report import write_report

    options = {name: getattr(arguments, name) for name in ("pictures", "field", "force_filter")}
    print(write_report(surviving(arguments.result), arguments.output, **options))
    return 0


MEMBERS = f"""\
examples:
  {PROGRAM} members results/tower
  {PROGRAM} members results/tower --csv members.csv --picture members.png
  {PROGRAM} members results/tower --each-case --limit 100
  {PROGRAM} members results/tower --case wind --per bar
  {PROGRAM} members results/dome_earthquake --time 4.2"""

OF_MEMBERS = (
    argument("result", metavar="RESULT", help="result file, or its folder"),
    argument("--per", choices=PER, default=PER[0], help="what a row is: a chain of bars on one line, or a bar"),
    argument("--time", metavar="T", type=float, help="state nearest to this time or load factor; default: all"),
    argument("--case", metavar="NAME", help="one load case, combination or stage; default: all"),
    argument("--each-case", action="store_true", help="rows for each of them, instead of for the one that governs"),
    argument("--limit", metavar="N", type=int, default=20, help="rows printed; default: %(default)s; 0: all"),
    argument("--csv", metavar="FILE", type=Path, help="write all rows as CSV"),
    argument("--markdown", metavar="FILE", type=Path, help="write all rows as a table of Markdown"),
    argument("--picture", metavar="FILE", type=Path, help="draw the truss in colours of utilisation, as PNG"),
)


def print_members(arguments: argparse.Namespace) -> int:
    """Print the table of members, and the names of files that are written."""
    from ..output.result import open_result
    from ..post.members import draw_members, members, unfinished

    if arguments.limit < 0:
        raise InputError(f"members: --limit {arguments.limit}: give a number of rows, or 0 for all")
    options = {name: getattr(arguments, name) for name in ("per", "time", "case", "each_case")}
    with open_result(surviving(arguments.result)) as result:
        table, left = members(result, **options), unfinished(result)
    limit = arguments.limit or table.n_rows
    print(printable(table.text(limit)))
    print("in m, N and Pa; tension is positive; governing states are those of the snapshots")
    if left:
        print(f"not computed to their ends, and left out: {', '.join(map(printable, left))}")
    if table.n_rows > limit:
        print(f"{table.n_rows - limit:,} more rows: --limit 0 prints all, --csv writes them")
    for name in ("csv", "markdown"):
        file = getattr(arguments, name)
        if file is not None:
            getattr(table, f"to_{name}")(file)
            print(file)
    if arguments.picture is not None:
        print(draw_members(result, table, arguments.picture, arguments.each_case))
    return 0


CRUSH = f"""\
examples:
  {PROGRAM} crush results/octet_compression --wall plate
  {PROGRAM} crush results/octet_compression --wall plate --area 9e-4 --height 0.03 --csv crush.csv --picture crush.png
  {PROGRAM} crush results/drop --wall floor --displacement probe/top/position.z --window 0.02"""

OF_CRUSH = (
    argument("result", metavar="RESULT", help="result file, or its folder"),
    argument("--wall", metavar="NAME", required=True, help="the wall that compresses the block"),
    argument("--area", metavar="A", type=float, help="of the block across its way [m2]; default: of the box around it"),
    argument("--height", metavar="H", type=float, help="of the block along its way [m]; default: of the box around it"),
    argument(
        "--displacement",
        metavar="NAME",
        help="component of the history whose change compresses the block, where the wall does not move",
    ),
    argument("--window", metavar="STRAIN", type=float, default=WINDOW, help="of means; default: %(default)s; 0: none"),
    argument("--csv", metavar="FILE", type=Path, help="write the curves over strain as CSV"),
    argument("--picture", metavar="FILE", type=Path, help="draw the curves: PNG, SVG or PDF"),
)


def print_crush(arguments: argparse.Namespace) -> int:
    """Print the figures of a crush test, and the names of files that are written."""
    from ..output.table import aligned
    from ..post.crush import crush, draw_crush

    options = {name: getattr(arguments, name) for name in ("area", "height", "displacement", "window")}
    test = crush(surviving(arguments.result), arguments.wall, **options)
    print("\n".join(aligned(test.texts().items())))
    for remark in test.remarks():
        print(remark)
    if arguments.csv is not None:
        print(test.table().to_csv(arguments.csv))
    if arguments.picture is not None:
        print(draw_crush(test, arguments.picture))
    return 0


RENDER = f"""\
examples:
  {PROGRAM} render results/rod_impact
  {PROGRAM} render results/ring_impact --field velocity --component x --clim -20 20
  {PROGRAM} render results/lattice_drop -o pictures --frames 60 --size 1920x1080 --view iso
  {PROGRAM} render results/taut_cable --modes 1,3
  {PROGRAM} render results/ring_impact --ghost --mark yielded --inset wall/wall/force.x --rate 2000 --span 0 0.05
  {PROGRAM} render results/coarse results/fine -o pictures --labels coarse fine
  {PROGRAM} render results/lattice_drop --html
  mpirun -n 4 {PROGRAM} render results/lattice_drop --size 4k --orbit 90"""


OF_RENDER = (
    argument("result", metavar="RESULT", nargs="+", help="result file, or its folder; several are drawn side by side"),
    argument("-o", "--output", metavar="DIR", type=Path, help="folder of the pictures; default: that of the result"),
    argument(
        "--modes",
        metavar="N[,N...]",
        nargs="?",
        const=[],
        type=reader(
            lambda text: [int(part) for part in text.split(",")], "is not a list of numbers of modes like 1,2,5"
        ),
        help="draw the modes of a case with [modes], or those of these numbers, into DIR/modes; --frames is then the "
        "number of frames of a period",
    ),
    *options_of(Options),
    argument(
        "--html", action="store_true", help="write render.html instead: the last state, to be turned in a browser"
    ),
)


def render(arguments: argparse.Namespace, comm: MPI.Comm) -> int:
    """Draw, and print the names of the files written."""
    if arguments.petsc_options:
        raise InputError(f"render takes no PETSc options: {' '.join(arguments.petsc_options)}")
    from ..parallel.agreement import on_root

    options: dict[str, Any] = {each.name: getattr(arguments, each.name) for each in fields(Options)}
    paths = [on_root(comm, surviving, result) for result in arguments.result]
    if arguments.html:
        return _page(paths, arguments) if comm.rank == 0 else 0
    if arguments.modes is not None:
        written = _draw_modes(paths, options, arguments, comm)
    else:
        from ..post import render as drawing

        written = drawing.render(paths, arguments.output, comm=comm, **options)
    if comm.rank:
        return 0
    frames = [path for path in written if path.parent.name == "frames"]
    for path in written:
        if path not in frames:
            print(path)
    if frames:
        print(f"{frames[0]} ... {frames[-1].name}: {len(frames)} frames" if len(frames) > 1 else frames[0])
    return 0


def _page(paths: list[Path], arguments: argparse.Namespace) -> int:
    from ..post.render import render_html

    if len(paths) > 1 or arguments.modes is not None:
        raise InputError("render: --html shows one result; give one RESULT")
    if isinstance(arguments.frames, list):
        raise InputError("render: --frames is the number of one snapshot with --html, as --frames 12")
    chosen = ("field", "component", "clim", "symmetric", "cmap", "scale", "style", "radius_scale", "title", "view")
    options = {name: getattr(arguments, name) for name in chosen}
    others = [each.name for each in fields(Options) if each.name not in (*chosen, "frames")]
    given = [name for name in others if getattr(arguments, name) != getattr(Options(), name)]
    if given:
        raise InputError(f"render: --html does not take {', '.join(given)}; it takes frames, {', '.join(chosen)}")
    frame = -1 if arguments.frames is None else arguments.frames
    print(render_html(paths[0], arguments.output, frame=frame, **options))
    return 0


def _draw_modes(
    paths: list[Path], options: dict[str, Any], arguments: argparse.Namespace, comm: MPI.Comm
) -> list[Path]:
    from ..post.render import render_modes

    if len(paths) > 1:
        raise InputError("render: --modes draws one result; give one RESULT")
    frames = options.pop("frames")
    if isinstance(frames, list):
        raise InputError("render: --frames is the number of frames of a period with --modes: give one number")
    for name in ("rate", "span", "labels"):
        if options[name] is not None:
            raise InputError(f"render: --{name} is for films over time, and not for --modes; leave it out")
    period = {} if frames is None else {"period": frames}
    unused = ("field", "component", *(("clim",) if options["clim"] is None else ()))
    options = {name: value for name, value in options.items() if name not in unused}
    return render_modes(paths[0], arguments.output, modes=arguments.modes or None, comm=comm, **period, **options)


VERBS = (
    Verb(
        "info",
        "Show the content of a result: case, versions, snapshots, history and energy balance.",
        INFO,
        "one",
        OF_INFO,
        info,
    ),
    Verb(
        "plot",
        "Plot the history of results: energies, momentum, probes, walls, force-displacement, spectra, comparisons.",
        PLOT,
        "one",
        OF_PLOT,
        plot_history,
    ),
    Verb(
        "report",
        "Write a report of a run, one HTML file: case, summary, warnings, pictures, curves, energies, cost.",
        REPORT,
        "one",
        OF_REPORT,
        report,
    ),
    Verb(
        "members",
        "List the members: axial forces, stresses, utilisation of strength and of Euler's load, by load case.",
        MEMBERS,
        "one",
        OF_MEMBERS,
        print_members,
    ),
    Verb(
        "crush",
        "Figures of a crush test: stress-strain, first peak, plateau, energy by volume and mass, densification.",
        CRUSH,
        "one",
        OF_CRUSH,
        print_crush,
    ),
    Verb(
        "render",
        "Draw a result: pictures, a film and a poster, without a display.",
        RENDER,
        "all",
        OF_RENDER,
        render,
    ),
)

"""Draw a result: pictures, a film and a poster, without a display."""

from __future__ import annotations

import argparse
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InputError
from ..post.options import Options
from .parser import PROGRAM, Verb, argument, options_of, surviving

if TYPE_CHECKING:
    from mpi4py import MPI

EXAMPLE = f"""\
examples:
  {PROGRAM} render results/rod_impact
  {PROGRAM} render results/ring_impact --field velocity --component x --clim -20 20
  {PROGRAM} render results/lattice_drop -o pictures --frames 60 --size 1920x1080 --view iso
  {PROGRAM} render results/taut_cable --modes 1,3
  {PROGRAM} render results/ring_impact --ghost --mark yielded --inset wall/wall/force.x --rate 2000 --span 0 0.05
  {PROGRAM} render results/coarse results/fine -o pictures --labels coarse fine
  {PROGRAM} render results/lattice_drop --html
  mpirun -n 4 {PROGRAM} render results/lattice_drop --size 4k --orbit 90"""


def _modes(text: str) -> list[int]:
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a list of numbers of modes like 1,2,5") from None


ARGUMENTS = (
    argument("result", metavar="RESULT", nargs="+", help="result file, or its folder; several are drawn side by side"),
    argument("-o", "--output", metavar="DIR", type=Path, help="folder of the pictures; default: that of the result"),
    argument(
        "--modes",
        metavar="N[,N...]",
        nargs="?",
        const=[],
        type=_modes,
        help="draw the modes of a case with [modes], or those of these numbers, into DIR/modes; --frames is then the "
        "number of frames of a period",
    ),
    *options_of(Options),
    argument(
        "--html", action="store_true", help="write render.html instead: the last state, to be turned in a browser"
    ),
    argument("--window", action="store_true", help="show an interactive window instead; needs a display"),
)


def run(arguments: argparse.Namespace, comm: MPI.Comm) -> int:
    """Draw, and print the names of the files written."""
    if arguments.petsc_options:
        raise InputError(f"render takes no PETSc options: {' '.join(arguments.petsc_options)}")
    options: dict[str, Any] = {each.name: getattr(arguments, each.name) for each in fields(Options)}
    paths = [_checked_once(result, comm) for result in arguments.result]
    if arguments.html or arguments.window:
        return _interactive(paths, arguments) if comm.rank == 0 else 0
    if arguments.modes is not None:
        written = _draw_modes(paths, options, arguments, comm)
    else:
        from ..post.render import render

        written = render(paths, arguments.output, comm=comm, **options)
    if comm.rank:
        return 0
    frames = [path for path in written if path.parent.name == "frames"]
    for path in written:
        if path not in frames:
            print(path)
    if frames:
        print(f"{frames[0]} ... {frames[-1].name}: {len(frames)} frames" if len(frames) > 1 else frames[0])
    return 0


def _checked_once(result: str, comm: MPI.Comm) -> Path:
    """Return the result file after one rank has examined it."""
    from ..parallel.agreement import agreed

    with agreed(comm):
        path = surviving(result) if comm.rank == 0 else None
    return comm.bcast(path)


def _interactive(paths: list[Path], arguments: argparse.Namespace) -> int:
    if len(paths) > 1 or arguments.modes is not None or (arguments.html and arguments.window):
        raise InputError("render: --html and --window show one result; give one RESULT and one of the two")
    chosen = ("field", "component", "clim", "symmetric", "cmap", "scale", "style", "radius_scale", "title", "view")
    options = {name: getattr(arguments, name) for name in chosen}
    frame = -1 if arguments.frames is None else arguments.frames
    if isinstance(frame, list):
        raise InputError("render: --frames is the number of one snapshot with --html and --window, as --frames 12")
    if arguments.html:
        from ..post.interactive import render_html

        print(render_html(paths[0], arguments.output, frame=frame, **options))
        return 0
    from ..post.interactive import show

    show(paths[0], frame=frame, **options)
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


VERBS = (Verb("render", str(__doc__), EXAMPLE, "all", ARGUMENTS, run),)

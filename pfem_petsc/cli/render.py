"""Draw a result: pictures, a film and a poster, without a display."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InputError
from .parser import PROGRAM, Verb, surviving

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

SIZES = {"720p": (1280, 720), "1080p": (1920, 1080), "4k": (3840, 2160)}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    parser.add_argument(
        "result", metavar="RESULT", nargs="+", help="result file, or its folder; several are drawn side by side"
    )
    parser.add_argument(
        "-o", "--output", metavar="DIR", type=Path, help="folder of the pictures; default: that of the result"
    )
    parser.add_argument("--field", default="stress", help="field that colours the bars; default: %(default)s")
    parser.add_argument("--component", help="x, y or z of a vector field; default: its magnitude")
    parser.add_argument(
        "--frames",
        metavar="N[,N...]",
        type=_frames,
        help="how many snapshots to draw, or their numbers (one: 12,); default: all",
    )
    parser.add_argument("--fps", type=float, default=24.0, help="frames per second of the film; default: %(default)g")
    parser.add_argument(
        "--modes",
        metavar="N[,N...]",
        nargs="?",
        const=[],
        type=_modes,
        help="draw the modes of a case with [modes], or those of these numbers, into DIR/modes; --frames is then the "
        "number of frames of a period",
    )
    _add_picture(parser)
    _add_camera(parser)
    _add_extras(parser)


def _add_picture(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--size", metavar="WxH", type=_size, default=(1280, 720), help="pixels, or 720p, 1080p, 4k; default: 1280x720"
    )
    parser.add_argument("--video", help="mp4, gif, both, webm, webp or none; default: mp4, webm with --transparent")
    parser.add_argument("--no-poster", dest="poster", action="store_false", help="write no page of six instants")
    parser.add_argument(
        "--clim", metavar=("LOW", "HIGH"), nargs=2, type=float, help="range of the colours [SI]; default: of the values"
    )
    parser.add_argument("--symmetric", action="store_true", help="range of the colours symmetric about zero")
    parser.add_argument("--cmap", help="name of a matplotlib colour map")
    parser.add_argument(
        "--scale", type=float, default=1.0, help="scale factor of displacements, not of walls; default: %(default)g"
    )
    parser.add_argument(
        "--style",
        default="auto",
        help="tubes (with the radii of the sections), lines, auto: tubes up to 20,000 bars",
    )
    parser.add_argument(
        "--radius-scale", type=float, default=1.0, help="factor on the radii of tubes; default: %(default)g"
    )
    parser.add_argument("--bar-width", metavar="PIXELS", type=float, help="minimum width of the bars")
    parser.add_argument(
        "--nodes", action=argparse.BooleanOptionalAction, help="draw nodes as balls; default: for small models"
    )
    parser.add_argument("--title", help="title of the pictures; default: that of the case")
    parser.add_argument("--transparent", action="store_true", help="transparent background")


def _add_camera(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--view",
        type=_view,
        default="auto",
        help="xy, xz, yz, iso, front, back, left, right, top, bottom, a direction to the eye as x,y,z, or auto; "
        "default: %(default)s",
    )
    parser.add_argument("--zoom", type=float, default=1.0, help="factor on the size in the picture; default: 1")
    parser.add_argument(
        "--orbit", metavar="DEGREES", type=float, default=0.0, help="angle of the camera's orbit during the film"
    )
    parser.add_argument("--path", metavar="FILE", help="CSV of time, azimuth, elevation [degrees], zoom of the camera")
    parser.add_argument(
        "--follow",
        metavar="PROBE",
        nargs="?",
        const="structure",
        help="keep the structure, or a probe, in the middle of the picture",
    )
    parser.add_argument(
        "--rate", metavar="N", type=float, help="frames per simulated second, also between snapshots: slow motion"
    )
    parser.add_argument("--span", metavar=("FROM", "TO"), nargs=2, type=float, help="simulated times [s] of the film")


def _add_extras(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--ghost", action="store_true", help="draw the first snapshot, pale, behind the others")
    parser.add_argument(
        "--mark", metavar="STATE", nargs="+", default=[], help="mark bars that are broken or yielded: one or both"
    )
    parser.add_argument("--trails", metavar="PROBE", nargs="+", default=[], help="draw the trajectories of probes")
    parser.add_argument(
        "--inset", metavar="COLUMN", help="curve of the history with a moving marker, as wall/floor/force.z"
    )
    parser.add_argument("--labels", metavar="TEXT", nargs="+", help="captions of the results; default: their folders")
    parser.add_argument(
        "--html", action="store_true", help="write render.html instead: the last state, to be turned in a browser"
    )
    parser.add_argument("--window", action="store_true", help="show an interactive window instead; needs a display")


SHARED = (
    *("fps", "size", "view", "video", "poster", "cmap", "symmetric", "scale", "style", "radius_scale", "bar_width"),
    *("nodes", "title", "transparent", "zoom", "orbit", "follow", "ghost", "trails", "inset"),
)


def run(arguments: argparse.Namespace, comm: MPI.Comm) -> int:
    """Draw, and print the names of the files written."""
    if arguments.petsc_options:
        raise InputError(f"render takes no PETSc options: {' '.join(arguments.petsc_options)}")
    options: dict[str, Any] = {name: getattr(arguments, name) for name in SHARED}
    options |= {"marks": arguments.mark, "comm": comm, "clim": tuple(arguments.clim) if arguments.clim else None}
    if arguments.path is not None:
        from ..post.camera import camera_path

        options["path"] = camera_path(arguments.path)
    paths = [_checked_once(result, comm) for result in arguments.result]
    if arguments.html or arguments.window:
        return _interactive(paths, arguments) if comm.rank == 0 else 0
    if arguments.modes is not None:
        written = _draw_modes(paths, arguments, options)
    else:
        from ..post.render import render

        shown = {name: getattr(arguments, name) for name in ("field", "component", "frames", "rate", "span", "labels")}
        written = render(paths if len(paths) > 1 else paths[0], arguments.output, **shown, **options)
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


def _draw_modes(paths: list[Path], arguments: argparse.Namespace, options: dict[str, Any]) -> list[Path]:
    from ..post.render import render_modes

    if len(paths) > 1:
        raise InputError("render: --modes draws one result; give one RESULT")
    if isinstance(arguments.frames, list):
        raise InputError("render: --frames is the number of frames of a period with --modes: give one number")
    for name in ("rate", "span", "labels"):
        if getattr(arguments, name) is not None:
            raise InputError(f"render: --{name} is for films over time, and not for --modes; leave it out")
    period = {} if arguments.frames is None else {"period": arguments.frames}
    if options["clim"] is None:
        del options["clim"]
    return render_modes(paths[0], arguments.output, modes=arguments.modes or None, **period, **options)


def _view(text: str) -> str | list[float]:
    if "," not in text:
        return text
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a direction like 1,-1,0.5") from None


def _modes(text: str) -> list[int]:
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a list of numbers of modes like 1,2,5") from None


def _frames(text: str) -> int | list[int]:
    parts = text.split(",")
    if len(parts) == 2 and not parts[1].strip():
        del parts[1]  # a list of one number: "12,"
    try:
        numbers = [int(part) for part in parts]
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is neither a number of frames nor a list like 0,10,20") from None
    return numbers if "," in text else numbers[0]


def _size(text: str) -> tuple[int, int]:
    if text.lower() in SIZES:
        return SIZES[text.lower()]
    width, _, height = text.lower().partition("x")
    if not (width.isdigit() and height.isdigit()):
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a size in pixels like 1280x720, or one of {', '.join(SIZES)}"
        )
    return int(width), int(height)


VERBS = (Verb("render", str(__doc__), EXAMPLE, "all", add_arguments, run),)

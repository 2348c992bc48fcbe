"""Draw a result: pictures, a film and a poster, without a display."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from ..errors import InputError
from .parser import PROGRAM, add_result, surviving

RANKS = "one"

EXAMPLE = f"""\
examples:
  {PROGRAM} render results/rod_impact
  {PROGRAM} render results/ring_impact --field velocity --component x --clim -20 20
  {PROGRAM} render results/lattice_drop -o pictures --frames 60 --size 1920x1080 --view iso
  {PROGRAM} render results/taut_cable --modes 1,3"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    add_result(parser)
    parser.add_argument(
        "-o", "--output", metavar="DIR", type=Path, help="folder of the pictures; default: the result's"
    )
    parser.add_argument("--field", default="stress", help="field that colours the bars; default: %(default)s")
    parser.add_argument("--component", help="x, y or z of a vector field; default: its length")
    parser.add_argument(
        "--frames", metavar="N[,N...]", type=_frames, help="how many snapshots to draw, or their numbers; default: all"
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
    parser.add_argument("--size", metavar="WxH", type=_size, default=(1280, 720), help="pixels; default: 1280x720")
    parser.add_argument("--view", default="auto", help="xy, xz, yz, iso or auto; default: %(default)s")
    parser.add_argument("--video", default="mp4", help="mp4, gif, both or none; default: %(default)s")
    parser.add_argument("--no-poster", dest="poster", action="store_false", help="no page of six instants")
    parser.add_argument(
        "--clim", metavar=("LOW", "HIGH"), nargs=2, type=float, help="range of the colours [SI]; default: the values'"
    )
    parser.add_argument("--cmap", help="name of a matplotlib colour map")
    parser.add_argument(
        "--scale", type=float, default=1.0, help="of nodes' displacements, not of walls; default: %(default)g"
    )
    parser.add_argument("--bar-width", metavar="PIXELS", type=float, help="width of the bars")
    parser.add_argument(
        "--nodes", action=argparse.BooleanOptionalAction, help="draw nodes as balls; default: for small models"
    )
    parser.add_argument("--title", help="default: the case's")


def run(arguments: argparse.Namespace) -> int:
    """Draw, and print the names of the files written."""
    options = {
        name: getattr(arguments, name)
        for name in ("fps", "size", "view", "video", "poster", "cmap", "scale", "bar_width", "nodes", "title")
    }
    if arguments.clim is not None:
        options["clim"] = tuple(arguments.clim)
    path = surviving(arguments.result)
    if arguments.modes is not None:
        written = _draw_modes(path, arguments, options)
    else:
        from ..post.render import render

        shown = {name: getattr(arguments, name) for name in ("field", "component", "frames")}
        written = render(path, arguments.output, **shown, **options)
    frames = [path for path in written if path.parent.name == "frames"]
    for path in written:
        if path not in frames:
            print(path)
    if frames:
        print(f"{frames[0]} ... {frames[-1].name}: {len(frames)} frames")
    return 0


def _draw_modes(path: Path, arguments: argparse.Namespace, options: dict[str, Any]) -> list[Path]:
    from ..post.modes import render_modes

    if isinstance(arguments.frames, list):
        raise InputError("render: --frames is the number of frames of a period with --modes: give one number")
    period = {} if arguments.frames is None else {"period": arguments.frames}
    return render_modes(path, arguments.output, modes=arguments.modes or None, **period, **options)


def _modes(text: str) -> list[int]:
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a list of numbers of modes like 1,2,5") from None


def _frames(text: str) -> int | list[int]:
    try:
        numbers = [int(part) for part in text.split(",")]
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is neither a number of frames nor a list like 0,10,20") from None
    return numbers if "," in text else numbers[0]


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.lower().partition("x")
    if not (width.isdigit() and height.isdigit()):
        raise argparse.ArgumentTypeError(f"{text!r} is not a size in pixels like 1280x720")
    return int(width), int(height)

"""Draw a result: pictures, a film and a poster, without a display."""

from __future__ import annotations

import argparse
from pathlib import Path

from .parser import PROGRAM, add_result, surviving

RANKS = "one"

EXAMPLE = f"""\
examples:
  {PROGRAM} render results/rod_impact
  {PROGRAM} render results/ring_impact --field velocity --component x --clim -20 20
  {PROGRAM} render results/lattice_drop -o pictures --frames 60 --size 1920x1080 --view iso"""


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
    from ..post.render import render

    written = render(
        surviving(arguments.result),
        arguments.output,
        field=arguments.field,
        component=arguments.component,
        frames=arguments.frames,
        fps=arguments.fps,
        size=arguments.size,
        view=arguments.view,
        video=arguments.video,
        poster=arguments.poster,
        clim=None if arguments.clim is None else tuple(arguments.clim),
        cmap=arguments.cmap,
        scale=arguments.scale,
        bar_width=arguments.bar_width,
        nodes=arguments.nodes,
        title=arguments.title,
    )
    frames = [path for path in written if path.parent.name == "frames"]
    for path in written:
        if path not in frames:
            print(path)
    if frames:
        print(f"{frames[0]} ... {frames[-1].name}: {len(frames)} frames")
    return 0


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

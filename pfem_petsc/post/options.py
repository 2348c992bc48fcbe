"""The options of pictures, films and curves, declared once for Python, the command line, and their help."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from ..errors import InputError

PER = ("member", "bar")
"""What a row of a table of members may be."""
WINDOW = 0.01
"""Window of strain of a crush test, unless one is given."""

SHOWN = ("supports", "loads")
MARKED = ("broken", "yielded")
STYLES = ("auto", "tubes", "lines")
VIDEOS = {
    "mp4": ("mp4",),
    "gif": ("gif",),
    "both": ("mp4", "gif"),
    "none": (),
    "webm": ("webm",),
    "webp": ("webp",),
}
_RANGES = {"fps": (1e-3, 1e3), "zoom": (1e-3, 1e3), "radius_scale": (1e-6, 1e6)}
SIZES = {"720p": (1280, 720), "1080p": (1920, 1080), "4k": (3840, 2160)}


def reader(convert: Callable[[str], Any], wrong: str) -> Callable[[str], Any]:
    """Return what reads a word of the command line, and tells what is ``wrong`` where ``convert`` has a ValueError."""

    def read(text: str) -> Any:
        try:
            return convert(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r} {wrong}") from None

    return read


def _frames(text: str) -> int | list[int]:
    parts = text.split(",")
    if len(parts) == 2 and not parts[1].strip():
        del parts[1]  # a list of one number: "12,"
    return [int(part) for part in parts] if "," in text else int(text)


frames_of = reader(_frames, "is neither a number of frames nor a list like 0,10,20")
"""Return a number of frames, or the numbers of frames with commas between or behind them."""


def pixels(text: str) -> tuple[int, int]:
    """Return width and height from ``1280x720``, or one of :data:`SIZES`; a ValueError if it is neither."""
    width, _, height = text.lower().partition("x")
    return SIZES[text.lower()] if text.lower() in SIZES else (int(width), int(height))


def _option(default: Any, text: str, **settings: Any) -> Any:
    """Declare an option: its help, and what ``argparse`` must know to read it."""
    return field(default=default, metadata={"help": text, **settings})


@dataclass(frozen=True)
class Options:
    """Options of :func:`~pfem_petsc.post.render.render`.

    Raises
    ------
    InputError
        For values that make no picture.
    """

    field: str = _option("stress", "point or cell field that colours the bars; default: stress")
    component: str | int | None = _option(None, "x, y or z of a vector field; default: its length")
    frames: int | Iterable[int] | None = _option(
        None,
        "how many snapshots to draw, evenly spaced, or their numbers (one: 12,); default: all, up to 300",
        metavar="N[,N...]",
        type=frames_of,
    )
    fps: float = _option(24.0, "frames per second of the film; default: 24", type=float)
    size: tuple[int, int] = _option(
        (1280, 720),
        "pixels of a frame, or 720p, 1080p, 4k; default: 1280x720",
        metavar="WxH",
        type=reader(pixels, f"is not a size in pixels like 1280x720, or one of {', '.join(SIZES)}"),
    )
    view: str | Sequence[float] = _option(
        "auto",
        "xy, xz, yz, iso, front, back, left, right, top, bottom, a direction to the eye as x,y,z, or auto: along the "
        "flat direction of a flat structure, oblique otherwise; default: auto",
        type=reader(
            lambda text: [float(part) for part in text.split(",")] if "," in text else text,
            "is not a direction like 1,-1,0.5",
        ),
    )
    video: str | None = _option(None, "mp4, gif, both, webm, webp or none; default: mp4, webm with transparent")
    poster: bool = _option(True, "write no page of six instants", flag="--no-poster", action="store_false")
    clim: tuple[float, float] | None = _option(
        None,
        "range of the colours [SI]; default: from zero, symmetric if values are negative",
        metavar=("LOW", "HIGH"),
        nargs=2,
        type=float,
    )
    symmetric: bool = _option(False, "range of the colours symmetric about zero", action="store_true")
    cmap: Any = _option(None, "matplotlib colour map or its name")
    scale: float = _option(
        1.0, "factor on the displacements since the first snapshot, not of walls; default: 1", type=float
    )
    style: str = _option("auto", "tubes (with the radii of the sections), lines, auto: tubes up to 20,000 bars")
    radius_scale: float = _option(1.0, "factor on the radii of tubes; default: 1", type=float)
    bar_width: float | None = _option(None, "minimum width of the bars", metavar="PIXELS", type=float)
    nodes: bool | None = _option(
        None, "draw nodes as dots; default: for small models", action=argparse.BooleanOptionalAction
    )
    ghost: bool = _option(False, "draw the first snapshot, pale, behind the others", action="store_true")
    marks: Sequence[str] = _option(
        (),
        "mark bars that are broken (as stubs) or yielded (by a rim): one or both",
        flag="--mark",
        metavar="STATE",
        nargs="+",
    )
    show: Sequence[str] = _option(
        (), "draw supports (as triangles) or loads (as arrows) or both", metavar="KIND", nargs="+"
    )
    trails: Sequence[str] = _option((), "draw the trajectories of probes", metavar="PROBE", nargs="+")
    inset: str | None = _option(
        None, "curve of the history with a moving marker, as wall/floor/force.z", metavar="COLUMN"
    )
    zoom: float = _option(1.0, "factor on the size in the picture; default: 1", type=float)
    orbit: float = _option(0.0, "angle of the camera's orbit during the film", metavar="DEGREES", type=float)
    follow: str | None = _option(
        None,
        "keep the structure, or a probe, in the middle of the picture",
        metavar="PROBE",
        nargs="?",
        const="structure",
    )
    rate: float | None = _option(
        None, "frames per simulated second, also between snapshots: slow motion", metavar="N", type=float
    )
    span: Sequence[float] | None = _option(
        None, "simulated times [s] of the film", metavar=("FROM", "TO"), nargs=2, type=float
    )
    labels: Sequence[str] | None = _option(
        None, "captions of the results; default: their folders", metavar="TEXT", nargs="+"
    )
    transparent: bool = _option(False, "transparent background", action="store_true")
    title: str | None = _option(None, "title of the pictures; default: that of the case")

    def __post_init__(self) -> None:
        video, size = self.video or ("webm" if self.transparent else "mp4"), self.size
        given = [
            ("video", video, VIDEOS),
            ("style", self.style, STYLES),
            *(("show", each, SHOWN) for each in self.show),
            *(("mark", each, MARKED) for each in self.marks),
        ]
        for name, value, known in given:
            if value not in known:
                raise InputError(f"render: {name} = {value!r} is not known; it is one of {', '.join(known)}")
        if self.transparent and video in ("mp4", "both"):
            raise InputError(
                f"render: video = {video!r}: MP4 has no transparent background; use webm, webp, gif or none"
            )
        if size[0] < 160 or size[1] < 120 or max(size) > 8192:
            raise InputError(
                f"render: size = {size[0]} x {size[1]} pixels is out of range; widths are 160 to 8192, heights 120 to "
                "8192"
            )
        for name, (low, high) in _RANGES.items():
            if not low <= getattr(self, name) <= high:
                raise InputError(f"render: {name} = {getattr(self, name):g} must be from {low:g} to {high:g}")
        if self.bar_width is not None and not 0.0 < self.bar_width <= 500.0:
            raise InputError(f"render: bar_width = {self.bar_width:g} must be positive, and 500 pixels at most")
        if not math.isfinite(self.orbit):
            raise InputError(f"render: orbit = {self.orbit:g} is not a number of degrees")
        if isinstance(self.frames, Iterable):
            object.__setattr__(self, "frames", list(self.frames))

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of films to make."""
        return VIDEOS[self.video or ("webm" if self.transparent else "mp4")]


@dataclass(frozen=True)
class PlotOptions:
    """Options of :func:`~pfem_petsc.post.plot.plot`.

    Raises
    ------
    InputError
        For an unknown format or window, and options that exclude each other.
    """

    curves: Iterable[str] | None = _option(
        None,
        "columns of the history to plot in one picture (info lists them), components, or expressions of them: "
        "probe/tip/velocity.x, momentum.norm, '-wall/plate/force.z/1.2e-3[m2]'; default: the usual pictures",
        metavar="NAME",
        nargs="+",
        action="extend",
    )
    against: str | None = _option(
        None, "column, component or expression over which the curves are drawn; default: time", metavar="NAME"
    )
    spectrum: Iterable[str] | None = _option(
        None, "columns or expressions whose amplitude spectra are drawn", metavar="NAME", nargs="+", action="extend"
    )
    window: str = _option("hann", "window of spectra: hann, flattop, hamming, blackman, rectangular; default: hann")
    highest: float | None = _option(None, "frequency at which the spectra end", metavar="HZ", type=float)
    force_filter: str | None = _option(
        None,
        "filter of forces and of curves: cfc:CLASS (SAE J211), butterworth:HZ[:ORDER], mean:SECONDS, none; default: "
        "forces by the mean of 2 %% of the run",
        flag="--filter",
        metavar="FILTER",
    )
    formats: Iterable[str] | None = _option(
        None,
        "png, svg, pdf; csv writes what the pictures show as tables, with all rows in SI units, and without curves "
        "history.csv; default: png",
        flag="--format",
        metavar="FORMAT",
        nargs="+",
        action="extend",
    )
    labels: Sequence[str] | None = _option(
        None,
        "names of the results in legends, or, with one result, of its curves; default: folders, and what is drawn",
        metavar="TEXT",
        nargs="+",
    )
    closed_forms: bool = _option(True, "do not draw closed forms", flag="--no-closed-form", action="store_false")

    def __post_init__(self) -> None:
        from .chart import check_formats
        from .curves import WINDOWS

        if self.spectrum is not None and (self.curves is not None or self.against is not None):
            raise InputError("plot: spectrum is a picture of its own: give it without curves and against")
        if self.against is not None and self.curves is None:
            raise InputError(f"plot: against = {self.against!r} needs curves, the columns to draw over it")
        if self.window not in WINDOWS:
            raise InputError(f"plot: window = {self.window!r} is not known; it is one of {', '.join(WINDOWS)}")
        object.__setattr__(self, "formats", check_formats("png" if self.formats is None else self.formats))

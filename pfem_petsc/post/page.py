"""The page around drawings: title, colour bar, scale, axes and curves, with the time and a marker that change."""

from __future__ import annotations

import io
import itertools
import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.artist import Artist
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from ..errors import InputError
from ..output.units import prefix_for, unit_of
from .camera import Camera, direction, fit
from .chart import STYLE, boxes_allowed, largest, literal
from .colours import ColourScale, Mark
from .curves import column
from .scene import Scene, Style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ..mesh.whole import WholeMesh

INK, PALE = "#1f242c", "#5b6472"
_GROUPS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#F0E442")
"""Okabe and Ito: apart for all kinds of colour vision."""
_OTHERS = "#7a7a7a"
_LETTERS = 16
_CURVE, _MARKER = "#2563b0", "#d9482b"


def _unit_of(size: tuple[int, int]) -> float:
    """Return how many pixels a page has for each of one of 1280 by 720."""
    return min(size[0] / 1280, size[1] / 720)


def _figure(size: tuple[int, int], opacity: float = 1.0) -> Figure:
    """Return a figure with a canvas of some pixels, whose points are those of a page of 1280 by 720."""
    dpi = 100.0 * _unit_of(size)
    figure = Figure(figsize=((size[0] + 0.1) / dpi, (size[1] + 0.1) / dpi), dpi=dpi)
    figure.patch.set(facecolor="white", alpha=opacity)
    FigureCanvasAgg(figure)
    return figure


class Heading(NamedTuple):
    """The texts of a page: titles of the case and the field, its colours, what is marked, and looks.

    Attributes
    ----------
    title, field : titles
    scale : colours of the field
    marks : what is marked, told below the picture
    transparent : whether the background is
    """

    title: str
    field: str
    scale: ColourScale
    marks: Sequence[Mark] = ()
    transparent: bool = False


class _Inset(NamedTuple):
    """Axes with a curve, and the marker on it: (rows,) times [s], and (rows, 2) where the marker is then."""

    axes: Axes
    marker: Line2D
    times: np.ndarray
    curve: np.ndarray


class Page:
    """Frame of a picture: a figure of matplotlib, of which drawings, texts, axes and markers change.

    Parameters
    ----------
    size : width and height in pixels
    heading : texts and colours
    camera : for the length scale
    drawn_height : vertical extent of the camera's view in pixels
    """

    def __init__(self, size: tuple[int, int], heading: Heading, camera: Camera, drawn_height: int) -> None:
        self._unit = _unit_of(size)
        self.size, self.region, self.strip = size, self.region_of(size), self.strip_of(size)
        self._channels = 4 if heading.transparent else 3
        self._insets, self._changing = list[_Inset](), list[Artist]()
        self._figure = figure = _figure(size, 0.0 if heading.transparent else 1.0)
        self._triad = figure.add_axes(self._part(size[0] - 148 * self._unit, size[1] - 118 * self._unit, 112, 112))
        self._triad.set(xlim=(-1.65, 1.65), ylim=(-1.65, 1.65))
        self._triad.axis("off")
        left, _, width, _ = self.region
        letters = max(4, int((width / self._unit - 230) / 10.5))  # space for the time is left empty
        title = heading.title if len(heading.title) <= letters else heading.title[: letters - 1].rstrip() + "…"
        self._write(left, 38 * self._unit, literal(title), fontsize=16, weight="bold")
        self._colour_bar(heading)
        keys = [
            Line2D([], [], color=np.divide(mark.colour, 255), linewidth=4, label=mark.text) for mark in heading.marks
        ]
        corner = self._share(size[0] - 150 * self._unit, size[1])
        place: dict[str, Any] = {"loc": "lower right", "bbox_to_anchor": corner, "ncols": max(1, len(keys))}
        figure.legend(handles=keys, frameon=False, fontsize=11.5, **place)
        if camera.parallel:
            self._length_scale(2 * camera.half_height / drawn_height)

    @staticmethod
    def region_of(size: tuple[int, int]) -> tuple[int, int, int, int]:
        """Return left, top, width and height of the part of a page with the drawing, in pixels."""
        left, top, right, bottom = (round(pixels * _unit_of(size)) for pixels in (20, 64, 150, 52))
        return left, top, size[0] - left - right, size[1] - top - bottom

    @staticmethod
    def strip_of(size: tuple[int, int]) -> int:
        """Return the height of the strip above a tile, in pixels."""
        return round(34 * _unit_of(size))

    def _share(self, x: float, y: float) -> tuple[float, float]:
        """Return what matplotlib has for a place in pixels, from the upper left corner."""
        return x / self.size[0], 1.0 - y / self.size[1]

    def _part(self, x: float, y: float, width: float, height: float) -> tuple[float, float, float, float]:
        """Return the same of a rectangle with an upper left corner in pixels, and a size in those of 1280 by 720."""
        wide, high = width * self._unit, height * self._unit
        return *self._share(x, y + high), wide / self.size[0], high / self.size[1]

    def compose(
        self,
        drawings: Sequence[np.ndarray],
        camera: Camera,
        time: str,
        captions: Sequence[str] = (),
        columns: int = 1,
        moments: Sequence[float] = (),
    ) -> np.ndarray:
        """Return the page (height, width, 3 or 4) uint8 with drawings (h, w, 3 or 4) on it.

        Parameters
        ----------
        drawings : one of the region's size, or several, row by row, each below a strip with its caption
        camera : for the axes
        time : text of the time
        captions : of several drawings
        columns : of several drawings
        moments : times of the insets [s]
        """
        canvas, (left, top, width, _) = self._figure.canvas, self.region
        strip = self.strip if captions else 0
        for artist in (*self._changing, *self._triad.texts):
            artist.remove()
        self._changing = [self._write(left + width, 41 * self._unit, time, ha="right")]
        for number, drawing in enumerate(drawings):
            high, wide = drawing.shape[:2]
            x, y = left + (number % columns) * wide, top + (number // columns) * (high + strip) + strip
            self._changing.append(self._figure.figimage(drawing, x, self.size[1] - y - high, origin="upper", zorder=-1))
            if captions:
                self._changing.append(self._write(x, y - 0.3 * strip, captions[number]))
        self._turn_axes(camera)
        for inset, moment in zip(self._insets, moments, strict=False):
            places = [np.interp(moment, inset.times, values) for values in inset.curve.T] if len(inset.times) else []
            inset.marker.set_data(*([place] for place in places or ((), ())))
        with boxes_allowed():
            canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., : self._channels].copy()

    def _write(self, x: float, y: float, text: str, **style: Any) -> Artist:
        """Write a text on a baseline at a place in pixels."""
        return self._figure.text(*self._share(x, y), text, **{"color": INK, "fontsize": 14.5, **style})

    def _turn_axes(self, camera: Camera) -> None:
        """Draw the coordinate axes as seen by a camera, the nearest last."""
        for name, way in sorted(zip("xyz", np.eye(3)), key=lambda axis: float(axis[1] @ camera.towards)):
            tip = np.array([way @ camera.right, way @ camera.up])
            length = float(np.linalg.norm(tip))
            if length > 0.05:
                arrow = {"arrowstyle": "-|>", "color": PALE, "shrinkA": 0.0, "shrinkB": 0.0}
                self._triad.annotate("", tip, (0.0, 0.0), arrowprops=arrow)
                label = tip * (1.0 + 0.33 / length)
                self._triad.text(*label, name, color=PALE, fontsize=11, ha="center", va="center")

    def _colour_bar(self, heading: Heading) -> None:
        (left, top, width, height), unit, scale = self.region, self._unit, heading.scale
        axes = self._figure.add_axes(self._part(left + width + 34 * unit, top + 67 * unit, 20, height / unit - 175))
        values = ScalarMappable(Normalize(scale.low * scale.factor, scale.high * scale.factor), scale.cmap)
        bar = self._figure.colorbar(values, cax=axes, ticks=MaxNLocator(nbins=7, steps=[1, 2, 2.5, 5, 10]))
        axes.tick_params(labelsize=12, colors=INK)
        axes.minorticks_off()
        bar.outline.set(linewidth=0.8, edgecolor=PALE)
        label = heading.field.replace(" ", "\n", 1) + (f"\n[{scale.unit}]" if scale.unit else "")
        axes.set_title(label, loc="left", x=-0.5, color=INK, fontsize=13, pad=10)

    def _length_scale(self, metres_a_pixel: float) -> None:
        """Draw a line of 1, 2 or 5 times a power of ten, and its length."""
        wish = 0.16 * self.region[2] * metres_a_pixel
        power = 10.0 ** math.floor(math.log10(wish))
        length = max(step * power for step in (1, 2, 5) if step * power <= wish * (1 + 1e-9))
        x, y, end = self.region[0] + 4 * self._unit, self.size[1] - 22 * self._unit, length / metres_a_pixel
        ends = np.array([self._share(x, y), self._share(x + end, y)])
        self._figure.add_artist(Line2D(*ends.T, color=PALE, linewidth=1.0, marker="|", markersize=8))
        factor, name = prefix_for(length, "m")
        style = {"color": PALE, "va": "center_baseline", "fontsize": 11.5}
        self._write(x + end + 10 * self._unit, y, f"{length * factor:g} {name}", **style)

    def add_inset(self, results: Sequence[Any], shown: int, name: str, corner: tuple[int, int], wide: int) -> None:
        """Add a curve of the history with a marker, which :meth:`compose` moves.

        Parameters
        ----------
        results : open results, whose curves are all in the range of the axes
        shown : number of the one that is shown
        name : of a column, see :func:`history_curve`
        corner : upper left corner on the page in pixels
        wide : width in pixels
        """
        curves = [(np.asarray(r.history["time"], dtype=float), history_curve(r.history, name)) for r in results]
        factor, unit = prefix_for(max(largest(values) for _, values in curves), unit_of(name.partition(".")[0]))
        axis = results[shown].axis
        time_factor, time_unit = axis.scale(max(largest(times) for times, _ in curves))
        kind, *parts, last = name.split("/") if "/" in name else ("", name)
        label = (f"{kind} '{'/'.join(parts)}', {last}" if parts else last).replace("_", " ")
        pixel = wide / self._unit / 290.0  # the margins of the axes in an inset of this width are 34, 30, 10 and 40
        x, y, high = corner[0] + 34 * pixel * self._unit, corner[1] + 26 * pixel * self._unit, 0.62 * 290.0
        with rc_context({**STYLE, "font.size": 8.0 * pixel, "axes.titlesize": 8.5 * pixel}):
            axes = self._figure.add_axes(self._part(x, y, 246 * pixel, (high - 66) * pixel), zorder=1)
            axes.patch.set_alpha(0.88)
            for k, (times, values) in enumerate(curves):
                axes.plot(
                    times * time_factor, values * factor, color=_CURVE, alpha=1.0 if k == shown else 0.0
                )  # others for the range alone
            axes.locator_params(nbins=5)
            axes.set_xlabel(axis.label(time_unit), labelpad=1.0)
            axes.margins(y=0.08)
            axes.set_title(literal(label + (f" [{unit}]" if unit else "")))
            (marker,) = axes.plot([], [], "o", color=_MARKER, markersize=6 * pixel)
        times, values = curves[shown]
        self._insets.append(_Inset(axes, marker, times, np.stack([times * time_factor, values * factor], axis=1)))


def history_curve(history: Any, name: str) -> np.ndarray:
    """Return a column of the history as one number a row: of vectors the length, or ``NAME.x``; of nodes the mean.

    Raises
    ------
    InputError
        If there is no such column.
    """
    found = column(history, name)
    return found[name] if name in found else column(history, f"{name}.norm")[f"{name}.norm"]


def inset_room(drawings: Sequence[np.ndarray], several: bool) -> tuple[int, tuple[int, int]]:
    """Return the width of an inset, whose height is 0.62 of it, and the corner (x, y) where it covers least of what is
    drawn.

    Parameters
    ----------
    drawings : some frames of the film
    several : whether there are several results

    Raises
    ------
    InputError
        If the frames are too narrow.
    """
    least, (height, width) = 220, drawings[0].shape[:2]
    if several and width < least:
        raise InputError(
            f"render: inset needs tiles of {least} pixels or more, and these have {width}: give a larger size, or "
            "fewer results"
        )
    ink = np.mean([(each != each[0, 0]).any(axis=2) for each in drawings], axis=0)
    wide = round(max(0.27 * width, min((0.5 if several else 1.0) * width, least)))
    high = round(0.62 * wide)
    corners = itertools.product((0, width - wide), (0, height - high))
    return wide, min(corners, key=lambda at: float(ink[at[1] : at[1] + high, at[0] : at[0] + wide].sum()))


def grid(count: int, aspect: float, room: tuple[int, int]) -> tuple[int, int]:
    """Return the columns and rows of tiles that make pictures of this aspect (width over height) largest."""

    def drawn_width(columns: int) -> float:
        rows = -(-count // columns)
        return min(room[0] / columns, aspect * room[1] / rows)

    columns = max(range(1, count + 1), key=lambda columns: (round(drawn_width(columns), 3), -columns))
    return columns, -(-count // columns)


def mesh_page(mesh: WholeMesh, size: tuple[int, int] = (1280, 720), view: str = "auto") -> bytes:
    """Return a picture of a mesh as PNG, with a legend of up to seven bar groups and the size of the mesh.

    Parameters
    ----------
    size : in pixels
    view : ``xy``, ``xz``, ``yz``, ``iso`` or ``auto``

    Raises
    ------
    InputError
        For a mesh without bars, and for an unknown view.
    """
    points = mesh.points
    if len(mesh.bars) == 0 or not np.isfinite(points).all():
        raise InputError(f"{mesh.source}: {len(mesh.bars)} bars, or coordinates that are not finite: nothing to draw")
    group = np.full(len(mesh.bars), len(_GROUPS))  # the first one of each bar, the last number for others
    for k, members in reversed(list(enumerate(mesh.bar_groups.values()))[: len(_GROUPS)]):
        group[members] = k
    shown = np.unique(group).tolist() if mesh.bar_groups else []
    unit = _unit_of(size)
    columns = max(1, round(size[0] / unit / 310.0))
    legend = round(33.0 * unit * -(-len(shown) // columns))
    room = size[0], max(round(0.9 * size[1]) - legend, 16)
    bounds = np.array([points.min(axis=0), points.max(axis=0)])
    camera = fit(points, direction(view, bounds, [], (0.0, 0.0, 1.0)), room[0] / room[1])
    motion = SimpleNamespace(start=points, bars=mesh.bars, bounds=bounds)
    palette = np.array([to_rgb(colour) for colour in (*_GROUPS, _OTHERS)])
    scene = Scene(motion, camera, room, Style(tubes=False, shaded=False), unit=unit)
    picture = scene.draw(points, (255.0 * palette[group]).astype(np.uint8), camera)
    scene.close()
    figure = _figure(size)
    figure.figimage(picture, 0, round(0.09 * size[1]), origin="upper")
    span = " x ".join(f"{x:.4g}" for x in bounds[1] - bounds[0])
    figure.text(0.02, 0.03, f"{len(points):,} nodes, {len(mesh.bars):,} bars, {span} m", fontsize=15, color=INK)
    if shown:
        names = [n if len(n) <= _LETTERS else f"{n[: _LETTERS - 1]}…" for n in list(mesh.bar_groups)[: len(_GROUPS)]]
        texts = [names[number] if number < len(names) else "other bars" for number in shown]
        handles = [Line2D([], [], color=palette[number], linewidth=4) for number in shown]
        figure.legend(handles, texts, loc="upper center", ncols=columns, fontsize=15, frameon=False)
    made = io.BytesIO()
    with boxes_allowed():
        figure.savefig(made, format="png")
    return made.getvalue()

"""The page around drawings: title, colour bar, scale, axes and curves, drawn once; the time and the marker change."""

from __future__ import annotations

import io
import itertools
import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..errors import InputError
from ..output.units import prefix_for, unit_of
from .camera import Camera, direction, fit
from .chart import STYLE, boxes_allowed, largest, literal, thinned
from .colours import ColourScale, Mark
from .curves import column
from .scene import Scene, Style

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from PIL import Image

    from ..mesh.whole import WholeMesh

INK, PALE = "#1f242c", "#5b6472"
_GROUPS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#F0E442")
"""Okabe and Ito: apart for all kinds of colour vision."""
_OTHERS = "#7a7a7a"
_COLUMN, _ROW = 3.1, 0.33
"""Width of a column and height of a row of the legend [inch]."""
_LETTERS = 16
_CURVE, _MARKER = "#2563b0", (217, 72, 43)


def over(below: np.ndarray, above: np.ndarray) -> None:
    """Lay a picture (h, w, 4) uint8 over another (h, w, 3 or 4), which is changed.

    All but opaque ones are multiplied by their opacity.
    """
    rest = 255 - above[..., 3:].astype(np.uint16)
    below[:] = above[..., : below.shape[2]] + ((below * rest + 127) // 255).astype(np.uint8)


def unmultiplied(picture: np.ndarray) -> np.ndarray:
    """Return a picture (h, w, 4) that was multiplied by its opacity with plain colours."""
    alpha = picture[..., 3:].astype(np.uint16)
    colours = np.minimum(255 * picture[..., :3].astype(np.uint16) // np.maximum(alpha, 1), 255)
    return np.concatenate([colours, alpha], axis=2).astype(np.uint8)


def _canvas(figure: Figure) -> np.ndarray:
    """Return a figure of matplotlib as a picture (h, w, 4) uint8, multiplied by its opacity."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    picture = np.asarray(canvas.buffer_rgba()).astype(np.uint16)
    picture[..., :3] = (picture[..., :3] * picture[..., 3:] + 127) // 255
    return picture.astype(np.uint8)


def _figure(size: tuple[int, int], opacity: float, **options: Any) -> Figure:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(size[0] / 100, size[1] / 100), dpi=100, **options)
    figure.patch.set(facecolor="white", alpha=opacity)
    return figure


def _font(pixels: float) -> Any:
    from matplotlib import font_manager
    from PIL import ImageFont

    return ImageFont.truetype(font_manager.findfont("DejaVu Sans"), round(pixels))


class Heading(NamedTuple):
    """The texts of a page: titles of the case and the field, its colours, what is marked, and looks.

    Attributes
    ----------
    title, field : titles
    scale : colours of the field
    marks : what is marked, told below the picture
    still : whether the camera does not zoom: only then there is a length scale
    transparent : whether the background is
    """

    title: str
    field: str
    scale: ColourScale
    marks: Sequence[Mark] = ()
    still: bool = True
    transparent: bool = False


class Page:
    """Frame of a picture.

    Parameters
    ----------
    size : width and height in pixels
    heading : texts and colours
    camera : for the length scale and the axes
    drawn_height : vertical extent of the camera's view in pixels
    """

    def __init__(self, size: tuple[int, int], heading: Heading, camera: Camera, drawn_height: int) -> None:
        self.size, self._heading, self._camera = size, heading, camera
        self._unit = min(size[0] / 1280, size[1] / 720)
        self.region, self.strip = self.region_of(size), self.strip_of(size)
        self._font = _font(max(9, 20 * self._unit))
        self._axes = camera, _axes(camera, self._unit)
        with boxes_allowed():
            self._background = np.ascontiguousarray(self._draw(drawn_height)[..., : 4 if heading.transparent else 3])

    @staticmethod
    def region_of(size: tuple[int, int]) -> tuple[int, int, int, int]:
        """Return left, top, width and height of the part of a page with the drawing, in pixels."""
        unit = min(size[0] / 1280, size[1] / 720)
        left, top, right, bottom = (round(pixels * unit) for pixels in (20, 64, 150, 52))
        return left, top, size[0] - left - right, size[1] - top - bottom

    @staticmethod
    def strip_of(size: tuple[int, int]) -> int:
        """Return the height of the strip above a tile, in pixels."""
        return round(34 * min(size[0] / 1280, size[1] / 720))

    def compose(
        self, drawings: Sequence[np.ndarray], camera: Camera, time: str, captions: Sequence[str] = (), columns: int = 1
    ) -> np.ndarray:
        """Return the page (height, width, 3 or 4) uint8 with drawings (h, w, 3 or 4) on it.

        Parameters
        ----------
        drawings : one of the region's size, or several, row by row, each below a strip with its caption
        camera : for the axes
        time : text of the time
        captions : of several drawings
        columns : of several drawings
        """
        from PIL import Image, ImageColor, ImageDraw

        left, top, width, _ = self.region
        page, strip = self._background.copy(), self.strip if captions else 0
        texts = [(left + width, round(22 * self._unit), time, "ra")]
        for number, drawing in enumerate(drawings):
            high, wide = drawing.shape[:2]
            x, y = left + (number % columns) * wide, top + (number // columns) * (high + strip) + strip
            page[y : y + high, x : x + wide] = drawing
            texts += [(x, y - round(0.8 * strip), captions[number], "la")] if captions else []
        # as plain channels, because colours are multiplied by their opacity
        image = Image.fromarray(page, "CMYK" if self._heading.transparent else "RGB")
        pen = ImageDraw.Draw(image)
        ink = (*ImageColor.getrgb(INK), 255)[: page.shape[2]]
        for x, y, text, anchor in texts:
            pen.text((x, y), text, font=self._font, fill=ink, anchor=anchor)
        if camera is not self._axes[0]:
            self._axes = camera, _axes(camera, self._unit)
        axes = self._axes[1]
        grey = np.full((axes.height, axes.width, page.shape[2]), 255, dtype=np.uint8)
        grey[..., :3] = ImageColor.getrgb(PALE)
        corner = [
            round(side - off * self._unit - axes.width / 2) for side, off in zip(self.size, (92, 62), strict=True)
        ]
        image.paste(Image.fromarray(grey, image.mode), tuple(corner), axes.getchannel("A"))
        page = np.asarray(image)
        return unmultiplied(page) if self._heading.transparent else page

    def _draw(self, drawn_height: int) -> np.ndarray:
        (width, height), (left, _, inner_width, _) = self.size, self.region
        figure = _figure(self.size, 0.0 if self._heading.transparent else 1.0)
        title = self._heading.title
        style = {"va": "top", "color": INK, "weight": "bold", "fontsize": self._points(22)}
        text = figure.text(left / width, 1 - 22 * self._unit / height, literal(title), **style)
        # space for the time is left empty
        while len(title) > 4 and text.get_window_extent().width > inner_width - 230 * self._unit:
            title = title[:-2].rstrip(" …") + "…"
            text.set_text(literal(title))
        self._colour_bar(figure)
        if self._camera.parallel and self._heading.still:
            self._length_scale(figure, 2 * self._camera.half_height / drawn_height)
        x, style = left + inner_width, {"va": "center_baseline", "fontsize": self._points(16)}
        for mark in reversed(self._heading.marks):
            x -= (44 + 10 * len(mark.text)) * self._unit
            y, shade = 22 * self._unit / height, tuple(value / 255 for value in mark.colour)
            figure.text(x / width, y, "\u25ac", color=shade, weight="bold", **style)
            figure.text((x + 22 * self._unit) / width, y, mark.text, color=INK, **style)
        return _canvas(figure)

    def _points(self, pixels: float) -> float:
        """Return the font size in points (at 100 dots per inch) for pixels of a page of 1280 by 720."""
        return max(6.0, 0.72 * pixels * self._unit)

    def _colour_bar(self, figure: Figure) -> None:
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import Normalize
        from matplotlib.ticker import MaxNLocator

        (width, height), (left, top, inner_width, inner_height) = self.size, self.region
        unit, scale, right = self._unit, self._heading.scale, left + inner_width
        bottom = height - top - inner_height + 108 * unit
        place = (right + 34 * unit) / width, bottom / height, 20 * unit / width, (inner_height - 175 * unit) / height
        values = ScalarMappable(Normalize(scale.low * scale.factor, scale.high * scale.factor), scale.cmap)
        bar = figure.colorbar(values, cax=figure.add_axes(place), ticks=MaxNLocator(nbins=7, steps=[1, 2, 2.5, 5, 10]))
        ticks = {"labelsize": self._points(17), "colors": INK, "length": 4 * unit, "width": 0.8, "pad": 4 * unit}
        bar.ax.tick_params(**ticks)
        bar.ax.minorticks_off()
        bar.outline.set(linewidth=0.8, edgecolor=PALE)
        label = self._heading.field.replace(" ", "\n", 1) + (f"\n[{scale.unit}]" if scale.unit else "")
        style = {"color": INK, "fontsize": self._points(18), "va": "bottom", "linespacing": 1.25}
        figure.text((right + 24 * unit) / width, 1 - (top + 52 * unit) / height, label, **style)

    def _length_scale(self, figure: Figure, metres_a_pixel: float) -> None:
        from matplotlib.lines import Line2D

        (width, height), unit = self.size, self._unit
        wish = 0.16 * self.region[2] * metres_a_pixel
        power = 10.0 ** math.floor(math.log10(wish))
        length = max(step * power for step in (1, 2, 5) if step * power <= wish * (1 + 1e-9))
        x, y, tick, end = self.region[0] + 4 * unit, 22 * unit, 5 * unit, length / metres_a_pixel
        across = np.array([0.0, 0.0, 0.0, end, end, end]) + x
        along = y + np.array([tick, -tick, 0.0, 0.0, -tick, tick])
        figure.add_artist(Line2D(across / width, along / height, color=PALE, linewidth=1.4 * unit))
        factor, name = prefix_for(length, "m")
        style = {"color": PALE, "va": "center_baseline", "fontsize": self._points(16)}
        figure.text((x + end + 10 * unit) / width, y / height, f"{length * factor:g} {name}", **style)


def _axes(camera: Camera, unit: float) -> Image.Image:
    """Return the coordinate axes as seen by the camera, in a square."""
    from PIL import Image, ImageDraw

    fine = 4  # drawn larger and reduced, for smooth edges
    side, size = round(112 * unit), 34 * unit * fine
    image = Image.new("RGBA", (side * fine, side * fine))
    pen = ImageDraw.Draw(image)
    middle = np.full(2, side * fine / 2)
    for name, way in sorted(zip("xyz", np.eye(3)), key=lambda axis: float(axis[1] @ camera.towards)):
        arrow = np.array([way @ camera.right, -(way @ camera.up)])
        length = float(np.linalg.norm(arrow))
        if length < 0.05:
            continue
        tip, along = middle + size * arrow, arrow / length
        across, head = np.array([-along[1], along[0]]), 8 * unit * fine
        pen.line((*middle, *tip), fill=PALE, width=max(1, round(1.4 * unit * fine)))
        wings = [tip, *(tip - head * along + sign * 0.4 * head * across for sign in (1, -1))]
        pen.polygon([tuple(map(float, corner)) for corner in wings], fill=PALE)
        label = tip + 11 * unit * fine * along
        pen.text(tuple(map(float, label)), name, font=_font(max(9, 15 * unit) * fine), fill=PALE, anchor="mm")
    return image.resize((side, side), Image.Resampling.LANCZOS)


def history_curve(history: Any, name: str) -> np.ndarray:
    """Return a column of the history as one number a row: of vectors the length, or ``NAME.x``; of nodes the mean.

    Raises
    ------
    InputError
        If there is no such column.
    """
    found = column(history, name)
    return found[name] if name in found else column(history, f"{name}.norm")[f"{name}.norm"]


class Inset:
    """A curve of the history in a corner, drawn once; the marker at the time of the frame is drawn in each frame.

    Parameters
    ----------
    results : open results, whose curves are all in the range of the axes
    shown : number of the one that is shown
    name : of a column, see :func:`history_curve`
    size : width and height in pixels
    """

    def __init__(self, results: Sequence[Any], shown: int, name: str, size: tuple[int, int]) -> None:
        from matplotlib import rc_context
        from matplotlib.ticker import MaxNLocator

        curves = [(np.asarray(r.history["time"], dtype=float), history_curve(r.history, name)) for r in results]
        factor, unit = prefix_for(max(largest(values) for _, values in curves), unit_of(name.partition(".")[0]))
        axis = results[shown].axis
        time_factor, time_unit = axis.scale(max(largest(times) for times, _ in curves))
        scale = size[1] / 180.0
        with rc_context({**STYLE, "font.size": 9.0 * scale, "lines.linewidth": 1.3 * scale}), boxes_allowed():
            figure = _figure(size, 0.88, layout="constrained")
            axes = figure.add_subplot(facecolor="none")
            for k, (times, values) in enumerate(curves):
                line = thinned(times * time_factor, values * factor, 600)
                axes.plot(*line, color=_CURVE, alpha=1.0 if k == shown else 0.0)  # others for the range alone
            axes.xaxis.set_major_locator(MaxNLocator(nbins=5))
            axes.yaxis.set_major_locator(MaxNLocator(nbins=4))
            axes.set_xlabel(axis.label(time_unit), labelpad=1.0)
            axes.margins(y=0.08)
            kind, *parts, last = name.split("/") if "/" in name else ("", name)
            label = f"{kind} '{'/'.join(parts)}', {last}" if parts else last
            label = label.replace("_", " ") + (f" [{unit}]" if unit else "")
            axes.set_title(literal(label), fontsize=9.5 * scale)
            self._picture = _canvas(figure)
            self._times, values = curves[shown]
            self._corner = axes.transData.transform(np.stack([self._times * time_factor, values * factor], axis=1))
        self._radius = 3.6 * scale

    def at(self, time: float) -> np.ndarray:
        """Return the picture (height, width, 4) uint8 with the marker at a time [s]."""
        from PIL import Image, ImageDraw

        image = Image.fromarray(self._picture)
        if len(self._times):
            x, y = (float(np.interp(time, self._times, self._corner[:, k])) for k in (0, 1))
            y, r = self._picture.shape[0] - y, self._radius
            if np.isfinite([x, y]).all():
                ImageDraw.Draw(image).ellipse((x - r, y - r, x + r, y + r), fill=(*_MARKER, 255))
        return np.asarray(image)


def inset_room(drawings: Sequence[np.ndarray], several: bool) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the size of an inset, and the corner (x, y) where it covers least of what is drawn.

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
    found = []
    for share in (0.28, 0.25):
        wide = max(share * width, min((0.5 if several else 1.0) * width, least))
        room = round(wide), round(0.62 * wide)
        for x, y in itertools.product((0, width - room[0]), (0, height - room[1])):
            found.append((float(ink[y : y + room[1], x : x + room[0]].sum()), room, (x, y)))
    _, room, corner = min(found, key=lambda each: each[0])
    return room, corner


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
    from matplotlib.colors import to_rgb
    from matplotlib.figure import Figure

    points = mesh.points
    if len(mesh.bars) == 0 or not np.isfinite(points).all():
        raise InputError(f"{mesh.source}: {len(mesh.bars)} bars, or coordinates that are not finite: nothing to draw")
    group = np.full(len(mesh.bars), len(_GROUPS))  # the first one of each bar, the last number for others
    for k, members in reversed(list(enumerate(mesh.bar_groups.values()))[: len(_GROUPS)]):
        group[members] = k
    shown = np.unique(group).tolist() if mesh.bar_groups else []
    dpi = 100.0 * min(size) / 720.0
    columns = max(1, round(size[0] / dpi / _COLUMN))
    legend = round(_ROW * -(-len(shown) // columns) * dpi)
    room = size[0], max(round(0.9 * size[1]) - legend, 16)
    bounds = np.array([points.min(axis=0), points.max(axis=0)])
    camera = fit(points, direction(view, bounds, [], (0.0, 0.0, 1.0)), room[0] / room[1])
    motion = SimpleNamespace(start=points, bars=mesh.bars, bounds=bounds)
    palette = np.array([to_rgb(colour) for colour in (*_GROUPS, _OTHERS)])
    scene = Scene(motion, camera, room, Style(tubes=False, shaded=False), unit=dpi / 100.0)
    picture = scene.draw(points, (255.0 * palette[group]).astype(np.uint8), camera)
    scene.close()
    figure = Figure(figsize=(size[0] / dpi, size[1] / dpi), dpi=dpi, facecolor="white")
    figure.figimage(picture, 0, round(0.09 * size[1]), origin="upper")
    span = " x ".join(f"{x:.4g}" for x in bounds[1] - bounds[0])
    figure.text(0.02, 0.03, f"{len(points):,} nodes, {len(mesh.bars):,} bars, {span} m", fontsize=15, color="#222222")
    if shown:
        from matplotlib.lines import Line2D

        names = [n if len(n) <= _LETTERS else f"{n[: _LETTERS - 1]}…" for n in list(mesh.bar_groups)[: len(_GROUPS)]]
        texts = [names[number] if number < len(names) else "other bars" for number in shown]
        handles = [Line2D([], [], color=palette[number], linewidth=4) for number in shown]
        figure.legend(handles, texts, loc="upper center", ncols=columns, fontsize=15, frameon=False)
    made = io.BytesIO()
    with boxes_allowed():
        figure.savefig(made, format="png", dpi=dpi)
    return made.getvalue()

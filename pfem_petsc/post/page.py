"""The page around a drawing: title, time, colour bar, scale and axes. It is drawn once, and only the time changes."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from .camera import Camera
from .chart import boxes_allowed, literal
from .fields import ColourScale

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.patches import FancyArrowPatch

__all__ = ["Page"]

INK = "#1f242c"
PALE = "#5b6472"


class Page:
    """Frame of a picture.

    Parameters
    ----------
    size : width and height in pixels
    title : of the case
    field : title of the field
    scale : its colours
    camera : for the length scale and the axes
    drawn_height : vertical extent of the camera's view in pixels; None: the region's height
    """

    def __init__(
        self,
        size: tuple[int, int],
        title: str,
        field: str,
        scale: ColourScale,
        camera: Camera,
        drawn_height: int | None = None,
    ) -> None:
        from matplotlib import font_manager
        from PIL import ImageFont

        self.size = size
        self._unit = min(size[0] / 1280, size[1] / 720)
        self.region = self.region_of(size)
        self.strip = self.strip_of(size)
        path = font_manager.findfont("DejaVu Sans")
        self._font = ImageFont.truetype(path, max(9, round(20 * self._unit)))
        self._drawn_height = drawn_height or self.region[3]
        with boxes_allowed():
            self._background = self._draw(title, field, scale, camera)

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

    def compose(self, drawing: np.ndarray, time: str) -> np.ndarray:
        """Return the page (height, width, 3) uint8 with a drawing of the region's size, and a text for the time."""
        left, top, width, height = self.region
        page = self._background.copy()
        page[top : top + height, left : left + width] = drawing
        return self._written(page, [(left + width, round(22 * self._unit), time)], "ra")

    def compose_tiles(self, drawings: list[np.ndarray], times: list[str], columns: int) -> np.ndarray:
        """Return the page with several drawings of one size, row by row, each below a strip with its time."""
        left, top, _, _ = self.region
        page = self._background.copy()
        texts = []
        for number, (drawing, time) in enumerate(zip(drawings, times, strict=True)):
            height, width = drawing.shape[:2]
            x, y = left + (number % columns) * width, top + (number // columns) * (height + self.strip) + self.strip
            page[y : y + height, x : x + width] = drawing
            texts.append((x, y - round(0.8 * self.strip), time))
        return self._written(page, texts, "la")

    def _written(self, page: np.ndarray, texts: list[tuple[int, int, str]], anchor: str) -> np.ndarray:
        from PIL import Image, ImageDraw

        image = Image.fromarray(page)
        pen = ImageDraw.Draw(image)
        for x, y, text in texts:
            pen.text((x, y), text, font=self._font, fill=INK, anchor=anchor)
        return np.asarray(image)

    def _draw(self, title: str, field: str, scale: ColourScale, camera: Camera) -> np.ndarray:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        width, height = self.size
        figure = Figure(figsize=(width / 100, height / 100), dpi=100, facecolor="white")
        canvas = FigureCanvasAgg(figure)
        left, top, inner_width, inner_height = self.region
        # space for the time is left empty
        room = inner_width - 230 * self._unit
        text = figure.text(
            left / width, 1 - 22 * self._unit / height, literal(title), va="top", color=INK, weight="bold"
        )
        text.set_fontsize(self._points(22))
        while len(title) > 4 and text.get_window_extent(canvas.get_renderer()).width > room:
            title = title[:-2].rstrip(" …") + "…"
            text.set_text(literal(title))
        self._colour_bar(figure, field, scale)
        if camera.parallel:
            self._length_scale(figure, 2 * camera.half_height / self._drawn_height, left)
        self._axes(figure, camera)
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()

    def _points(self, pixels: float) -> float:
        """Return the font size in points (at 100 dots per inch) for pixels of a page of 1280 by 720."""
        return max(6.0, 0.72 * pixels * self._unit)

    def _colour_bar(self, figure: Figure, field: str, scale: ColourScale) -> None:
        from matplotlib.ticker import MaxNLocator

        width, height = self.size
        left, top, inner_width, inner_height = self.region
        bottom = self.size[1] - top - inner_height
        axes = figure.add_axes(
            (
                (left + inner_width + 34 * self._unit) / width,
                (bottom + 108 * self._unit) / height,
                20 * self._unit / width,
                (inner_height - 175 * self._unit) / height,
            )
        )
        table = scale.cmap(np.linspace(0, 1, 256))[:, None, :]
        low, high = scale.low * scale.factor, scale.high * scale.factor
        axes.imshow(table, origin="lower", aspect="auto", extent=(0, 1, low, high))
        axes.set_xticks([])
        axes.yaxis.tick_right()
        axes.yaxis.set_major_locator(MaxNLocator(nbins=7, steps=[1, 2, 2.5, 5, 10]))
        axes.tick_params(labelsize=self._points(17), colors=INK, length=4 * self._unit, width=0.8, pad=4 * self._unit)
        for spine in axes.spines.values():
            spine.set_linewidth(0.8)
            spine.set_color(PALE)
        label = field.replace(" ", "\n", 1) + (f"\n[{scale.unit}]" if scale.unit else "")
        figure.text(
            (left + inner_width + 24 * self._unit) / width,
            1 - (top + 52 * self._unit) / height,
            label,
            color=INK,
            fontsize=self._points(18),
            va="bottom",
            linespacing=1.25,
        )

    def _length_scale(self, figure: Figure, metres_a_pixel: float, left: int) -> None:
        from matplotlib.lines import Line2D

        from ..output.units import prefix_for

        width, height = self.size
        wish = 0.16 * self.region[2] * metres_a_pixel
        power = 10.0 ** math.floor(math.log10(wish))
        length = max(step * power for step in (1, 2, 5) if step * power <= wish * (1 + 1e-9))
        pixels = length / metres_a_pixel
        x, y, tick = left + 4 * self._unit, 22 * self._unit, 5 * self._unit
        for (x0, y0), (x1, y1) in (
            ((x, y), (x + pixels, y)),
            ((x, y - tick), (x, y + tick)),
            ((x + pixels, y - tick), (x + pixels, y + tick)),
        ):
            line = Line2D([x0 / width, x1 / width], [y0 / height, y1 / height], color=PALE, linewidth=1.4 * self._unit)
            figure.add_artist(line)
        factor, unit = prefix_for(length, "m")
        figure.text(
            (x + pixels + 10 * self._unit) / width,
            y / height,
            f"{length * factor:g} {unit}",
            color=PALE,
            va="center_baseline",
            fontsize=self._points(16),
        )

    def _axes(self, figure: Figure, camera: Camera) -> None:
        """Draw the coordinate axes as seen by the camera, below the colour bar."""
        width, height = self.size
        size = 34 * self._unit
        centre = np.array([width - 92 * self._unit, 62 * self._unit])
        for name, direction in zip("xyz", np.eye(3), strict=True):
            arrow = np.array([direction @ camera.right, direction @ camera.up])
            if np.linalg.norm(arrow) < 0.05:
                continue
            tip, label = centre + size * arrow, centre + (size * 1.0 + 11 * self._unit / np.linalg.norm(arrow)) * arrow
            figure.add_artist(
                _arrow(figure, centre / (width, height), tip / (width, height), 9 * self._unit, 1.3 * self._unit)
            )
            figure.text(
                label[0] / width,
                label[1] / height,
                name,
                color=PALE,
                ha="center",
                va="center",
                fontsize=self._points(15),
            )


def _arrow(figure: Figure, start: np.ndarray, end: np.ndarray, head: float, line: float) -> FancyArrowPatch:
    from matplotlib.patches import FancyArrowPatch

    return FancyArrowPatch(
        tuple(start),
        tuple(end),
        transform=figure.transFigure,
        arrowstyle="-|>",
        mutation_scale=head,
        linewidth=line,
        color=PALE,
        shrinkA=0,
        shrinkB=0,
    )

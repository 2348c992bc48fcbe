"""The page around a drawing: title, time, colour bar, scale and axes. It is drawn once, and only the time changes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from .camera import Camera
from .chart import boxes_allowed, literal
from .fields import ColourScale

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from PIL import Image

__all__ = ["Page", "lay_over"]

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
    still : whether the camera does not zoom: only then there is a length scale
    transparent : whether the background is
    legend : texts and colours of what is marked, below the picture
    """

    def __init__(
        self,
        size: tuple[int, int],
        title: str,
        field: str,
        scale: ColourScale,
        camera: Camera,
        drawn_height: int | None = None,
        *,
        still: bool = True,
        transparent: bool = False,
        legend: Sequence[tuple[str, tuple[int, int, int]]] = (),
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
        self._still, self._transparent, self._legend, self._camera = still, transparent, legend, camera
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

    def compose(self, drawing: np.ndarray, time: str, camera: Camera | None = None) -> np.ndarray:
        """Return the page (height, width, 3 or 4) uint8 with a drawing of the region's size, and a text for the time.

        Parameters
        ----------
        camera : for the axes; None: the page's
        """
        left, top, width, height = self.region
        page = self._background.copy()
        page[top : top + height, left : left + width] = drawing
        return self._written(page, [(left + width, round(22 * self._unit), time)], "ra", camera)

    def compose_tiles(
        self, drawings: list[np.ndarray], times: list[str], columns: int, camera: Camera | None = None, time: str = ""
    ) -> np.ndarray:
        """Return the page with several drawings of one size, row by row, each below a strip with its text."""
        left, top, _, _ = self.region
        page = self._background.copy()
        texts = []
        for number, (drawing, text) in enumerate(zip(drawings, times, strict=True)):
            height, width = drawing.shape[:2]
            x, y = left + (number % columns) * width, top + (number // columns) * (height + self.strip) + self.strip
            page[y : y + height, x : x + width] = drawing
            texts.append((x, y - round(0.8 * self.strip), text))
        page = self._written(page, texts, "la", camera)
        return self._written(page, [(left + self.region[2], round(22 * self._unit), time)], "ra") if time else page

    def _written(
        self, page: np.ndarray, texts: list[tuple[int, int, str]], anchor: str, camera: Camera | None = None
    ) -> np.ndarray:
        from PIL import Image, ImageDraw

        image = Image.fromarray(page)
        pen = ImageDraw.Draw(image)
        for x, y, text in texts:
            pen.text((x, y), text, font=self._font, fill=INK, anchor=anchor)
        axes = _axes(camera or self._camera, self._unit)
        place = (
            round(self.size[0] - 92 * self._unit - axes.width / 2),
            round(self.size[1] - 62 * self._unit - axes.height / 2),
        )
        image.paste(axes.convert(image.mode), place, axes.getchannel("A"))
        return np.asarray(image)

    def _draw(self, title: str, field: str, scale: ColourScale, camera: Camera) -> np.ndarray:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        width, height = self.size
        figure = Figure(figsize=(width / 100, height / 100), dpi=100)
        figure.patch.set(facecolor="white", alpha=0.0 if self._transparent else 1.0)
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
        if camera.parallel and self._still:
            self._length_scale(figure, 2 * camera.half_height / self._drawn_height, left)
        self._marks(figure)
        canvas.draw()
        page = np.asarray(canvas.buffer_rgba())
        return page.copy() if self._transparent else page[..., :3].copy()

    def _marks(self, figure: Figure) -> None:
        width, height = self.size
        x = self.region[0] + self.region[2]
        for text, colour in reversed(self._legend):
            x -= (44 + 10 * len(text)) * self._unit
            style = {"va": "center_baseline", "fontsize": self._points(16)}
            y, shade = 22 * self._unit / height, tuple(value / 255 for value in colour)
            figure.text(x / width, y, "\u25ac", color=shade, weight="bold", **style)
            figure.text((x + 22 * self._unit) / width, y, text, color=INK, **style)

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


def lay_over(page: np.ndarray, picture: np.ndarray) -> None:
    """Lay a picture (h, w, 4) over a part of a page (h, w, 3 or 4), which is changed."""
    opacity = picture[..., 3:].astype(np.float32) / 255.0
    if page.shape[2] == 3:
        page[:] = (picture[..., :3] * opacity + page * (1.0 - opacity) + 0.5).astype(np.uint8)
        return
    below = page[..., 3:].astype(np.float32) / 255.0 * (1.0 - opacity)
    whole = opacity + below
    mixed = (picture[..., :3] * opacity + page[..., :3] * below) / np.where(whole > 0.0, whole, 1.0)
    page[:] = np.concatenate([mixed + 0.5, 255.0 * whole + 0.5], axis=2).clip(0, 255).astype(np.uint8)


def _axes(camera: Camera, unit: float) -> Image.Image:
    """Return the coordinate axes as seen by the camera, in a square."""
    from matplotlib import font_manager
    from PIL import Image, ImageDraw, ImageFont

    fine = 4  # drawn larger and reduced, for smooth edges
    side, size = round(112 * unit), 34 * unit * fine
    image = Image.new("RGBA", (side * fine, side * fine), (255, 255, 255, 0))
    pen = ImageDraw.Draw(image)
    font = ImageFont.truetype(font_manager.findfont("DejaVu Sans"), max(9, round(15 * unit)) * fine)
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
        pen.text((float(label[0]), float(label[1])), name, font=font, fill=PALE, anchor="mm")
    return image.resize((side, side), Image.Resampling.LANCZOS)

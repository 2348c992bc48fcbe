"""A curve of the history in the corner of a film, with a marker at the time of the frame."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..errors import InputError
from ..output.units import prefix_for, unit_of
from ..registry import nearest
from .chart import STYLE, boxes_allowed, largest, literal, thinned

__all__ = ["Inset", "history_curve", "insets_of"]

CURVE, MARKER = "#2563b0", (217, 72, 43)


def history_curve(result: Any, name: str) -> np.ndarray:
    """Return a column of the history as one number a row: of vectors the length, or ``NAME.x``; of nodes the mean.

    Raises
    ------
    InputError
        If there is no such column.
    """
    column, dot, axis = name.rpartition(".")
    component = "xyz".find(axis) if dot and len(axis) == 1 else -1
    column = column if component >= 0 else name
    names = [key for key in result.history if not key.startswith("event/")]
    if column not in names:
        raise InputError(f"render: the history has no column '{column}'{nearest(column, names)}")
    values = np.asarray(result.history[column], dtype=float)
    if values.ndim == 3:
        values = values.mean(axis=1)
    if values.ndim == 1:
        if component >= 0:
            raise InputError(f"render: inset = {name!r}: column '{column}' has one value only, no component")
        return values
    return values[:, component] if component >= 0 else np.linalg.norm(values, axis=1)


class Inset:
    """The curve, drawn once; the marker is drawn in each frame.

    Parameters
    ----------
    result : an open result
    name : of a column, see :func:`history_curve`
    size : width and height in pixels
    others : other results, whose curves are in the range of the axes as well
    """

    def __init__(self, result: Any, name: str, size: tuple[int, int], others: Sequence[Any] = ()) -> None:
        from matplotlib import rc_context
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
        from matplotlib.ticker import MaxNLocator

        self.values = history_curve(result, name)
        self.times = np.asarray(result.history["time"], dtype=float)
        unit = unit_of(name.partition(".")[0])
        curves = [(self.times, self.values)]
        curves += [(np.asarray(each.history["time"], dtype=float), history_curve(each, name)) for each in others]
        factor, shown = prefix_for(max(largest(values) for _, values in curves), unit)
        time_factor, time_unit = prefix_for(max(largest(times) for times, _ in curves), result.axis.unit)
        scale = size[1] / 180.0
        with rc_context({**STYLE, "font.size": 9.0 * scale, "lines.linewidth": 1.3 * scale}), boxes_allowed():
            figure = Figure(figsize=(size[0] / 100, size[1] / 100), dpi=100, layout="constrained")
            canvas = FigureCanvasAgg(figure)
            figure.patch.set_alpha(0.88)
            axes = figure.add_subplot()
            axes.patch.set_alpha(0.0)
            for times, values in curves[1:]:  # for the range of the axes alone
                axes.plot(*thinned(times * time_factor, values * factor, 600), alpha=0.0)
            axes.plot(*thinned(self.times * time_factor, self.values * factor, 600), color=CURVE)
            axes.xaxis.set_major_locator(MaxNLocator(nbins=5))
            axes.yaxis.set_major_locator(MaxNLocator(nbins=4))
            axes.set_xlabel(result.axis.label(time_unit), labelpad=1.0)
            axes.margins(y=0.08)
            kind, *parts, column = name.split("/") if "/" in name else ("", name)
            label = f"{kind} '{'/'.join(parts)}', {column}" if parts else column
            label = label.replace("_", " ")
            axes.set_title(literal(f"{label} [{shown}]" if shown else label), fontsize=9.5 * scale)
            canvas.draw()
            self._picture = np.asarray(canvas.buffer_rgba()).copy()
            self._corner = axes.transData.transform(np.stack([self.times * time_factor, self.values * factor], axis=1))
        self._radius = 3.6 * scale

    def at(self, time: float) -> np.ndarray:
        """Return the picture (height, width, 4) uint8 with the marker at a time [s]."""
        from PIL import Image, ImageDraw

        image = Image.fromarray(self._picture.copy())
        if len(self.times):
            x, y = (float(np.interp(time, self.times, self._corner[:, k])) for k in (0, 1))
            y, r = self._picture.shape[0] - y, self._radius
            if np.isfinite([x, y]).all():
                ImageDraw.Draw(image).ellipse((x - r, y - r, x + r, y + r), fill=(*MARKER, 255))
        return np.asarray(image)


def insets_of(results: Sequence[Any], name: str, size: tuple[int, int]) -> list[Inset]:
    """Return the curve of each result, all with the same axes."""
    return [Inset(result, name, size, [*results[:k], *results[k + 1 :]]) for k, result in enumerate(results)]

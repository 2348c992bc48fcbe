"""A picture of a mesh: bars coloured by their groups."""

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from .camera import direction, fit
from .chart import png
from .scene import Scene, Style

if TYPE_CHECKING:
    from ..mesh.whole import WholeMesh

_COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#F0E442")
"""Okabe and Ito: apart for all kinds of colour vision."""
_OTHERS = "#7a7a7a"
_COLUMN, _ROW = 3.1, 0.33
"""Width of a column and height of a row of the legend [inch]."""
_LETTERS = 16


def draw(mesh: WholeMesh, size: tuple[int, int] = (1280, 720), view: str = "auto") -> bytes:
    """Return a picture as PNG, with a legend of up to seven bar groups and the size of the mesh.

    Parameters
    ----------
    size : in pixels
    view : ``xy``, ``xz``, ``yz``, ``iso`` or ``auto``

    Raises
    ------
    InputError
        For a mesh without bars, and for an unknown view.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import to_rgb
    from matplotlib.figure import Figure

    points = mesh.points
    if len(mesh.bars) == 0 or not np.isfinite(points).all():
        raise InputError(f"{mesh.source}: {len(mesh.bars)} bars, or coordinates that are not finite: nothing to draw")
    group = np.full(len(mesh.bars), len(_COLOURS))  # the first one of each bar, the last number for others
    for k, members in reversed(list(enumerate(mesh.bar_groups.values()))[: len(_COLOURS)]):
        group[members] = k
    shown = np.unique(group).tolist() if mesh.bar_groups else []
    dpi = 100.0 * min(size) / 720.0
    columns = max(1, round(size[0] / dpi / _COLUMN))
    legend = round(_ROW * -(-len(shown) // columns) * dpi)
    room = size[0], max(round(0.9 * size[1]) - legend, 16)
    bounds = np.array([points.min(axis=0), points.max(axis=0)])
    camera = fit(points, direction(view, bounds, [], (0.0, 0.0, 1.0)), room[0] / room[1])
    motion = SimpleNamespace(start=points, bars=mesh.bars, bounds=bounds)
    palette = np.array([to_rgb(colour) for colour in (*_COLOURS, _OTHERS)])
    scene = Scene(motion, camera, room, Style(tubes=False, shaded=False), unit=dpi / 100.0)
    picture = scene.draw(points, (255.0 * palette[group]).astype(np.uint8), camera)
    scene.close()
    figure = Figure(figsize=(size[0] / dpi, size[1] / dpi), dpi=dpi, facecolor="white")
    FigureCanvasAgg(figure)
    figure.figimage(picture, 0, round(0.09 * size[1]), origin="upper")
    span = " x ".join(f"{x:.4g}" for x in bounds[1] - bounds[0])
    figure.text(0.02, 0.03, f"{len(points):,} nodes, {len(mesh.bars):,} bars, {span} m", fontsize=15, color="#222222")
    if shown:
        from matplotlib.lines import Line2D

        names = [n if len(n) <= _LETTERS else f"{n[: _LETTERS - 1]}…" for n in list(mesh.bar_groups)[: len(_COLOURS)]]
        texts = [names[number] if number < len(names) else "other bars" for number in shown]
        handles = [Line2D([], [], color=palette[number], linewidth=4) for number in shown]
        figure.legend(handles, texts, loc="upper center", ncols=columns, fontsize=15, frameon=False)
    return png(figure, dpi)

"""A picture of a mesh, drawn by matplotlib only: bars coloured by their groups."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from .camera import aim
from .inline import png

if TYPE_CHECKING:
    from ..mesh.whole import WholeMesh

__all__ = ["draw"]

_COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#F0E442")
"""Okabe and Ito: apart for all kinds of colour vision."""
_OTHERS = "#7a7a7a"
_PALE = 0.65
"""Share of white in the colour of the bar that is farthest away."""
_COLUMN, _ROW = 3.1, 0.33
"""Width of a column and height of a row of the legend [inch]."""
_LETTERS = 16
_BALLS = 400
"""Number of nodes up to which they are drawn."""


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
    from matplotlib.collections import LineCollection
    from matplotlib.colors import to_rgb
    from matplotlib.figure import Figure

    points = mesh.points
    if len(mesh.bars) == 0 or not np.isfinite(points).all():
        raise InputError(f"{mesh.source}: {len(mesh.bars)} bars, or coordinates that are not finite: nothing to draw")
    bounds = np.array([points.min(axis=0), points.max(axis=0)])
    camera = aim(points, bounds, [], view, size[0] / size[1])
    flat = np.stack([(points - camera.centre) @ camera.right, (points - camera.centre) @ camera.up], axis=1)
    depth = (points - camera.centre) @ camera.towards
    if not camera.parallel:
        flat *= (camera.distance / (camera.distance - depth))[:, None]
    dpi = 100.0 * min(size) / 720.0
    figure = Figure(figsize=(size[0] / dpi, size[1] / dpi), dpi=dpi, facecolor="white")
    FigureCanvasAgg(figure)
    group = _groups(mesh)
    shown = np.unique(group).tolist() if mesh.bar_groups else []
    columns = max(1, round(size[0] / dpi / _COLUMN))
    rows = -(-len(shown) // columns)
    axes = figure.add_axes((0.02, 0.08, 0.96, 0.91 - _ROW * rows * dpi / size[1]))
    palette = np.array([to_rgb(colour) for colour in (*_COLOURS, _OTHERS)])
    # bars that are farther away are paler
    middle = depth[mesh.bars].mean(axis=1)
    near = (middle - middle.min()) / max(float(np.ptp(middle)), 1e-300) if not camera.parallel else np.ones(len(middle))
    paleness = (_PALE * (1.0 - near))[:, None]
    colours = palette[group] * (1.0 - paleness) + paleness
    order = np.argsort(middle, kind="stable")  # those in front last
    width = float(np.clip(70.0 / np.sqrt(len(mesh.bars)), 0.35, 2.2))
    axes.add_collection(LineCollection(flat[mesh.bars[order]], colors=colours[order], linewidths=width))
    if len(points) <= _BALLS:
        axes.plot(*flat.T, ".", color="#222222", markersize=float(np.clip(60.0 / np.sqrt(len(points)), 2.0, 7.0)))
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.set_axis_off()
    span = " x ".join(f"{x:.4g}" for x in bounds[1] - bounds[0])
    figure.text(0.02, 0.03, f"{len(points):,} nodes, {len(mesh.bars):,} bars, {span} m", fontsize=15, color="#222222")
    if shown:
        names = [_short(name) for name in list(mesh.bar_groups)[: len(_COLOURS)]]
        texts = [names[number] if number < len(names) else "other bars" for number in shown]
        handles = [axes.plot([], [], color=palette[number], linewidth=4)[0] for number in shown]
        figure.legend(handles, texts, loc="upper center", ncols=columns, fontsize=15, frameon=False)
    return png(figure, dpi)


def _short(name: str) -> str:
    return name if len(name) <= _LETTERS else f"{name[: _LETTERS - 1]}…"


def _groups(mesh: WholeMesh) -> np.ndarray:
    """Return the number (bars,) of the first group of each bar, and one more than the colours for the others."""
    number = np.full(len(mesh.bars), len(_COLOURS))
    for k, members in reversed(list(enumerate(mesh.bar_groups.values()))[: len(_COLOURS)]):
        number[members] = k
    return number

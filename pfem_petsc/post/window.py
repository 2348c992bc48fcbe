"""An interactive window of a result, with a slider over its snapshots."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from .frames import chosen_frames
from .headless import VARIABLE, require_rendering
from .motion import Motion
from .options import opened
from .scene import WALL_COLOUR
from .shots import Moves, shots
from .web_page import state

__all__ = ["plotter_of", "show"]

_SIDES = 8  # of tubes
_LEAST = 2.5  # pixels: width of the thinnest tubes


def show(
    result_path: Path | str | Any, *, frame: int = -1, note: Callable[[str], None] = print, **options: Any
) -> None:
    """Show a window until it is closed.

    Parameters
    ----------
    result_path : result file or its folder, or an open result
    frame : number of the first snapshot that is shown; -1: the last
    note : receives messages
    options : as for :func:`~pfem_petsc.post.web_page.render_html`

    Raises
    ------
    InputError
        For options that do not fit the result, and without a display.
    """
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise InputError(
            "render: --window: there is no display (DISPLAY is not set); use --html, which writes a page for a browser"
        )
    # a window that is shown is not one of those that draw without a display
    os.environ.pop(VARIABLE, None)
    with opened(result_path) as result:
        plotter_of(result, frame, note, **options)[0].show()


def plotter_of(
    result: Any, frame: int, note: Callable[[str], None], off_screen: bool = False, **options: Any
) -> tuple[Any, Callable[[float], None]]:
    """Return a window (a pyvista plotter) with a slider, and the function of a snapshot that the slider calls."""
    if off_screen:
        require_rendering()
    import pyvista

    (first,) = chosen_frames([frame], np.asarray(result.times), note)
    last = len(result.times) - 1
    shown = state(result, range(last + 1), note, **options)
    motion, colour, scale = shown["motion"], shown["colour"], shown["scale"]
    camera = shots(motion, Moves(shown["view"]), 4 / 3)[0]
    plotter = pyvista.Plotter(off_screen=off_screen, title=shown["title"])
    plotter.background_color = "white"
    plotter.enable_anti_aliasing("msaa")
    radius = None
    if shown["tubes"]:
        # as large in space as the least width in the window
        least = 0.5 * _LEAST * 2.0 * camera.half_height / plotter.window_size[1]
        radius = np.maximum(least, np.zeros(motion.n_bars) if shown["radius"] is None else shown["radius"])
    bars, walls = pyvista.PolyData(), pyvista.PolyData()
    title = plotter.add_text(motion.time(first), font_size=10, color="black")

    def go_to(value: float) -> None:
        k = round(value)
        bars.shallow_copy(_bars(motion, k, scale.factor * colour.values(k), colour.on_nodes, radius))
        walls.shallow_copy(_walls(motion, k))
        title.SetText(2, motion.time(k))

    go_to(first)
    plotter.add_mesh(
        bars,
        scalars="value",
        preference="point",
        cmap=scale.cmap,
        clim=(scale.factor * scale.low, scale.factor * scale.high),
        line_width=1.5,
        nan_opacity=0.0,
        lighting=radius is not None,
        smooth_shading=radius is not None,
        scalar_bar_args={
            "title": colour.title + (f" [{scale.unit}]" if scale.unit else "") + "\n",
            "color": "black",
            "fmt": "%.4g",
            "vertical": True,
            "position_x": 0.86,
            "position_y": 0.2,
            "width": 0.07,
            "height": 0.6,
            "title_font_size": 18,
            "label_font_size": 16,
        },
    )
    if any(motion.surfaces.values()):
        plotter.add_mesh(walls, scalars="shade", rgba=True, lighting=False)
    plotter.camera.position = camera.centre + camera.distance * camera.towards
    plotter.camera.focal_point, plotter.camera.up = camera.centre, camera.up
    plotter.reset_camera()
    if camera.parallel:
        plotter.enable_parallel_projection()
    plotter.camera.zoom(0.9)  # room for the slider
    if last:
        line: dict[str, Any] = {"pointa": (0.06, 0.07), "pointb": (0.5, 0.07), "style": "modern", "title_height": 0.02}
        plotter.add_slider_widget(go_to, (0, last), value=first, title="snapshot", fmt="%.0f", color="black", **line)
    return plotter, go_to


def _bars(motion: Motion, frame: int, values: np.ndarray, on_nodes: bool, radius: np.ndarray | None) -> Any:
    """Return the bars of a snapshot that are there, as tubes or lines, with the values of their colours."""
    import pyvista

    gone = motion.gone(frame)
    there = np.arange(motion.n_bars) if gone is None else np.flatnonzero(~gone)
    if not len(there):  # a mesh has at least a point
        mesh = pyvista.PolyData(motion.bounds[:1].astype(np.float32))
        mesh.point_data["value"] = np.full(1, np.nan)
        return mesh
    # each bar has ends of its own, so that its tube ends there and has its radius
    ends = motion.bars[there].ravel()
    lines = np.insert(np.arange(len(ends)).reshape(-1, 2), 0, 2, axis=1).ravel()
    mesh = pyvista.PolyData(motion.positions(frame)[ends].astype(np.float32), lines=lines)
    mesh.point_data["value"] = values[ends] if on_nodes else np.repeat(values[there], 2)
    if radius is None:
        return mesh
    mesh.point_data["radius"] = np.repeat(radius[there], 2)
    return mesh.tube(scalars="radius", absolute=True, n_sides=_SIDES)


def _walls(motion: Motion, frame: int) -> Any:
    """Return the faces of all walls of a snapshot, which fade out behind."""
    import pyvista

    parts, faces, shades, count = [np.zeros((0, 3))], [np.zeros(0, dtype=int)], [np.zeros((0, 4))], 0
    for surface in motion.surfaces[frame]:
        points, corners = np.asarray(surface.points, dtype=float), np.asarray(surface.faces)
        faces.append(np.insert(corners + count, 0, corners.shape[1], axis=1).ravel())
        parts.append(points)
        opacity = 120.0 * (1.0 - np.clip(np.asarray(surface.depth), 0.0, 1.0))
        shades.append(np.column_stack([np.tile(WALL_COLOUR, (len(points), 1)), opacity]))
        count += len(points)
    if count == 0:  # a mesh has at least a point
        mesh = pyvista.PolyData(motion.bounds[:1].astype(np.float32))
        mesh.point_data["shade"] = np.zeros((1, 4), dtype=np.uint8)
        return mesh
    mesh = pyvista.PolyData(np.concatenate(parts).astype(np.float32), faces=np.concatenate(faces))
    mesh.point_data["shade"] = np.concatenate(shades).astype(np.uint8)
    return mesh

"""An interactive window of a result, with a slider over its snapshots."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from .headless import VARIABLE, require_rendering
from .scene import TUBE_LIMIT
from .shots import Moves, shots

__all__ = ["plotter_of", "show"]


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
    from .options import opened

    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise InputError(
            "render: --window: there is no display (DISPLAY is not set); take --html, which writes a page for a browser"
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

    from .web_page import state

    options.setdefault("clim", None)
    shown = state(result, frame, note, **options)
    motion, colour, scale = shown["motion"], shown["colour"], shown["scale"]
    if options["clim"] is None:  # one range for all snapshots
        from .fields import ColourScale
        from .options import limits_of

        every = [colour.limits(range(len(result.times)))]
        limits = limits_of(None, options.get("symmetric", False), every)
        scale = ColourScale(limits, options.get("cmap"), colour.unit)
    plotter = pyvista.Plotter(off_screen=off_screen, title=shown["title"])
    plotter.background_color = "white"
    cells = np.column_stack([np.full(motion.n_bars, 2), motion.bars]).ravel()
    mesh = pyvista.PolyData(motion.positions(motion.frames[0]).astype(np.float32), lines=cells)
    values = mesh.point_data if colour.on_nodes else mesh.cell_data
    values["value"] = scale.factor * colour.values(motion.frames[0])
    tubes = motion.n_bars <= TUBE_LIMIT if options.get("style", "auto") == "auto" else options["style"] == "tubes"
    plotter.add_mesh(
        mesh,
        scalars="value",
        preference="point" if colour.on_nodes else "cell",
        cmap=scale.cmap,
        clim=(scale.factor * scale.low, scale.factor * scale.high),
        line_width=4.0 if tubes else 1.5,
        render_lines_as_tubes=tubes,
        lighting=tubes,
        scalar_bar_args={"title": colour.title + (f" [{scale.unit}]" if scale.unit else ""), "color": "black"},
    )
    title = plotter.add_text(motion.time(motion.frames[0]), font_size=10, color="black")

    def go_to(value: float) -> None:
        k = round(value)
        mesh.points = motion.positions(k).astype(np.float32)
        values["value"] = scale.factor * colour.values(k)
        title.SetText(2, motion.time(k))

    camera = shots(motion, Moves(shown["view"]), 4 / 3)[0]
    plotter.camera.position = camera.centre + camera.distance * camera.towards
    plotter.camera.focal_point, plotter.camera.up = camera.centre, camera.up
    plotter.reset_camera()
    last = len(result.times) - 1
    if last:
        plotter.add_slider_widget(go_to, (0, last), value=motion.frames[0], title="snapshot", fmt="%.0f", color="black")
    return plotter, go_to

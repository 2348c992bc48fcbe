"""Results to turn: a web page of one file, which needs no network, and a window with a slider over the snapshots."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError, written
from .camera import Camera, cameras
from .chart import opened
from .motion import chosen_frames
from .options import Options
from .render import Film
from .scene import FEW, VARIABLE, WALL_COLOUR, Segments, add_wall, point_camera, require_rendering

_WIDTHS = ((300, 3.0), (20_000, 1.8))  # least widths of bars in pixels, by the number of bars
_CONFIG = {"displaylogo": False, "scrollZoom": True}
_SHAPES = ((2000, 5), (20_000, 3))  # from the initial one to that of the snapshot, by the number of bars


def render_html(
    result_path: Path | str | Any,
    output: Path | str | None = None,
    *,
    frame: int = -1,
    note: Callable[[str], None] = print,
    **options: Any,
) -> Path:
    """Write ``render.html``: a state for turning, moving and zooming, and between it and the first one.

    Parameters
    ----------
    result_path : result file or its folder, or an open result
    output : folder of the page; None: beside the result
    frame : number of the snapshot; -1: the last
    note : receives messages
    options : ``field, component, clim, symmetric, cmap, scale, style, radius_scale, title, view``, see
        :class:`~pfem_petsc.post.options.Options`

    Raises
    ------
    InputError
        For options that do not fit the result, a file that cannot be written, or without plotly.
    """
    with opened(result_path) as result:
        film = Film([result], Options(frames=chosen_frames([frame], np.asarray(result.times), note), **options), note)
        figure = _figure(film)
        file = (Path(output) if output is not None else Path(result.path).parent) / "render.html"
    with written(file, "the page"):
        figure.write_html(file, include_plotlyjs=True, auto_play=False, default_height="98vh", config=_CONFIG)
    return file


def _figure(film: Film) -> Any:
    """Return the figure of plotly of a film's first frame."""
    try:
        import plotly.graph_objects as plotly
    except ImportError as error:
        raise InputError("render: --html needs plotly, which is not installed: pip install plotly") from error

    motion, colour, scale = film.motions[0], film.colours[0], film.scale
    frame, camera = motion.frames[0], cameras(film.options, motion, 1.6)[0]
    start, now, gone = motion.start, motion.positions(frame), motion.gone(frame)
    bars, radius = _bars(film, None, camera, 720)
    steps = np.linspace(0.0, 1.0, next((count for most, count in _SHAPES if motion.n_bars <= most), 2))
    places = []
    for step in steps:
        bars.move(start + step * (now - start), radius if gone is None else np.where(gone, -1.0, radius))
        places.append(np.asarray(bars.mesh.points).T.copy())
    label = colour.title + (f" [{scale.unit}]" if scale.unit else "")
    stops = [[k / 15, "rgb({:.0f},{:.0f},{:.0f})".format(*(255 * np.array(scale.cmap(k / 15)[:3])))] for k in range(16)]
    shades: dict[str, Any] = {
        "colorscale": stops,
        "cmin": scale.factor * scale.low,
        "cmax": scale.factor * scale.high,
        "colorbar": {"title": {"text": label.replace(" ", "<br>", 1)}, "len": 0.7, "thickness": 20},
    }
    values = scale.factor * colour.values(frame)[bars.rows].astype(np.float32)
    look: dict[str, Any] = {"hoverinfo": "skip"}
    if film.styles[0].tubes:
        corners, kind = bars.mesh.regular_faces, plotly.Mesh3d
        look |= dict(zip("ijk", np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]]).T, strict=True))
        look |= {"intensity": values, "lighting": {"ambient": 0.5, "diffuse": 0.6, "specular": 0.2}, **shades}
    else:
        # a line ends where a number is missing
        places = [np.insert(x.reshape(3, -1, 2), 2, np.nan, axis=2).reshape(3, -1) for x in places]
        width = 2.0 * next((width for most, width in _WIDTHS if motion.n_bars <= most), 1.2)
        between, kind = np.insert(values.reshape(-1, 2), 2, 0.0, axis=1).ravel(), plotly.Scatter3d
        look |= {"mode": "lines", "line": {"color": between, "width": width, **shades}}
    traces = [dict(zip("xyz", x, strict=True)) for x in places]
    walls = [_wall(plotly, surface) for surface in motion.surfaces[frame]]
    figure = plotly.Figure([kind(**traces[-1], **look), *walls])
    figure.frames = [
        plotly.Frame(name=f"{step:.2f}", data=[kind(**x)], traces=[0]) for step, x in zip(steps, traces, strict=True)
    ]
    now = {"mode": "immediate", "frame": {"duration": 0, "redraw": True}, "transition": {"duration": 0}}
    choices = [{"label": each.name, "method": "animate", "args": [[each.name], now]} for each in figure.frames]
    hidden = {"visible": False}
    figure.update_layout(
        title={"text": f"<b>{_text(film.title)}</b><br>{_text(motion.time(frame))}", "x": 0.01},
        margin={"l": 0, "r": 0, "t": 60, "b": 20},
        showlegend=False,
        sliders=[
            {"active": len(steps) - 1, "steps": choices, "len": 0.5, "x": 0.03, "currentvalue": {"prefix": "shape: "}}
        ],
        scene={
            "aspectmode": "data",
            "dragmode": "orbit",
            **{f"{axis}axis": hidden for axis in "xyz"},
            "camera": {
                "eye": dict(zip("xyz", 2.1 * camera.towards, strict=True)),
                "up": dict(zip("xyz", camera.up, strict=True)),
                "projection": {"type": "orthographic" if camera.parallel else "perspective"},
            },
        },
    )
    return figure


def _text(words: str) -> str:
    return words.replace("&", "&amp;").replace("<", "&lt;")


def _wall(plotly: Any, surface: Any) -> Any:
    """Return the face of a wall that nodes touch."""
    faces = np.asarray(surface.faces)
    faces = faces[(np.asarray(surface.depth)[faces] == 0.0).all(axis=1)]
    corners = dict(zip("ijk", np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]]).T, strict=True))
    x, y, z = np.asarray(surface.points, dtype=float).T
    shade = "rgb({},{},{})".format(*WALL_COLOUR)
    return plotly.Mesh3d(x=x, y=y, z=z, **corners, color=shade, opacity=0.35, hoverinfo="skip")


def _bars(film: Film, plotter: Any, camera: Camera, height: int) -> tuple[Segments, np.ndarray]:
    """Return the bars of a result, and their radii [m], of a least width in a picture of a height [pixels]."""
    motion, style = film.motions[0], film.styles[0]
    kind = "line" if not style.tubes else "rough" if motion.n_bars <= FEW else "prism"
    radius = np.zeros(motion.n_bars) if style.radius is None else style.radius
    least = next((width for most, width in _WIDTHS if motion.n_bars <= most), 1.2) * camera.half_height / height
    bars = Segments(plotter, motion.bars, kind, film.colours[0].on_nodes, width=1.5)
    return bars, np.maximum(radius, least)


def show(
    result_path: Path | str | Any, *, frame: int = -1, note: Callable[[str], None] = print, **options: Any
) -> None:
    """Show a window until it is closed.

    Parameters
    ----------
    result_path : result file or its folder, or an open result
    frame : number of the first snapshot that is shown; -1: the last
    note : receives messages
    options : as for :func:`render_html`

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
    film = Film([result], Options(frames=range(last + 1), **options), note)
    motion, colour, scale = film.motions[0], film.colours[0], film.scale
    camera = cameras(film.options, motion, 4 / 3)[0]
    plotter = pyvista.Plotter(off_screen=off_screen, title=film.title)
    plotter.background_color = "white"
    plotter.enable_anti_aliasing("msaa")
    bars, radius = _bars(film, plotter, camera, plotter.window_size[1])
    title = plotter.add_text(motion.time(first), font_size=10, color="black")
    walls: list[Any] = []

    def go_to(value: float) -> None:
        k = round(value)
        gone = motion.gone(k)
        shown = radius if gone is None else np.where(gone, -1.0, radius)
        bars.move(motion.positions(k), shown, scale.colours(colour.values(k)))
        for actor in walls:
            plotter.remove_actor(actor, reset_camera=False)
        walls[:] = [
            add_wall(plotter, each, np.asarray(each.points), 120, camera.towards) for each in motion.surfaces[k]
        ]
        title.SetText(2, motion.time(k))

    go_to(first)
    mapper = pyvista.DataSetMapper()
    limits = scale.factor * scale.low, scale.factor * scale.high
    mapper.lookup_table = pyvista.LookupTable(scale.cmap, scalar_range=limits)
    label = colour.title + (f" [{scale.unit}]" if scale.unit else "") + "\n"
    room = {"position_x": 0.86, "position_y": 0.2, "width": 0.07, "height": 0.6, "vertical": True}
    plotter.add_scalar_bar(label, mapper=mapper, color="black", fmt="%.4g", title_font_size=18, **room)
    point_camera(plotter, camera.zoomed(0.8))  # room for the slider and the colours
    if last:
        line: dict[str, Any] = {"pointa": (0.06, 0.07), "pointb": (0.5, 0.07), "style": "modern", "title_height": 0.02}
        plotter.add_slider_widget(go_to, (0, last), value=first, title="snapshot", fmt="%.0f", color="black", **line)
    return plotter, go_to

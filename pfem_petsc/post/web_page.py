"""A state of a result as a web page of one file, for turning in a browser without a network."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from .fields import ColourField, ColourScale
from .frames import chosen_frames
from .motion import Motion, Overlays
from .options import checked_style, limits_of, opened
from .radii import drawn_radii
from .scene import TUBE_LIMIT
from .shots import Moves, shots

__all__ = ["render_html", "state"]

_WIDTHS = ((300, 3.0), (TUBE_LIMIT, 1.8))  # least widths of bars in pixels, by the number of bars


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
    options : ``field, component, clim, symmetric, cmap, scale, style, radius_scale, title, view`` as for ``render``

    Raises
    ------
    InputError
        For options that do not fit the result, or a file that cannot be written.
    """
    with opened(result_path) as result:
        shown = state(result, chosen_frames([frame], np.asarray(result.times), note), note, **options)
        motion, colour, scale = shown["motion"], shown["colour"], shown["scale"]
        number = motion.frames[0]
        camera = shots(motion, Moves(shown["view"]), 1.6)[0]
        ways = {name: getattr(camera, name).tolist() for name in ("right", "up", "towards")}
        start, now = motion.start, motion.positions(number)
        centre = motion.bounds.mean(axis=0)
        gone = motion.gone(number)
        there = np.ones(motion.n_bars, dtype=bool) if gone is None else ~gone
        shades = scale.places(colour.values(number))
        radii = np.zeros(motion.n_bars) if shown["radius"] is None else shown["radius"]
        low, high = scale.low * scale.factor, scale.high * scale.factor
        corners = np.array(np.meshgrid(*motion.bounds.T)).reshape(3, -1).T - centre
        data = {
            "title": shown["title"],
            "time": motion.time(number),
            "field": colour.title + (f" [{scale.unit}]" if scale.unit else ""),
            "table": _text(scale.table, np.uint8),
            "ticks": [(k / 4, f"{low + k / 4 * (high - low):.4g}") for k in range(5)],
            "start": _text(start - centre, np.float32),
            "now": _text(now - centre, np.float32),
            "bars": _text(motion.bars[there], np.uint32),
            "radii": _text(radii[there], np.float32),
            "shades": _text(shades if colour.on_nodes else shades[there], np.uint8),
            "onNodes": colour.on_nodes,
            "walls": _text(_walls(motion, number, centre), np.float32),
            "size": 1.25 * (float(np.linalg.norm(corners, axis=1).max()) or 1.0),
            "width": next((width for most, width in _WIDTHS if motion.n_bars <= most), 1.2),
            **ways,
        }
        folder = Path(output) if output is not None else Path(result.path).parent
    # "<" in a title must not end the script that the data are in
    text = json.dumps(data, ensure_ascii=True).replace("<", "\\u003c")
    page = Path(__file__).with_name("viewer.html").read_text()
    page = page.replace("@TITLE@", html.escape(shown["title"])).replace("@DATA@", text)
    file = folder / "render.html"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file.write_text(page)
    except OSError as error:
        raise InputError(f"{file}: the page cannot be written ({error.strerror}); give another folder") from error
    return file


def state(
    result: Any,
    frames: Sequence[int],
    note: Callable[[str], None],
    *,
    field: str = "stress",
    component: str | int | None = None,
    clim: tuple[float, float] | None = None,
    symmetric: bool = False,
    cmap: Any = None,
    scale: float = 1.0,
    style: str = "auto",
    radius_scale: float = 1.0,
    title: str | None = None,
    view: str | Sequence[float] = "auto",
) -> dict[str, Any]:
    """Return what interactive pictures show of snapshots: motion, colours, radii, title and view.

    Raises
    ------
    InputError
        For options that do not fit the result.
    """
    checked_style(style, radius_scale)
    colour = ColourField(result, field, component)
    limits = limits_of(clim, symmetric, [colour.limits(frames)] if clim is None else [])
    tubes = len(result.bars) <= TUBE_LIMIT if style == "auto" else style == "tubes"
    radius = drawn_radii(result, note if style == "tubes" else None) if tubes else None
    return {
        "motion": Motion(result, frames, scale, Overlays(), note),
        "colour": colour,
        "scale": ColourScale(limits, cmap, colour.unit),
        "radius": None if radius is None else radius_scale * radius,
        "tubes": tubes,
        "title": title if title is not None else (result.case.title or result.case.name),
        "view": view,
    }


def _walls(motion: Motion, frame: int, centre: np.ndarray) -> np.ndarray:
    """Return corners of triangles of the walls, (t, 4): places about a centre [m], and opacity."""
    parts = [np.zeros((0, 4))]
    for surface in motion.surfaces[frame]:
        faces = np.asarray(surface.faces)
        triangles = np.concatenate([faces[:, [0, k, k + 1]] for k in range(1, faces.shape[1] - 1)]).ravel()
        opacity = 0.4 * (1.0 - np.clip(np.asarray(surface.depth), 0.0, 1.0))
        parts.append(np.column_stack([np.asarray(surface.points)[triangles] - centre, opacity[triangles]]))
    return np.concatenate(parts)


def _text(values: np.ndarray, kind: type) -> str:
    return base64.b64encode(np.ascontiguousarray(values).astype(np.dtype(kind).newbyteorder("<")).tobytes()).decode()

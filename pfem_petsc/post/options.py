"""Options of pictures, checked, and what several kinds of pictures do with them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from ..errors import InputError

__all__ = ["checked_style", "kinds_of_films", "limits_of", "opened"]

VIDEOS = {
    "mp4": ("mp4",),
    "gif": ("gif",),
    "both": ("mp4", "gif"),
    "none": (),
    "webm": ("webm",),
    "webp": ("webp",),
}
STYLES = ("auto", "tubes", "lines")


def kinds_of_films(
    video: str | None,
    fps: float,
    size: tuple[int, int],
    style: str,
    radius_scale: float,
    bar_width: float | None,
    transparent: bool,
) -> tuple[str, ...]:
    """Return the kinds of films to make, after checks."""
    video = video or ("webm" if transparent else "mp4")
    if video not in VIDEOS:
        raise InputError(f"render: video = {video!r} is not known; it is one of {', '.join(VIDEOS)}")
    if transparent and video in ("mp4", "both"):
        raise InputError(f"render: video = {video!r}: MP4 has no transparent background; use webm, webp, gif or none")
    if size[0] < 160 or size[1] < 120 or max(size) > 8192:
        raise InputError(
            f"render: size = {size[0]} x {size[1]} pixels is out of range; widths are 160 to 8192, heights 120 to 8192"
        )
    if not 1e-3 <= fps <= 1e3:
        raise InputError(f"render: fps = {fps:g} must be from 0.001 to 1000 frames per second")
    checked_style(style, radius_scale)
    if bar_width is not None and not 0.0 < bar_width <= 500.0:
        raise InputError(f"render: bar_width = {bar_width:g} must be positive, and 500 pixels at most")
    return VIDEOS[video]


def checked_style(style: str, radius_scale: float) -> None:
    """Refuse a style that is not known, and radii that cannot be drawn."""
    if style not in STYLES:
        raise InputError(f"render: style = {style!r} is not known; it is one of {', '.join(STYLES)}")
    if not 1e-6 <= radius_scale <= 1e6:
        raise InputError(f"render: radius_scale = {radius_scale:g} must be from 1e-6 to 1e6")


def limits_of(
    clim: tuple[float, float] | None, symmetric: bool, found: Sequence[tuple[float, float]]
) -> tuple[float, float]:
    """Return the range of colours: the one given, or that of all found, symmetric if asked for."""
    low, high = clim or (min(pair[0] for pair in found), max(pair[1] for pair in found))
    if symmetric:
        high = max(abs(low), abs(high))
        low = -high
    return low, high


def opened(result: Path | str | Any) -> Any:
    """Return a context of a result that is open, or opened by its path."""
    if not isinstance(result, (str, os.PathLike)):
        return nullcontext(result)
    from ..output.result import open_result

    return open_result(result)

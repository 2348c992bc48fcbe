"""Pictures and films of results, without a display or a graphics library."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import InputError
from ..parallel.agreement import agreed
from .fields import ColourField, ColourScale
from .files import emptied, save
from .film import Film, Look
from .frames import Resampled, chosen_frames, even_times
from .motion import Motion, Overlays
from .options import kinds_of_films, limits_of, opened
from .radii import drawn_radii
from .scene import TUBE_LIMIT, Style
from .shots import Moves

if TYPE_CHECKING:
    from mpi4py import MPI

__all__ = ["render"]

SHORT = 2.0  # seconds below which a film is too short to follow
TELL = 5.0  # seconds between two progress messages


def render(
    result_path: Path | str | Any | Sequence[Path | str | Any],
    output: Path | str | None = None,
    *,
    field: str = "stress",
    component: str | int | None = None,
    frames: int | Iterable[int] | None = None,
    fps: float = 24,
    size: tuple[int, int] = (1280, 720),
    view: str | Sequence[float] = "auto",
    video: str | None = None,
    poster: bool = True,
    clim: tuple[float, float] | None = None,
    symmetric: bool = False,
    cmap: Any = None,
    scale: float = 1.0,
    style: str = "auto",
    radius_scale: float = 1.0,
    bar_width: float | None = None,
    nodes: bool | None = None,
    ghost: bool = False,
    marks: Sequence[str] = (),
    trails: Sequence[str] = (),
    inset: str | None = None,
    zoom: float = 1.0,
    orbit: float = 0.0,
    path: Any = None,
    follow: str | None = None,
    rate: float | None = None,
    span: Sequence[float] | None = None,
    labels: Sequence[str] | None = None,
    transparent: bool = False,
    title: str | None = None,
    note: Callable[[str], None] = print,
    comm: MPI.Comm | None = None,
) -> list[Path]:
    """Draw a result: ``frames/frame_0000.png`` ..., a film ``render.mp4`` or another, and a poster ``render.png``.

    Parameters
    ----------
    result_path : result file or its folder, or an open result; or several of them, which are drawn side by side
    output : folder of the pictures; None: beside the result, of several: ``side_by_side`` beside the first
    field : point or cell field that colours the bars
    component : "x", "y" or "z" of a vector field; None: its length
    frames : numbers of snapshots, or how many of them (evenly spaced); None: all, up to 300
    fps : frames per second of the film
    size : of a frame in pixels
    view : "xy", "xz", "yz", "iso", "front", "back", "left", "right", "top", "bottom", the direction (3,) from the
        structure to the eye, or "auto": along the flat direction of a flat structure, oblique otherwise
    video : "mp4", "gif", "both", "webm", "webp" or "none"; None: "mp4", "webm" with a transparent background
    poster : also draw six instants on one page
    clim : range of the colours in the field's SI unit; None: from the snapshots, symmetric for signed fields
    symmetric : whether the range is symmetric about zero for any field
    cmap : matplotlib colour map or its name
    scale : factor on the nodes' displacements since the first snapshot; walls are not scaled
    style : "tubes" of the radii of the sections, "lines", or "auto": tubes for up to 20,000 bars
    radius_scale : factor on the radii of tubes
    bar_width : least width of bars in pixels
    nodes : whether to draw nodes as balls; None: for small models
    ghost : whether to draw the first snapshot, pale, behind the others
    marks : "broken" bars as stubs, "yielded" ones with a rim
    trails : names of probes whose trajectories are drawn
    inset : column of the history, drawn as a curve with a marker in a corner, of several results with the same axes
    zoom, orbit, path, follow : of the camera, see :class:`~pfem_petsc.post.shots.Moves`
    rate : frames per simulated second, between snapshots if need be; None: frames are snapshots
    span : first and last time [s] of the film
    labels : of several results; None: the names of their folders
    transparent : whether frames and film have a transparent background
    title : None: that of the case
    note : receives messages, such as walls that cannot be drawn, and progress
    comm : its ranks divide the frames, and the first one makes the film; None: this process draws all

    Returns
    -------
    The files written: poster, films, frames.

    Raises
    ------
    InputError
        For options that do not fit the result, or a folder that cannot be written.
    """
    first = comm is None or comm.rank == 0
    tell = note if first else _nothing
    kinds = kinds_of_films(video, fps, size, style, radius_scale, bar_width, transparent)
    moves = Moves(view, zoom, orbit, path, follow).checked()
    many = isinstance(result_path, (list, tuple))
    with ExitStack() as stack:
        results = [stack.enter_context(opened(each)) for each in (result_path if many else [result_path])]
        if not results:
            raise InputError("render: no result to draw")
        names = _labels(results, labels)
        folder = _folder(results, output)
        shown, chosen = _timed(results, frames, rate, span, tell)
        colours = [ColourField(result, field, component) for result in shown]
        limits = limits_of(clim, symmetric, [colour.limits(chosen) for colour in colours] if clim is None else [])
        if all(colour.rounded for colour in colours):
            tell(f"{colours[0].title} is zero in all frames, to rounding")
        overlays = Overlays(ghost, tuple(marks), tuple(trails))
        motions = [Motion(result, chosen, scale, overlays, tell) for result in shown]
        look = Look(
            [_style(result, style, radius_scale, bar_width, nodes, note) for result in results],
            *(moves, tuple(marks), inset, names, transparent),
        )
        heading = title if title is not None else (results[0].case.title or results[0].case.name)
        film = Film(motions, colours, ColourScale(limits, cmap, colours[0].unit), heading, look)
        _tell_length(film, fps, rate, kinds, tell)
        pictures = _draw_frames(film, folder / "frames", size, tell, comm)
        written = []
        if first and poster:
            written.append(save(film.poster(), folder / "render.png"))
        if first and kinds:
            from .video import encode

            written += [encode(folder / "frames" / "frame_%04d.png", folder / f"render.{k}", fps) for k in kinds]
    if comm is not None:
        written = comm.bcast(written)
    return written + pictures


def _nothing(text: str) -> None:
    """Receive messages of ranks that do not print."""


def _labels(results: Sequence[Any], labels: Sequence[str] | None) -> list[str]:
    if labels is None:
        return [Path(result.path).absolute().parent.name for result in results]
    if len(labels) != len(results):
        raise InputError(f"render: {len(labels)} labels for {len(results)} results; give one for each")
    return list(labels)


def _folder(results: Sequence[Any], output: Path | str | None) -> Path:
    if output is not None:
        return Path(output)
    beside = Path(results[0].path).parent
    return beside / "side_by_side" if len(results) > 1 else beside


def _timed(
    results: Sequence[Any],
    frames: int | Iterable[int] | None,
    rate: float | None,
    span: Sequence[float] | None,
    note: Callable[[str], None],
) -> tuple[list[Any], list[int]]:
    """Return the results at common times, and the numbers of those that are drawn."""
    times = np.asarray(results[0].times, dtype=float)
    if len({result.axis for result in results}) > 1:
        names = ", ".join(dict.fromkeys(result.axis.symbol for result in results))
        raise InputError(f"render: the results are over different axes ({names}): draw them one by one")
    if any(len(result.times) == 0 for result in results):
        raise InputError("render: the result holds no snapshots; set [output] fields_every and run again")
    if rate is not None:
        if frames is not None:
            raise InputError("render: frames and rate both choose the frames; give one of the two")
        times = even_times(times, rate, span)
        return [Resampled(result, times) for result in results], list(range(len(times)))
    chosen = chosen_frames(frames, times, note, span)
    return [results[0], *(Resampled(result, times) for result in results[1:])], chosen


def _style(
    result: Any,
    style: str,
    radius_scale: float,
    bar_width: float | None,
    nodes: bool | None,
    note: Callable[[str], None],
) -> Style:
    tubes = len(result.bars) <= TUBE_LIMIT if style == "auto" else style == "tubes"
    radius = drawn_radii(result, note if style == "tubes" else None) if tubes else None
    return Style(tubes, None if radius is None else radius_scale * radius, bar_width, nodes)


def _tell_length(film: Film, fps: float, rate: float | None, kinds: Sequence[str], note: Callable[[str], None]) -> None:
    """Say how long the film lasts where that is not what one expects."""
    if rate is not None and film.motions[0].result.axis.unit == "s":
        slower = rate / fps
        pace = f"{slower:.3g} times slower" if slower >= 1.0 else f"{1.0 / slower:.3g} times faster"
        note(f"{film.count} frames last {film.count / fps:.1f} s: {pace} than simulated")
    elif kinds and film.count > 1 and film.count / fps < SHORT:
        slower = max(1, round(film.count / 5.0))
        lasts = f"the film of {film.count} frames lasts {film.count / fps:.1f} s"
        note(f"{lasts}; with fps = {slower} (--fps {slower}) it lasts about 5 s")


def _draw_frames(
    film: Film, folder: Path, size: tuple[int, int], note: Callable[[str], None], comm: MPI.Comm | None
) -> list[Path]:
    """Draw the frames of this rank; return the files of all."""
    rank, ranks = (comm.rank, comm.size) if comm is not None else (0, 1)
    if comm is None:
        emptied(folder)
    else:
        with agreed(comm):
            if rank == 0:
                emptied(folder)
    film.start(size)
    told = time.monotonic()
    files = [folder / f"frame_{number:04d}.png" for number in range(film.count)]
    for number in range(rank, film.count, ranks):
        if time.monotonic() - told > TELL:
            told = time.monotonic()
            note(f"{number} of {film.count} frames are drawn")
        save(film.frame(number), files[number])
    if comm is not None:
        comm.Barrier()
    return files

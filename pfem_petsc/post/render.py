"""Pictures and films of a result, without a display."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..fields import STATUS
from ..output.units import prefix_for
from .camera import VIEWS, Camera, aim
from .fields import ColourField, ColourScale
from .headless import require_rendering
from .walls import Surface, wall_shifts, wall_surfaces, walls_present

__all__ = ["render"]

VIDEOS = ("mp4", "gif", "both", "none")
MOST_FRAMES = 300  # default limit: more frames make a film of over ten seconds
POSTER_TILES = 6
SHORT = 2.0  # seconds below which a film is too short to follow
TELL = 5.0  # seconds between two progress messages


def render(
    result_path: Path | str | Any,
    output: Path | str | None = None,
    *,
    field: str = "stress",
    component: str | int | None = None,
    frames: int | Iterable[int] | None = None,
    fps: float = 24,
    size: tuple[int, int] = (1280, 720),
    view: str = "auto",
    video: str = "mp4",
    poster: bool = True,
    clim: tuple[float, float] | None = None,
    cmap: Any = None,
    scale: float = 1.0,
    bar_width: float | None = None,
    nodes: bool | None = None,
    title: str | None = None,
    note: Callable[[str], None] = print,
) -> list[Path]:
    """Draw a result: ``frames/frame_0000.png`` ..., a film ``render.mp4`` or ``.gif``, and a poster ``render.png``.

    Parameters
    ----------
    result_path : result file or its folder, or an open result
    output : folder of the pictures; None: beside the result
    field : point or cell field that colours the bars
    component : "x", "y" or "z" of a vector field; None: its length
    frames : numbers of snapshots, or how many of them (evenly spaced); None: all, up to 300
    fps : frames per second of the film
    size : of a frame in pixels
    view : "xy", "xz", "yz", "iso", or "auto": along the flat direction of a flat structure, oblique otherwise
    video : "mp4", "gif", "both" or "none"
    poster : also draw six instants on one page
    clim : range of the colours in the field's SI unit; None: from the snapshots, symmetric for signed fields
    cmap : matplotlib colour map or its name
    scale : factor on the nodes' displacements since the first snapshot; walls are not scaled
    bar_width : in pixels
    nodes : whether to draw nodes as balls; None: for small models
    title : None: that of the case
    note : receives messages, such as walls that cannot be drawn, and progress

    Returns
    -------
    The files written: poster, films, frames.

    Raises
    ------
    InputError
        For options that do not fit the result, a folder that cannot be written, or if rendering is not available.
    """
    if view not in VIEWS:
        raise InputError(f"render: view = {view!r} is not known; it is one of {', '.join(VIEWS)}")
    if video not in VIDEOS:
        raise InputError(f"render: video = {video!r} is not known; it is one of {', '.join(VIDEOS)}")
    if min(size) < 160 or max(size) > 8192:
        raise InputError(f"render: size = {size[0]} x {size[1]} pixels is out of range; each side takes 160 to 8192")
    if not fps > 0:
        raise InputError(f"render: fps = {fps:g} must be positive")
    require_rendering()
    with _opened(result_path) as result:
        folder = Path(output) if output is not None else Path(result.path).parent
        chosen = _chosen(frames, len(result.times), note)
        colour = ColourField(result, field, component)
        scale_of_colours = ColourScale(clim or colour.limits(chosen), cmap, colour.unit)
        film = _Film(result, colour, scale_of_colours, chosen, view, scale, note)
        style = {"bar_width": bar_width, "nodes": nodes}
        if video != "none" and len(chosen) > 1 and len(chosen) / fps < SHORT:
            slower = max(1, round(len(chosen) / 5.0))
            lasts = f"the film of {len(chosen)} frames lasts {len(chosen) / fps:.1f} s"
            note(f"{lasts}; with fps = {slower} (--fps {slower}) it lasts about 5 s")
        heading = title if title is not None else (result.case.title or result.case.name)
        pictures = _draw_frames(film, _emptied(folder / "frames"), size, heading, style)
        written = []
        if poster:
            written.append(_draw_poster(film, folder / "render.png", heading, style))
        if video != "none":
            from .video import encode

            pattern = folder / "frames" / "frame_%04d.png"
            written += [
                encode(pattern, folder / f"render.{kind}", fps) for kind in ("mp4", "gif") if video in (kind, "both")
            ]
    return written + pictures


def _opened(result: Path | str | Any) -> Any:
    if not isinstance(result, (str, os.PathLike)):
        return nullcontext(result)
    from ..output.result import open_result

    return open_result(result)


def _chosen(frames: int | Iterable[int] | None, count: int, note: Callable[[str], None]) -> list[int]:
    if count == 0:
        raise InputError("render: the result holds no snapshots; set [output] fields_every and run again")
    if frames is None and count > MOST_FRAMES:
        note(f"{MOST_FRAMES} of {count} snapshots are drawn; ask for more with frames = {count}")
        frames = MOST_FRAMES
    if frames is None:
        return list(range(count))
    if isinstance(frames, (int, np.integer)):
        if frames < 1:
            raise InputError(f"render: frames = {frames} must be positive")
        return [int(k) for k in np.unique(np.linspace(0, count - 1, min(int(frames), count)).round())]
    chosen = [int(k) for k in frames]
    for k in chosen:
        if not -count <= k < count:
            raise InputError(f"render: frame {k} does not exist; the result holds snapshots 0 to {count - 1}")
    if not chosen:
        raise InputError("render: frames is an empty list")
    return [k % count for k in chosen]


def _emptied(folder: Path) -> Path:
    """Create the folder of the frames and remove frames of an earlier film, which would end up in this one."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for old in folder.glob("frame_*.png"):
            old.unlink()
    except OSError as error:
        raise InputError(
            f"{folder}: pictures cannot be written here ({error.strerror}); give another folder"
        ) from error
    return folder


@dataclass
class _Film:
    """Data shared by all frames: motion of the structure and its walls, and colours."""

    result: Any
    colour: ColourField
    colours: ColourScale
    frames: Sequence[int]
    view: str
    scale: float
    note: Callable[[str], None]

    def __post_init__(self) -> None:
        self.bars = np.asarray(self.result.bars)
        self.start = np.asarray(self.result.positions(0), dtype=float)
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        for frame in self.frames:
            points = self._held(frame)
            low, high = np.fmin(low, points.min(axis=0)), np.fmax(high, points.max(axis=0))
        self.bounds = np.array([low, high])
        walls = self.result.case.every_wall
        self.surfaces = self._moved(walls)
        self.normals = [np.asarray(wall.normal, dtype=float) for wall in walls if hasattr(wall, "normal")]
        self.normals = [normal / np.linalg.norm(normal) for normal in self.normals]
        times = np.asarray(self.result.times, dtype=float)
        self.time_factor, self.time_unit = prefix_for(float(np.abs(times).max()), self.result.axis.unit)

    def _moved(self, walls: Sequence[Any]) -> dict[int, list[Surface]]:
        """Return, by frame, the surfaces of the walls at that time; a wall at rest has the same one in all frames.

        ``self.shown`` says which of them are there: those that a stage does not have are not drawn.
        """
        times = self.result.times[list(self.frames)]
        displacements = dict(zip(self.frames, wall_shifts(self.result, times), strict=True))
        present = dict(zip(self.frames, walls_present(self.result, times), strict=True))
        still = {surface.name: surface for surface in wall_surfaces(walls, self.bounds, self.note)}
        drawn = [wall.name in still for wall in walls]
        self.shown = {frame: present[frame][drawn].tolist() for frame in self.frames}
        surfaces: dict[int, list[Surface]] = {frame: [] for frame in self.frames}
        for k, wall in enumerate(walls):
            if wall.name not in still:
                continue
            for frame in self.frames:
                surface, shift = still[wall.name], displacements[frame][k]
                if shift.any():
                    point = tuple((np.asarray(wall.point) + shift).tolist())
                    (surface,) = wall_surfaces([wall.model_copy(update={"point": point})], self.bounds)
                surfaces[frame].append(surface)
        return surfaces

    @property
    def places(self) -> Iterator[np.ndarray]:
        """Yield the points (n, 3) [m] of all distinct wall surfaces that are drawn."""
        drawn = (
            surface
            for frame, surfaces in self.surfaces.items()
            for surface, shown in zip(surfaces, self.shown[frame], strict=True)
            if shown
        )
        for surface in {id(surface): surface for surface in drawn}.values():
            yield surface.points

    def positions(self, frame: int) -> np.ndarray:
        points = np.asarray(self.result.positions(frame), dtype=float)
        return points if self.scale == 1.0 else self.start + self.scale * (points - self.start)

    def gone(self, frame: int) -> np.ndarray | None:
        """Return the bars (b,) that have left the model, None if the result does not tell."""
        if "status" not in self.result.cell_fields:
            return None
        return np.asarray(self.result.field("status", frame)) == STATUS.index("broken")

    def _held(self, frame: int) -> np.ndarray:
        """Return the positions of nodes with bars: others may fly far away, and would shrink the picture."""
        points, gone = self.positions(frame), self.gone(frame)
        if gone is None or gone.all():
            return points
        return points[np.unique(self.bars[~gone])]

    def time(self, frame: int) -> str:
        if hasattr(self.result, "caption"):
            return self.result.caption(frame)
        axis, time = self.result.axis, self.result.times[frame]
        return f"{axis.symbol} = {time * self.time_factor:.2f} {self.time_unit}" if axis.unit else axis.place(time)

    def camera(self, aspect: float) -> Camera:
        corners = np.array(np.meshgrid(*self.bounds.T)).reshape(3, -1).T
        near = [corners]
        size = float(np.linalg.norm(self.bounds[1] - self.bounds[0])) or 1.0
        for points in self.places:
            # a distant wall would shrink the structure to a dot: it is drawn but does not affect the view
            gap = np.maximum(points.min(axis=0) - self.bounds[1], self.bounds[0] - points.max(axis=0))
            if gap.max() < 0.6 * size:
                near.append(points)
        return aim(np.concatenate(near), self.bounds, self.normals, self.view, aspect, self._upward())

    def _upward(self) -> tuple[float, float, float]:
        gravity = getattr(self.result.case, "gravity", None)
        if gravity is not None:
            pull = np.asarray(gravity.mean, dtype=float)
            axis = int(np.argmax(np.abs(pull)))
            if np.count_nonzero(pull) == 1 and axis == 1:
                return (0.0, -float(np.sign(pull[1])), 0.0)
        return (0.0, 0.0, 1.0)

    def scene(self, camera: Camera, size: tuple[int, int], style: dict[str, Any]) -> Any:
        from .scene import Scene

        return Scene(self.start, self.bars, camera, self.bounds, self.surfaces[self.frames[0]], size, **style)

    def draw(self, scene: Any, frame: int) -> np.ndarray:
        colours = self.colours.colours(self.colour.values(frame))
        walls = self.surfaces[frame], self.shown[frame]
        return scene.draw(self.positions(frame), colours, self.colour.on_nodes, *walls, self.gone(frame))


def _draw_frames(film: _Film, folder: Path, size: tuple[int, int], title: str, style: dict[str, Any]) -> list[Path]:
    from .page import Page

    _, _, width, height = Page.region_of(size)
    camera = film.camera(width / height)
    page = Page(size, title, film.colour.title, film.colours, camera)
    scene = film.scene(camera, (width, height), style)
    files = []
    told = time.monotonic()
    for number, frame in enumerate(film.frames):
        if time.monotonic() - told > TELL:
            told = time.monotonic()
            film.note(f"{number} of {len(film.frames)} frames are drawn")
        files.append(folder / f"frame_{number:04d}.png")
        _save(page.compose(film.draw(scene, frame), film.time(frame)), files[-1])
    scene.close()
    return files


def _draw_poster(film: _Film, file: Path, title: str, style: dict[str, Any]) -> Path:
    """Six instants on one page, in a grid that suits the shape of the motion."""
    from .page import Page
    from .poster import grid, instants

    own = getattr(film.result, "instants", None)
    tiles = instants(film.result, film.frames, POSTER_TILES) if own is None else own(POSTER_TILES)
    look = film.camera(1.0)
    corners = np.array(np.meshgrid(*film.bounds.T)).reshape(3, -1).T
    shape = [np.ptp(np.concatenate([corners, *film.places]) @ way) for way in (look.right, look.up)]
    size = (1600, 900)
    _, _, width, height = Page.region_of(size)
    columns, rows = grid(len(tiles), shape[0] / max(shape[1], 1e-3 * shape[0]), (width, height))
    tile = (width // columns, height // rows - Page.strip_of(size))
    camera = film.camera(tile[0] / tile[1])
    page = Page(size, title, film.colour.title, film.colours, camera, drawn_height=tile[1])
    scene = film.scene(camera, tile, style)
    drawings = [film.draw(scene, frame) for frame in tiles]
    scene.close()
    return _save(page.compose_tiles(drawings, [film.time(frame) for frame in tiles], columns), file)


def _save(picture: np.ndarray, file: Path) -> Path:
    from PIL import Image

    try:
        # fast compression, because a film has hundreds of frames
        Image.fromarray(picture).save(file, compress_level=3)
    except OSError as error:
        raise InputError(f"{file}: the picture cannot be written ({error}); give another folder") from error
    return file

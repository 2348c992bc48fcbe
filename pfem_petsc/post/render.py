"""Pictures and films of results, side by side when there are several, without a display; a web page to turn one."""

from __future__ import annotations

import html
import os
import pickle
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import InputError, written
from ..output.result import stage_at
from ..parallel.agreement import agreed
from ..signals import launched_rank
from .chart import opened
from .motion import PERIOD, Motion, chosen_frames, drawn_radii, even_rows, even_times, mode_frames, resampled
from .options import Options
from .page import MARKS, ColourField, ColourScale, Heading, Page, grid
from .scene import FEW, TUBE_LIMIT, WALL_COLOUR, Scene, Style, at_one_scale, cameras, few_threads, tubes

if TYPE_CHECKING:
    from mpi4py import MPI

SHORT = 2.0  # seconds below which a film is too short to follow
TELL = 5.0  # seconds between two progress messages
SHARE = 12  # frames for which it is worth to start another process
_TILES = 6

# H.264 with 4:2:0 colours is supported everywhere, and requires even sizes
_ENCODERS = {
    "mp4": [
        *("-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2:color=white", "-c:v", "libx264", "-preset", "medium", "-crf", "18"),
        *("-pix_fmt", "yuv420p", "-movflags", "+faststart"),
    ],
    "gif": [
        "-vf",
        "scale='min(800,iw)':-2:flags=lanczos,split[a][b];[a]palettegen=stats_mode=diff[p];[b][p]paletteuse=dither=none",
    ],
    # with a transparent background
    "webm": ["-c:v", "libvpx-vp9", "-pix_fmt", "yuva420p", "-crf", "24", "-b:v", "0", "-row-mt", "1", "-cpu-used", "4"],
    # moving pictures for web pages
    "webp": ["-vf", "scale='min(960,iw)':-2:flags=lanczos", "-c:v", "libwebp_anim", "-q:v", "70", "-loop", "0"],
}


def _style(options: Options, result: Any, note: Callable[[str], None]) -> Style:
    """Return how the bars of a result are drawn."""
    tubes = options.style == "tubes" or (options.style == "auto" and len(result.bars) <= TUBE_LIMIT)
    radius = drawn_radii(result, note if options.style == "tubes" else None) if tubes else None
    return Style(None if radius is None else options.radius_scale * radius, options.bar_width, options.nodes)


def render(
    result_path: Path | str | Any | Sequence[Path | str | Any],
    output: Path | str | None = None,
    *,
    note: Callable[[str], None] = print,
    comm: MPI.Comm | None = None,
    **options: Any,
) -> list[Path]:
    """Draw a result: ``frames/frame_0000.png`` ..., a film ``render.mp4`` or another, and a poster ``render.png``.

    Parameters
    ----------
    result_path : result file or its folder, or an open result; or several of them, which are drawn side by side
    output : folder of the pictures; None: beside the result, of several: ``side_by_side`` beside the first
    note : receives messages, such as walls that cannot be drawn, and progress
    comm : its ranks divide the frames, and the first one makes the film; None, or one rank: processes of this machine
        divide the frames of a long film
    options : see :class:`~pfem_petsc.post.options.Options`

    Returns
    -------
    The files written: poster, films, frames.

    Raises
    ------
    InputError
        For options that do not fit the result, or a folder that cannot be written.
    """
    from mpi4py import MPI

    comm = comm or MPI.COMM_SELF
    first, chosen = comm.rank == 0, Options(**options)
    tell = note if first else _nothing
    paths = list(result_path) if isinstance(result_path, (list, tuple)) else [result_path]
    with ExitStack() as stack:
        results = [stack.enter_context(opened(each)) for each in paths]
        if not results:
            raise InputError("render: no result to draw")
        if output is None:
            beside = Path(results[0].path).parent
            output = beside / "side_by_side" if len(results) > 1 else beside
        folder = Path(output)
        film = Film(results, chosen, tell)
        film.tell_length(tell)
        with agreed(comm):
            if first:
                with written(folder / "frames/frame_0000.png", "the picture"):
                    for old in (folder / "frames").glob("frame_*.png"):
                        old.unlink()  # of an earlier film, which would end up in this one
        if comm.size == 1:
            helpers = _helpers(paths, folder, chosen, film.count)
            shares = [slice(k, None, len(helpers) + 1) for k in range(len(helpers) + 1)]
        else:
            few_threads()
            helpers, shares = [], [slice(comm.rank, None, comm.size)]
        film.write(folder / "frames", shares[0], tell)
        for helper, share in zip(helpers, shares[1:], strict=True):
            if helper.wait() != 0:  # it may not know a law of the user's, for example
                film.write(folder / "frames", share, tell)
        comm.Barrier()
        made = []
        if first and chosen.poster:
            made.append(save(film.poster(), folder / "render.png"))
        film.close()
        if first:
            pattern = folder / "frames" / "frame_%04d.png"
            made += [encode(pattern, folder / f"render.{kind}", chosen.fps) for kind in chosen.kinds]
    return comm.bcast(made) + [folder / "frames" / f"frame_{number:04d}.png" for number in range(film.count)]


def render_modes(
    result_path: Path | str,
    output: Path | str | None = None,
    *,
    modes: Sequence[int] | None = None,
    period: int = PERIOD,
    **options: Any,
) -> list[Path]:
    """Draw the modes of a result as :func:`render` draws its snapshots.

    Parameters
    ----------
    result_path : result file or its folder
    output : folder of the pictures; None: ``modes`` beside the result
    modes : numbers of the modes from 1; None: all
    period : frames of a period
    options : of ``render``, but for ``field``, ``component`` and ``frames``; ``scale`` 1 draws a tenth of the truss's
        extent as the largest displacement

    Returns
    -------
    The files written: poster, films, frames.

    Raises
    ------
    InputError
        As ``render``, and where the result has no such modes.
    """
    with opened(result_path) as result:
        frames = mode_frames(result, modes, period)
        folder = Path(output) if output is not None else Path(result.path).parent / "modes"
        count = len(frames.times)
        return render(frames, folder, field="amplitude", frames=count, **{"clim": (0.0, 1.0)} | options)


class Film:
    """Frames of results, side by side when there are several; all have the same number of frames.

    Parameters
    ----------
    results : open results
    options : what is drawn, and how
    note : receives messages

    Raises
    ------
    InputError
        For options that do not fit the results.
    """

    def __init__(self, results: Sequence[Any], options: Options, note: Callable[[str], None]) -> None:
        self.options, labels = options, options.labels
        if labels is not None and len(labels) != len(results):
            raise InputError(f"render: {len(labels)} labels for {len(results)} results; give one for each")
        self._labels = labels or [Path(result.path).absolute().parent.name for result in results]
        shown, chosen = _timed(results, options, note)
        self.count = len(chosen)
        self.colours = [ColourField(result, options.field, options.component) for result in shown]
        found = [options.clim] if options.clim is not None else [field.limits(chosen) for field in self.colours]
        low, high = min(pair[0] for pair in found), max(pair[1] for pair in found)
        limits = (-max(abs(low), abs(high)), max(abs(low), abs(high))) if options.symmetric else (low, high)
        if all(colour.rounded for colour in self.colours):
            note(f"{self.colours[0].title} is zero in all frames, to rounding")
        self.scale = ColourScale(limits, options.cmap, self.colours[0].unit)
        self.motions = [Motion(result, chosen, options, note) for result in shown]
        self.styles = [_style(options, result, note) for result in results]
        for motion, style in zip(self.motions, self.styles, strict=True):
            motion.reach = max(motion.reach, 0.0 if style.radius is None else float(style.radius.max(initial=0.0)))
        case = results[0].case
        self.title = options.title if options.title is not None else (case.title or case.name)
        self._scenes: list[Scene] = []

    def tell_length(self, note: Callable[[str], None]) -> None:
        """Say how long the film lasts where that is not what one expects."""
        rate, fps = self.options.rate, self.options.fps
        if rate is not None and self.motions[0].result.axis.unit == "s":
            slower = rate / fps
            pace = f"{slower:.3g} times slower" if slower >= 1.0 else f"{1.0 / slower:.3g} times faster"
            note(f"{self.count} frames last {self.count / fps:.1f} s: {pace} than simulated")
        elif self.options.kinds and self.count > 1 and self.count / fps < SHORT:
            slower = max(1, round(self.count / 5.0))
            lasts = f"the film of {self.count} frames lasts {self.count / fps:.1f} s"
            note(f"{lasts}; with fps = {slower} (--fps {slower}) it lasts {self.count / slower:.0f} s")

    def write(self, folder: Path, share: slice, note: Callable[[str], None]) -> None:
        """Draw a share of the frames into a folder."""
        self.start(self.options.size)
        told = time.monotonic()
        for number in range(self.count)[share]:
            if time.monotonic() - told > TELL:
                told = time.monotonic()
                # by all processes together
                note(f"{sum(1 for _ in folder.glob('frame_*.png'))} of {self.count} frames are drawn")
            save(self.frame(number), folder / f"frame_{number:04d}.png")

    def start(self, size: tuple[int, int]) -> None:
        """Prepare frames of a size."""
        several, columns = len(self.motions) > 1, 1
        if several:
            columns, _ = grid(len(self.motions), self._aspect(), Page.region_of(size)[2:])
        inset = self.options.inset is not None
        self._prepare(size, self._labels if several else [""], columns, inset)
        if inset:
            self._page.add_insets([motion.result for motion in self.motions], self.options.inset)

    def frame(self, number: int) -> np.ndarray:
        """Return a page (height, width, 3 or 4) uint8."""
        drawings = [self._draw(k, number) for k in range(len(self.motions))]
        motion, moments = self.motions[0], [motion.times[number] for motion in self.motions]
        time, acting = motion.time(motion.frames[number]), self._acting([number])
        return self._page.draw(drawings, self._cameras[0][number], time, moments, *acting)

    def poster(self) -> np.ndarray:
        """Return six instants on one page, in a grid that suits the shape of the motion."""
        size = self.options.size
        motion, several = self.motions[0], len(self.motions) > 1
        own = getattr(motion.result, "instants", None)
        wanted = max(2, _TILES // len(self.motions))
        chosen = instants(motion.result, motion.frames, wanted) if own is None else own(wanted)
        heads = [f"{label}, " if several else "" for label in self._labels]
        captions = [head + motion.time(frame) for head in heads for frame in chosen]
        columns, _ = grid(len(chosen), self._aspect(), Page.region_of(size)[2:])
        self._prepare(size, captions, len(chosen) if several else columns)
        numbers = [motion.frames.index(frame) for frame in chosen]
        drawings = [self._draw(k, number) for k in range(len(self.motions)) for number in numbers]
        return self._page.draw(drawings, self._cameras[0][0], "", (), *self._acting(numbers))

    def close(self) -> None:
        """Give the windows back."""
        for scene in self._scenes:
            scene.close()
        self._scenes = []

    def _prepare(self, size: tuple[int, int], captions: Sequence[str], columns: int, inset: bool = False) -> None:
        """Make page, cameras and scenes for a size in pixels and drawings with captions in columns."""
        self.close()
        options = self.options
        marks = [MARKS[mark] for mark in options.marks]
        heading = Heading(self.title, self.colours[0].title, self.scale, marks, self.notes, options.transparent)
        self._page = Page(size, heading, captions, columns, inset)
        tile = self._page.tile
        self._cameras = [cameras(options, motion, tile[0] / tile[1]) for motion in self.motions]
        if len(self.motions) > 1:
            self._cameras = at_one_scale(self._cameras)
        self._page.add_length_scale(self._cameras[0][0])
        _, _, width, height = Page.region_of(size)
        for motion, style, colour, film in zip(self.motions, self.styles, self.colours, self._cameras, strict=True):
            # lines of a small model stay visible in a tile; those of a large one would merge
            share = (tile[0] * tile[1] / (width * height)) ** (0.25 if motion.n_bars <= FEW else 0.5)
            unit = min(size[0] / 1280, size[1] / 720) * share
            closest = min(film, key=lambda camera: camera.half_height)  # widths are those of bars at the closest
            self._scenes.append(Scene(motion, closest, tile, style, colour.on_nodes, unit, options.transparent))

    def _draw(self, k: int, number: int) -> np.ndarray:
        motion, colour, scene, camera = self.motions[k], self.colours[k], self._scenes[k], self._cameras[k][number]
        frame = motion.frames[number]
        shades, layers = self.scale.colours(colour.values(frame)), motion.layers(frame, scene, camera)
        return scene.draw(motion.positions(frame), shades, camera, motion.surfaces[frame], motion.whole(frame), layers)

    def _acting(self, numbers: Sequence[int]) -> tuple[list[dict[str, np.ndarray]], list[str]]:
        """Return the directions of gravity and wind in each drawing of frames, and what is told of its loads."""
        found = [(motion.actions, number) for motion in self.motions for number in numbers]
        return (
            [{} if actions is None else actions.everywhere(number) for actions, number in found],
            ["" if actions is None else actions.longest(number) for actions, number in found],
        )

    @property
    def notes(self) -> list[str]:
        """What the foot of each picture says: of all results, then of one."""
        every = [motion.notes for motion in self.motions]
        shared = [note for note in every[0] if all(note in notes for notes in every)]
        own = zip(self._labels, every, strict=True)
        shared += [f"{label}: {note}" for label, notes in own for note in notes if note not in shared]
        factor, tubes = self.options.radius_scale, any(style.radius is not None for style in self.styles)
        return shared + ([f"radii × {factor:g}"] if tubes and factor != 1.0 else [])

    def _aspect(self) -> float:
        """Return the width of the motions over their height, in the picture, their mean."""
        found = []
        for motion in self.motions:
            look, points = cameras(self.options, motion, 1.0)[0], motion.surroundings
            across, along = (float(np.ptp(points @ way)) for way in (look.right, look.up))
            found.append(across / max(along, 1e-3 * across, 1e-300))
        return float(np.mean(found))


def _nothing(text: str) -> None:
    """Receive messages of processes that do not print."""


def _timed(results: Sequence[Any], options: Options, note: Callable[[str], None]) -> tuple[list[Any], list[int]]:
    """Return the results at common times, and the numbers of those that are drawn."""
    times = np.asarray(results[0].times, dtype=float)
    if len({result.axis.symbol for result in results}) > 1:
        names = ", ".join(dict.fromkeys(result.axis.symbol for result in results))
        raise InputError(f"render: the results are over different axes ({names}): draw them one by one")
    if any(len(result.times) == 0 for result in results):
        raise InputError("render: the result holds no snapshots; set [output] fields_every and run again")
    if options.rate is not None:
        if options.frames is not None:
            raise InputError("render: frames and rate both choose the frames; give one of the two")
        times = even_times(times, options.rate, options.span)
        return [resampled(result, times) for result in results], list(range(len(times)))
    chosen = chosen_frames(options.frames, times, note, options.span)
    return [results[0], *(resampled(result, times) for result in results[1:])], chosen


def instants(result: Any, frames: Sequence[int], count: int) -> list[int]:
    """Select snapshots at even distances, among them the first and the last; of load cases, their ends.

    Parameters
    ----------
    result : an open result
    frames : snapshots to choose from
    count : maximum number of snapshots, 2 or more
    """
    frames = sorted(set(frames))
    cases = [number for number, stage in enumerate(result.case.stage) if stage.starts_from is not None]
    if cases:
        number = stage_at(result.history, np.asarray(result.times)[frames])
        frames = [frames[np.flatnonzero(number == k)[-1]] for k in cases if k in number] or frames
    return [frames[k] for k in even_rows(len(frames), count)]


def _helpers(paths: Sequence[Any], folder: Path, options: Options, count: int) -> list[subprocess.Popen]:
    """Start processes that draw the other shares of a long film; each has one thread.

    They read the results again, so that there are none for results that are open already, nor under ``mpirun``.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    processes = min(cores, count // SHARE)
    if processes < 2 or launched_rank() is not None or not all(isinstance(path, (str, os.PathLike)) for path in paths):
        return []
    few_threads()
    code = "from pfem_petsc.post.render import _help; _help()"
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "env": dict(os.environ)}
    helpers = []
    for number in range(1, processes):
        helpers.append(subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, **quiet))
        order = [Path(path) for path in paths], folder, options, slice(number, None, processes)
        with helpers[-1].stdin as channel:
            pickle.dump(order, channel)
    return helpers


def _help() -> None:
    """Draw the share of the frames that the process that started this one has written to the input."""
    paths, folder, options, share = pickle.loads(sys.stdin.buffer.read())
    with ExitStack() as stack:
        film = Film([stack.enter_context(opened(path)) for path in paths], options, _nothing)
        film.write(folder / "frames", share, _nothing)
        film.close()


def save(picture: np.ndarray, file: Path) -> Path:
    """Write a picture (height, width, 3 or 4) uint8 as PNG; return the file.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    from PIL import Image

    with written(file, "the picture"):
        # fast compression, because a film has hundreds of frames
        Image.fromarray(picture).save(file, format="PNG", compress_level=1)
    return file


def encode(pattern: Path, target: Path, fps: float) -> Path:
    """Encode pictures to a film.

    Parameters
    ----------
    pattern : path with a ``%04d`` for the number, from 0
    target : ``.mp4`` (H.264, yuv420p), ``.gif`` (at most 800 pixels wide), ``.webm`` (VP9, with transparency) or
        ``.webp`` (at most 960 pixels wide, with transparency)
    fps : pictures per second

    Raises
    ------
    InputError
        If ffmpeg cannot be found or fails, with the last line of its output.
    """
    import imageio_ffmpeg

    try:
        program = imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError as error:
        raise InputError(
            f"{target}: no ffmpeg for the film ({error}); install imageio-ffmpeg, or use video = none"
        ) from error
    command = [program, "-y", "-loglevel", "error", "-framerate", f"{fps:g}", "-i", str(pattern)]
    command += [*_ENCODERS[target.suffix.lstrip(".")], str(target)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        last = done.stderr.strip().splitlines()[-1:] or ["no message"]
        raise InputError(f"{target}: ffmpeg failed ({last[0]}); the pictures are in {pattern.parent}")
    return target


_WIDTHS = ((300, 3.0), (20_000, 1.8))  # least widths of bars in pixels, by the number of bars
_CONFIG = {"displaylogo": False, "scrollZoom": True}
_SHAPES = 5  # from the initial one to that of the snapshot; of large models two


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
    from matplotlib.colors import to_hex

    motion, colour, scale = film.motions[0], film.colours[0], film.scale
    frame, camera = motion.frames[0], cameras(film.options, motion, 1.6)[0]
    style, left, values = film.styles[0], motion.whole(frame), colour.values(frame)
    bars, shown = motion.bars[left], scale.factor * (values[motion.bars] if colour.on_nodes else values[:, None])
    shown = np.broadcast_to(shown, motion.bars.shape)[left]
    least = next((width for most, width in _WIDTHS if motion.n_bars <= most), 1.2)
    shares = np.linspace(0.0, 1.0, _SHAPES if motion.n_bars <= TUBE_LIMIT else 2)
    shapes = [(motion.start + share * (motion.positions(frame) - motion.start))[bars] for share in shares]
    label = colour.title + (f" [{scale.unit}]" if scale.unit else "")
    low, high = scale.shown.get_clim()
    shades: dict[str, Any] = {
        "colorscale": [to_hex(colour) for colour in scale.shown.cmap(np.linspace(0.0, 1.0, 16))],
        "cmin": low,
        "cmax": high,
        "colorbar": {"title": {"text": label.replace(" ", "<br>", 1)}, "len": 0.7, "thickness": 20},
    }
    look: dict[str, Any] = {"hoverinfo": "skip"}
    if style.radius is not None:
        both = np.repeat(np.maximum(style.radius[left], least * camera.half_height / 720)[:, None], 2, axis=1)
        made = [tubes(lines, both, 6, False, value=shown)[0].triangulate() for lines in shapes]
        places, trace = [np.asarray(mesh.points).T for mesh in made], plotly.Mesh3d
        look |= dict(zip("ijk", made[0].regular_faces.T, strict=True)) | {"intensity": made[0]["value"], **shades}
        look |= {"lighting": {"ambient": 0.8, "diffuse": 0.25, "specular": 0.0}}
    else:
        # a line ends where a number is missing
        places = [np.insert(lines, 2, np.nan, axis=1).reshape(-1, 3).T for lines in shapes]
        between, trace = np.insert(shown, 2, 0.0, axis=1).ravel(), plotly.Scatter3d
        look |= {"mode": "lines", "line": {"color": between, "width": 2.0 * least, **shades}}
    traces = [dict(zip("xyz", x, strict=True)) for x in places]
    walls = [_wall(plotly, surface) for surface in motion.surfaces[frame]]
    figure = plotly.Figure([trace(**traces[-1], **look), *walls])
    figure.frames = [
        plotly.Frame(name=f"{share:.2f}", data=[trace(**shape)], traces=[0])
        for share, shape in zip(shares, traces, strict=True)
    ]
    now = {"mode": "immediate", "frame": {"duration": 0, "redraw": True}, "transition": {"duration": 0}}
    choices = [{"label": each.name, "method": "animate", "args": [[each.name], now]} for each in figure.frames]
    hidden, told = {"visible": False}, ", ".join([motion.time(frame), *film.notes])
    figure.update_layout(
        title={"text": f"<b>{html.escape(film.title)}</b><br>{html.escape(told)}", "x": 0.01},
        margin={"l": 0, "r": 0, "t": 60, "b": 20},
        showlegend=False,
        sliders=[
            {"active": len(shares) - 1, "steps": choices, "len": 0.5, "x": 0.03, "currentvalue": {"prefix": "shape: "}}
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


def _wall(plotly: Any, surface: Any) -> Any:
    """Return the face of a wall that nodes touch."""
    import pyvista

    touched = (np.asarray(surface.depth)[surface.faces] == 0.0).all(axis=1)
    face = pyvista.PolyData.from_regular_faces(surface.points, surface.faces[touched]).triangulate()
    places = dict(zip("xyzijk", (*face.points.T, *face.regular_faces.T), strict=True))
    shade = "rgb({},{},{})".format(*WALL_COLOUR)
    return plotly.Mesh3d(**places, color=shade, opacity=0.35, hoverinfo="skip")

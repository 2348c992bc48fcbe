"""Cameras, at rest or moving, and the one renderer: bars, walls and lines, drawn by VTK without a display."""

from __future__ import annotations

import functools
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from ..contact.walls.base import Surface
from ..errors import InputError

VIEWS = ("auto", "xy", "xz", "yz", "iso", "front", "back", "left", "right", "top", "bottom")

_X, _Y, _Z = (tuple(row) for row in np.eye(3).tolist())
_FLAT = {  # direction from the structure to the eye, and the upward direction
    "xy": (_Z, _Y),
    "xz": ((0.0, -1.0, 0.0), _Z),
    "yz": (_X, _Z),
    "front": ((0.0, -1.0, 0.0), _Z),
    "back": (_Y, _Z),
    "left": ((-1.0, 0.0, 0.0), _Z),
    "right": (_X, _Z),
    "top": (_Z, _Y),
    "bottom": ((0.0, 0.0, -1.0), _Y),
}
_OPENING = 25.0  # degrees, vertical


@dataclass(frozen=True)
class Camera:
    """Position and orientation of the camera.

    Parameters
    ----------
    towards, up, right : (3,) unit vectors: from the structure to the eye, and the picture's axes
    centre : (3,) [m], the point in the middle of the picture
    distance : [m], from the centre to the eye
    half_height : [m], half of the vertical extent of the picture, at the centre
    parallel : whether there is no perspective
    """

    towards: np.ndarray
    up: np.ndarray
    right: np.ndarray
    centre: np.ndarray
    distance: float
    half_height: float
    parallel: bool

    def zoomed(self, factor: float) -> Camera:
        """Return the camera that shows what is in the middle larger by a factor."""
        return replace(self, half_height=self.half_height / factor, distance=self.distance / factor)

    def ahead(self, points: np.ndarray) -> np.ndarray:
        """Return the direction (3,) or directions (n, 3) from points (n, 3) [m] to the eye."""
        return self.towards if self.parallel else self.centre + self.distance * self.towards - points

    def metres(self, points: np.ndarray) -> np.ndarray:
        """Return the vertical extent (n,) [m] of the picture at points (n, 3) [m], zero behind the eye."""
        depth = 0.0 if self.parallel else (points - self.centre) @ self.towards / self.distance
        return 2.0 * self.half_height * np.maximum(0.0, 1.0 - depth) * np.ones(len(points))


def direction(
    view: str | Sequence[float], bounds: np.ndarray, normals: Sequence[np.ndarray], upward: Sequence[float]
) -> tuple[np.ndarray, np.ndarray, bool]:
    """Return the direction to the eye (3,), the upward direction (3,), and whether there is no perspective.

    Parameters
    ----------
    view : one of :data:`VIEWS`, or the direction (3,) from the structure to the eye
    bounds : (2, 3) [m], bounds of the structure's motion, from which ``"auto"`` determines whether it is flat
    normals : allowed sides of the walls; the oblique view looks at walls from there
    upward : upward direction of the oblique view

    Raises
    ------
    InputError
        For an unknown view.
    """
    up = np.asarray(upward, dtype=float)
    if not isinstance(view, str):
        towards = np.asarray(view, dtype=float)
        size = float(np.linalg.norm(towards)) if towards.shape == (3,) else 0.0
        if not (size > 0.0 and np.isfinite(size)):
            raise InputError(f"render: view = {view!r} is not a direction; give three numbers that are not all zero")
        towards = towards / size
        if np.linalg.norm(np.cross(up, towards)) < 1e-3:
            up = np.eye(3)[(int(np.argmax(np.abs(up))) + 2) % 3]
        return towards, up, False
    if view not in VIEWS:
        raise InputError(f"render: view = {view!r} is not known; it is one of {', '.join(VIEWS)}, or a direction x,y,z")
    if view == "auto":
        extent = bounds[1] - bounds[0]
        flat = extent <= 1e-6 * max(extent.max(), 1e-300)
        view = next((name for axis, name in ((2, "xy"), (1, "xz"), (0, "yz")) if flat[axis]), "iso")
    if view in _FLAT:
        towards, up = (np.array(vector) for vector in _FLAT[view])
        return towards, up, True
    return _oblique(normals, up), up, False


def _oblique(normals: Sequence[np.ndarray], upward: np.ndarray) -> np.ndarray:
    """Return the direction of the eye: slightly from above, from the quadrant that sees most walls from the front."""
    first = np.array(_X if abs(upward[0]) < 0.9 else _Y)
    second = np.cross(upward, first)
    # -second points towards the viewer in a right-handed picture, the default quadrant
    quarters = [a * first + b * second for b in (-1.3, 1.3) for a in (0.9, -0.9)]
    quarters += [1.3 * a * first + 0.9 * b * second for b in (-1.0, 1.0) for a in (1.0, -1.0)]
    directions = [(each + 0.65 * upward) / np.linalg.norm(each + 0.65 * upward) for each in quarters]
    seen = [sum(min(0.3, float(normal @ each)) for normal in normals) for each in directions]
    return directions[int(np.argmax(np.round(seen, 6)))]


def fit(
    points: np.ndarray,
    way: tuple[np.ndarray, np.ndarray, bool],
    aspect: float,
    margin: float = 1.05,
    centre: np.ndarray | None = None,
    reach: float = 0.0,
) -> Camera:
    """Return the camera in a direction that has all points (n, 3) [m] in view.

    Parameters
    ----------
    way : of :func:`direction`
    aspect : width over height of the picture
    margin : factor on the visible extent
    centre : (3,) [m], what is in the middle of the picture; None: the middle of the points
    reach : [m], how far pictures of points extend around them
    """
    towards, up, parallel = way
    right = np.cross(up, towards)
    right = right / np.linalg.norm(right)
    up = np.cross(towards, right)
    axes = np.stack([right, up, towards])
    spans = points @ axes.T
    middle = 0.5 * (spans.min(axis=0) + spans.max(axis=0)) if centre is None else axes @ centre
    across, along, deep = np.abs((spans - middle).T) + reach
    centre = middle @ axes
    high = np.maximum(along, across / aspect) * margin
    half = float(high.max()) or 1.0
    if parallel:
        return Camera(towards, up, right, centre, 10.0 * (half * max(1.0, aspect) + 2.0 * deep.max()), half, True)
    # with perspective each point requires its own distance, larger for nearer points
    slope = np.tan(np.radians(_OPENING) / 2)
    distance = float((high / slope + (spans - middle)[:, 2] + reach).max()) or 1.0
    return Camera(towards, up, right, centre, distance, distance * slope, False)


def cameras(options: Any, motion: Any, aspect: float) -> list[Camera]:
    """Return the camera of each frame of a motion; all have the same scale.

    Parameters
    ----------
    options : ``view``: name of a view, or the direction (3,) from the structure to the eye; ``zoom``: factor on the
        size in the picture; ``orbit``: angle [degrees] that the camera goes around the upward direction from the first
        frame to the last; ``follow``: "structure" or the name of a probe that stays in the middle of the picture
    motion : of the film
    aspect : width of the picture over its height
    """
    way = towards, up, parallel = direction(options.view, motion.bounds, motion.normals, motion.upward)
    points, reach, count = motion.surroundings, motion.reach, len(motion.frames)
    if not options.orbit and options.follow is None:
        return [fit(points, way, aspect, reach=reach).zoomed(options.zoom)] * count
    ways = [way] * count
    if options.orbit:
        from scipy.spatial.transform import Rotation

        turns = np.linspace(0.0, np.radians(options.orbit), count)[:, None] * up / np.linalg.norm(up)
        ways = [(each, up, parallel) for each in Rotation.from_rotvec(turns).apply(towards)]
    if options.follow is None:
        centre = motion.bounds.mean(axis=0)
        made = [fit(points, way, aspect, centre=centre, reach=reach) for way in ways]
    else:
        centres = motion.boxes.mean(axis=1) if options.follow == "structure" else motion.probe(options.follow)
        held = zip(ways, motion.hulls, centres, strict=True)
        made = [fit(hull, way, aspect, margin=1.25, centre=centre, reach=reach) for way, hull, centre in held]
    (made,) = at_one_scale([made])
    return [camera.zoomed(options.zoom) for camera in made]


def at_one_scale(films: list[list[Camera]]) -> list[list[Camera]]:
    """Return the cameras of films with the smallest scale of all, so that sizes can be compared."""
    every = [camera for film in films for camera in film]
    half, distance = max(camera.half_height for camera in every), max(camera.distance for camera in every)
    return [[replace(camera, half_height=half, distance=distance) for camera in film] for film in films]


TUBE_LIMIT = 20_000
"""Number of bars up to which bars are drawn as tubes of their radii; more are lines."""
FEW = 2000
"""Bars of a small model."""

WALL_COLOUR, EDGE_COLOUR, NODE_COLOUR = (116, 125, 138), (75, 85, 99), (31, 36, 44)
VARIABLE = "VTK_DEFAULT_OPENGL_WINDOW"

_ANYWHERE = np.array([0.36, 0.48, 0.8])
_STOUT = 16.0  # pixels: width from which bars show their ends themselves, without dots at nodes
_ROUND = 2.5  # pixels: radius from which a bar has a round surface; thinner ones are flat
# Crossing bars are told apart by their rims, where the surface faces the eye with a cosine below the first number: the
# outer 12 % of the radius. Between, colours are those of the field. The share of black at the edge grows with the width
# of bars [pixels], so that thin ones keep their colour.
_RIM, _BLACK, _WIDTHS = 0.48, (0.45, 0.75), (2.0, 6.0)
_MOST_PIXELS = (1.5e6, 1e7)  # up to which 3 x 3 (small models) and 2 x 2 pixels are averaged to one

# Nothing is shown, so a display is not tried first: it may be closed, or remote over ssh.
_HEADLESS = ("vtkEGLRenderWindow", "vtkOSOpenGLRenderWindow")

# Draw a red square if there is a library: a crash, a hang or an empty image all count as "does not work". So
# does a window of another kind than asked for, which VTK takes where the library is missing, with warnings each time.
_PROBE = """
import os
import vtkmodules.vtkRenderingOpenGL2
from vtkmodules.vtkRenderingCore import vtkRenderer, vtkRenderWindow, vtkWindowToImageFilter
renderer, window, grab = vtkRenderer(), vtkRenderWindow(), vtkWindowToImageFilter()
renderer.SetBackground(1, 0, 0)
window.SetOffScreenRendering(1)
window.SetSize(16, 16)
window.AddRenderer(renderer)
window.Render()
assert os.environ.get("VTK_DEFAULT_OPENGL_WINDOW") in (None, window.GetClassName())
grab.SetInput(window)
grab.Update()
assert grab.GetOutput().GetPointData().GetScalars().GetTuple(100)[0] > 200
print("drawn")
"""


def _works(window: str | None) -> bool:
    environment = dict(os.environ) if window is None else {**os.environ, VARIABLE: window}
    try:
        probe = subprocess.run(
            [sys.executable, "-c", _PROBE], env=environment, capture_output=True, text=True, timeout=60, check=False
        )
    except subprocess.TimeoutExpired:
        return False
    return probe.returncode == 0 and "drawn" in probe.stdout


@functools.cache
def require_rendering() -> None:
    """Ensure that VTK can draw in this process, with EGL or OSMesa, whichever works: without a library it would crash.

    The user's choice in ``VTK_DEFAULT_OPENGL_WINDOW`` is tried first, the default of VTK last. Call this before the
    first render window.

    Raises
    ------
    InputError
        If no OpenGL library works; the message states what to install.
    """
    own = [os.environ[VARIABLE]] if VARIABLE in os.environ else []
    for window in [*own, *_HEADLESS, None]:
        if _works(window):
            if window is not None:
                os.environ[VARIABLE] = window
            return
    raise InputError(
        "render: no OpenGL library works here, so nothing can be drawn; install one that needs no display "
        "(Debian, Ubuntu: apt-get install libosmesa6, or libegl1 libgl1-mesa-dri; conda: mesalib)"
    )


def few_threads() -> None:
    """Have the software renderer use one thread in this process and those that it starts, if no window is open yet."""
    os.environ.setdefault("LP_NUM_THREADS", "0")  # in the thread that draws


def _form(kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (m, 4) of a bar and its cells (c, 2 or 4).

    A point is (end, along, across, facing): ``x[end] + radius (along a + across u + facing v)`` with the direction a of
    the bar, u across it and the view, and v towards the eye. A ``line`` is two points, a ``strip`` faces the eye, a
    ``ribbon`` does so between two rims, a ``prism`` has open ends, and ``round`` bars and ``rough`` ones, of fewer
    sides, are cylinders with half a sphere at each end. Nothing is lit: colours do not depend on where a bar is.
    """
    if kind == "line":
        return np.array([[0.0, 0, 0, 0], [1, 0, 0, 0]]), np.array([[0, 1]])
    if kind == "ribbon":
        wide, high = np.array([-1.0, -0.8, 0.8, 1.0]), np.array([0.0, 0.6, 0.6, 0.0])
        points = [[end, 0.0, a, b] for end in (0.0, 1.0) for a, b in zip(wide, high, strict=True)]
        return np.array(points), np.array([[k, k + 1, k + 5, k + 4] for k in range(3)])
    if kind == "strip":
        return np.array([[0.0, 0, -1, 0], [0, 0, 1, 0], [1, 0, 1, 0], [1, 0, -1, 0]]), np.array([[0, 1, 2, 3]])
    sides, rings = {"round": (20, 5), "rough": (8, 2), "prism": (6, 1)}[kind]
    angle, height = 2.0 * np.pi * np.arange(sides) / sides, np.linspace(-np.pi / 2, 0.0, rings)
    height[-1] = 0.0
    levels = [(0.0, level) for level in height] + [(1.0, -level) for level in height[::-1]]
    points = [
        [end, np.sin(level), np.cos(level) * np.cos(turn), np.cos(level) * np.sin(turn)]
        for end, level in levels
        for turn in angle
    ]
    here = np.arange(sides * (len(levels) - 1)).reshape(-1, sides)
    beside = np.roll(here, -1, axis=1)
    return np.array(points), np.stack([here, here + sides, beside + sides, beside], axis=-1).reshape(-1, 4)


class Segments:
    """Bars as one PolyData in a plotter of pyvista, whose points and colours change in place.

    Its points are in the order of the points of a form, and of the bars for each of these.

    Parameters
    ----------
    plotter : of pyvista; None: the mesh is in none
    ends : (b, 2) int, nodes
    kind : see :func:`_form`
    on_nodes : whether colours are those of nodes, and not of bars
    width : of lines, in pixels of the window

    Attributes
    ----------
    mesh : the PolyData
    ends : (2, b) int, the nodes at both ends
    rows : (p,) int, the node or the bar whose colour each point of the mesh has
    """

    def __init__(self, plotter: Any, ends: np.ndarray, kind: str, on_nodes: bool, width: float = 1.0) -> None:
        import pyvista

        form, cells = _form(kind)
        self.ends = np.ascontiguousarray(np.transpose(ends), dtype=np.int64)
        self._end, self._form, count = form[:, 0].astype(int), form[:, 1:].astype(np.float32), len(ends)
        self._colour_rows = self.ends if on_nodes else np.stack([np.arange(count)] * 2)
        self.rows = self._colour_rows[self._end].ravel()
        kept = pyvista.CellArray.from_regular_cells(
            (count * cells + np.arange(count)[:, None, None]).reshape(-1, cells.shape[1])
        )
        places = np.zeros((count * len(form), 3), dtype=np.float32)
        self.mesh = pyvista.PolyData(places, lines=kept) if kind == "line" else pyvista.PolyData(places, faces=kept)
        self.mesh.point_data["colour"] = np.zeros(places.shape, dtype=np.uint8)
        if plotter is not None:
            options: dict[str, Any] = {"scalars": "colour", "rgb": True, "preference": "point", "line_width": width}
            self.actor = plotter.add_mesh(self.mesh, lighting=False, reset_camera=False, render=False, **options)

    def move(
        self,
        points: np.ndarray,
        radius: np.ndarray,
        colours: np.ndarray | None = None,
        ahead: np.ndarray = _ANYWHERE,
        black: np.ndarray | float = 0.0,
    ) -> None:
        """Draw bars between points.

        Parameters
        ----------
        points : (n, 3) [m]
        radius : (b,), or (2, b) at both ends [m]; negative: the bar is not drawn
        colours : (n or b, 3) uint8
        ahead : (3,), or (n, 3) at each node: the direction to the eye
        black : (b,), the share of black at the rim
        """
        # single precision, component by component: passes over a million bars
        first, last = ends = np.stack([x.astype(np.float32)[self.ends] for x in points.T], axis=1)
        shape = len(self._end), -1, 3
        axis = _unit(last - first)
        towards = np.broadcast_to(ahead, points.shape).astype(np.float32).T
        eye = _unit(np.stack([x[self.ends[0]] for x in towards]))
        side = np.cross(axis, eye, axis=0)
        along = np.flatnonzero((side**2).sum(axis=0) < 1e-10)  # seen along its axis: any direction is across
        side[:, along] = np.cross(axis[:, along], np.eye(3)[:, np.abs(axis[:, along]).argmin(axis=0)], axis=0)
        side = _unit(side)
        facing = np.cross(side, axis, axis=0)
        wide = np.broadcast_to(radius, self.ends.shape).astype(np.float32)
        if (hidden := wide[0] < 0.0).any():
            wide[:, hidden], last[:, hidden] = 0.0, first[:, hidden]
        places, ways = self.mesh.points.reshape(shape), np.stack([axis, side, facing], axis=1)
        for k in range(3):
            places[..., k] = ends[self._end, k] + wide[self._end] * (self._form @ ways[k])
        if colours is None:
            return
        left: Any = 1.0
        if np.any(black):  # at the edge, the surface is seen along itself
            facing = np.maximum(self._form @ np.einsum("kjb,kb->jb", ways, eye), self._form[:, 2:])
            left = 1.0 - np.asarray(black, dtype=np.float32) * np.clip(1.0 - facing / _RIM, 0.0, 1.0)
        shades = self.mesh.point_data["colour"].reshape(shape)
        for k in range(3):
            ink = colours[:, k].astype(np.float32)[self._colour_rows]
            shades[..., k] = (ink[self._end] * left + 0.5).astype(np.uint8)


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Return vectors (3, b) over their lengths, and the x axis for those that have none."""
    length = np.sqrt((vectors**2).sum(axis=0))
    none = length == 0.0
    made = vectors / np.where(none, 1.0, length)
    made[0, none] = 1.0
    return made


@dataclass(frozen=True)
class Style:
    """How bars are drawn.

    Parameters
    ----------
    tubes : whether bars have the radii of their sections
    radius : (b,) [m] of the bars; None: not known
    bar_width : of bars without radii, and the least width of tubes, in pixels; None: by the size of the model
    nodes : whether to draw nodes as balls; None: for small models
    rims : whether bars that are wide enough have dark rims
    """

    tubes: bool
    radius: np.ndarray | None = field(default=None, repr=False)
    bar_width: float | None = None
    nodes: bool | None = None
    rims: bool = True


class Layer(NamedTuple):
    """Lines in addition to the bars.

    Attributes
    ----------
    points : (n, 3) [m]
    lines : (m, 2) int
    colour : red, green, blue
    width : in pixels of a picture of 1280 by 720
    shift : how much nearer to the eye than their points they are, in such pixels
    radius : (m,) [m], if they are as wide as bars and the width more
    """

    points: np.ndarray
    lines: np.ndarray
    colour: tuple[int, int, int]
    width: float
    shift: float = 0.0
    radius: np.ndarray | float = 0.0


class Scene:
    """A picture of bars without text, which can be drawn repeatedly.

    Parameters
    ----------
    motion : has the nodes of the first snapshot (``start``), ``bars``, and the ``bounds`` of the motion, for depth
    camera : a camera at the distance of those of all frames
    size : width and height in pixels
    style : how bars are drawn
    on_nodes : whether colours are those of nodes
    unit : pixels for each pixel of a page of 1280 by 720
    transparent : whether the background is; else it is white
    """

    def __init__(
        self,
        motion: Any,
        camera: Camera,
        size: tuple[int, int],
        style: Style,
        on_nodes: bool = False,
        unit: float = 1.0,
        transparent: bool = False,
    ) -> None:
        require_rendering()
        import pyvista

        self._bars, self.size, self.unit, count = motion.bars, size, unit, len(motion.bars)
        # more pixels than asked for are drawn and averaged, for smooth edges
        area = size[0] * size[1]
        self._factor = 3 if count <= FEW and area <= _MOST_PIXELS[0] else 2 if area <= _MOST_PIXELS[1] else 1
        pixels = size[1] / (2.0 * camera.half_height)
        lengths = pixels * np.linalg.norm(np.diff(motion.start[self._bars], axis=1)[:, 0], axis=1)
        shortest = float(np.quantile(lengths, 0.1)) if count else 1.0
        self.width = style.bar_width or _width(count, lengths, shortest, unit)
        self._radius = np.zeros(count) if not style.tubes or style.radius is None else np.asarray(style.radius, float)
        # at each node one of the widest bars has its end, and the others taper into it: equal ends would be speckled
        order, ends = np.argsort(-np.tile(self._radius, 2), kind="stable"), self._bars.T.ravel()
        self._apart = np.full(2 * count, 0.98)
        self._apart[order[np.unique(ends[order], return_index=True)[1]]] = 1.0
        self._corners = np.array(np.meshgrid(*motion.bounds.T)).reshape(3, -1).T
        window = [side * self._factor for side in size]
        self._plotter = pyvista.Plotter(off_screen=True, window_size=window, lighting="none")
        self._plotter.disable_anti_aliasing()
        self._plotter.renderer.SetUseOIT(False)  # walls are drawn in their order
        self._plotter.background_color = "black" if transparent else "white"
        self._plotter.screenshot(return_img=True)  # the first one draws by itself, and chooses a camera
        self._transparent = transparent
        thick = max(self.width, 2.0 * pixels * float(np.quantile(self._radius, 0.9)) if count else 0.0)
        solid = style.rims and (count <= FEW or (thick >= 2.0 * _ROUND * unit and count <= TUBE_LIMIT))
        if solid:
            kind = "round" if thick >= 2.0 * _ROUND * unit and count <= FEW else "rough"
        else:
            many = "strip" if style.tubes else "line"
            kind = many if count > TUBE_LIMIT else "ribbon" if style.rims else "strip"
        self._rims = kind not in ("line", "strip")
        self.segments = Segments(self._plotter, self._bars, kind, on_nodes, self.width * self._factor)
        few = count <= 400 and shortest > 3.0 * self.width and thick < _STOUT * unit
        nodes = few if style.nodes is None else style.nodes
        self._nodes = self._balls() if nodes else None
        self._extra: list[Any] = []
        self._outline = max(1.2, 1.0 / unit)  # of marked bars: a pixel at least

    def _balls(self) -> tuple[Segments, np.ndarray]:
        """Return nodes as bars without length, and the radii of the widest bars there."""
        used, radius = np.unique(self._bars), np.zeros(int(self._bars.max(initial=-1)) + 1)
        np.maximum.at(radius, self._bars, self._radius[:, None])
        balls = Segments(self._plotter, np.stack([used, used], axis=1), "round", False)
        balls.mesh.point_data["colour"][:] = NODE_COLOUR
        return balls, radius[used]

    def close(self) -> None:
        """Give the window back."""
        self._plotter.close()

    def draw(
        self,
        points: np.ndarray,
        colours: np.ndarray,
        camera: Camera,
        surfaces: Sequence[Surface] = (),
        gone: np.ndarray | None = None,
        layers: Sequence[Layer] = (),
    ) -> np.ndarray:
        """Draw a frame.

        Parameters
        ----------
        points : (n, 3) float64 [m]
        colours : (n, 3) or (b, 3) uint8
        camera : of this frame
        surfaces : walls
        gone : (b,) bool, bars that are left out
        layers : lines in addition to the bars

        Returns
        -------
        (height, width, 3) uint8, or (height, width, 4) with a transparent background
        """
        from PIL import Image

        self._plotter.remove_actor(self._extra, reset_camera=False, render=False)
        pixel = camera.metres(points) / self.size[1]
        radius = np.maximum(self._radius, 0.5 * self.width * pixel[self.segments.ends]) * self._apart.reshape(2, -1)
        if gone is not None:
            radius[:, gone] = -1.0
        ahead = camera.ahead(points)
        black = 0.0
        if self._rims:
            wide = 2.0 * radius[0] / np.maximum(pixel[self.segments.ends[0]], 1e-300) / self.unit
            black = np.interp(wide, _WIDTHS, _BLACK)
        self.segments.move(points, radius, colours, ahead, black)
        if self._nodes is not None:  # dots on the bars, half as wide
            balls, sizes = self._nodes
            rows = balls.ends[0]
            sizes = np.maximum(sizes, 0.5 * self.width * pixel[rows])
            dots = points.copy()
            dots[rows] += 2.2 * sizes[:, None] * np.transpose(_unit(np.broadcast_to(ahead, points.shape)[rows].T))
            balls.move(dots, np.maximum(0.5 * sizes, 1.3 * self.unit * pixel[rows]))
        self._extra = [self._add(layer, camera) for layer in layers if len(layer.lines)]
        self._extra += self._add_walls(surfaces, camera)
        eye = camera.centre + camera.distance * camera.towards
        self._plotter.camera_position = [eye, camera.centre, camera.up]
        view = self._plotter.camera
        view.parallel_projection, view.parallel_scale = camera.parallel, camera.half_height
        view.view_angle = 2.0 * np.degrees(np.arctan2(camera.half_height, camera.distance))
        self._plotter.renderer.ResetCameraClippingRange()
        self._plotter.render_window.Render()  # which a screenshot does not
        made = np.asarray(self._plotter.screenshot(return_img=True, transparent_background=self._transparent))
        if self._transparent:  # colours over nothing are multiplied by their opacity
            alpha = made[..., 3:]
            colours = np.minimum(255 * made[..., :3].astype(np.uint16) // np.maximum(alpha, 1), 255)
            made = np.concatenate([colours.astype(np.uint8), alpha], axis=2)
        return np.array(Image.fromarray(made).reduce(self._factor))

    def thickness(self, camera: Camera) -> float:
        """Return the width of the widest bar, in pixels of a page of 1280 by 720."""
        pixels = self.size[1] / (2.0 * camera.half_height)
        return max(self.width, 2.0 * pixels * float(self._radius.max(initial=0.0))) / self.unit

    def rim(self, points: np.ndarray, bars: np.ndarray, colour: tuple[int, int, int]) -> Layer:
        """Return a layer that outlines bars (numbers) by a pixel or so."""
        width = self.width / self.unit + 2.0 * self._outline
        return Layer(points, self._bars[bars], colour, width, -1.0, self._radius[bars])

    def _add(self, layer: Layer, camera: Camera) -> Any:
        pixel = 2.0 * camera.half_height / self.size[1] * self.unit
        points, ahead = np.asarray(layer.points, dtype=float), camera.ahead(np.asarray(layer.points, dtype=float))
        far = np.linalg.norm(ahead, axis=-1, keepdims=True)  # along the ray, so that it is seen at the same place
        points = points + np.minimum(layer.shift * pixel / far, np.inf if camera.parallel else 0.6) * ahead
        made = Segments(self._plotter, layer.lines, "strip", False)
        least = max(0.5 * layer.width * self.unit, 0.4) * camera.metres(points)[made.ends] / self.size[1]
        radius = layer.radius + self._outline * pixel if np.any(layer.radius) else 0.0
        made.mesh.point_data["colour"][:] = layer.colour
        made.move(points, np.maximum(radius, least), ahead=camera.ahead(points))
        return made.actor

    def _add_walls(self, surfaces: Sequence[Surface], camera: Camera) -> list[Any]:
        """Draw walls, which one sees through and which fade out behind, and their edges, from the farthest to the
        nearest."""
        import pyvista

        actors = []
        # without perspective, walls are behind all bars, so that they hide none
        depth = 4.0 * np.linalg.norm(np.ptp(self._corners, axis=0)) if camera.parallel else 0.0
        for surface in sorted(surfaces, key=lambda each: float((np.asarray(each.points) @ camera.towards).mean())):
            points, faces = np.asarray(surface.points, dtype=float) - depth * camera.towards, np.asarray(surface.faces)
            normal = np.cross(*np.diff(points[faces[0]][:3], axis=0))
            facing = float(normal @ camera.towards) > 1e-12 * float(np.linalg.norm(normal))
            # a wall between the eye and the structure must be transparent
            strength = 150 if camera.parallel else 110 if facing else 12
            order = np.argsort((points @ camera.towards)[faces].mean(axis=1), kind="stable")
            mesh = pyvista.PolyData.from_regular_faces(points.astype(np.float32), faces[order])
            opacity = strength * (1.0 - np.clip(np.asarray(surface.depth), 0.0, 1.0))
            shade = np.column_stack([np.tile(WALL_COLOUR, (len(points), 1)), opacity]).astype(np.uint8)
            options: dict[str, Any] = {"reset_camera": False, "render": False, "lighting": False}
            actors.append(self._plotter.add_mesh(mesh, scalars=shade, rgb=True, **options))
            actors[-1].ForceTranslucentOn()
            if len(surface.edge):
                actors.append(self._add(Layer(points, np.asarray(surface.edge), EDGE_COLOUR, 1.8), camera))
        return actors


def _width(count: int, lengths: np.ndarray, shortest: float, unit: float) -> float:
    """Return a width in pixels that shows the bars, and does not merge the chords of a slender truss."""
    least = float(np.clip(3.8 * (300.0 / max(count, 1)) ** 0.25, 1.2, 4.2))
    if count <= TUBE_LIMIT:
        least = min(least, max(2.4, 0.75 * shortest / unit))
    wish = min(0.11 * float(lengths.mean()) if count else 1.0, 0.4 * shortest)
    return float(np.clip(wish, least * unit, 6.0 * unit))

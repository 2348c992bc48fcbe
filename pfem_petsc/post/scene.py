"""Cameras, at rest or moving, and the one renderer: bars, walls and lines, drawn by VTK without a display."""

from __future__ import annotations

import functools
import math
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..contact.walls.base import Surface
from ..errors import InputError

if TYPE_CHECKING:
    import pyvista

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
    second = np.cross(upward, first)  # which points away from the viewer of a right-handed picture
    faced = np.sum([np.zeros(3), *normals], axis=0)
    way = (0.9 if faced @ first > -1e-6 else -0.9) * first + (1.3 if faced @ second > 1e-6 else -1.3) * second
    way += 0.65 * upward
    return way / np.linalg.norm(way)


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

_CORE, _EDGE = 0.84, 0.35  # what a bar has in its colour, and the shade of the rim around it, which crossing bars have
_STOUT = 16.0  # pixels: width from which bars show their ends themselves, without dots at nodes
_THIN = 4.5  # pixels: width up to which bars have no rim
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


def tubes(
    lines: np.ndarray, radius: np.ndarray, sides: int, rounded: bool, **values: np.ndarray
) -> list[pyvista.PolyData]:
    """Return tubes around lines, and balls at the ends of the widest ones at each place, with values of these ends.

    Parameters
    ----------
    lines : (m, 2, 3) [m]
    radius : (m, 2) [m]
    sides : of a tube
    rounded : whether there are balls
    values : (m, 2, ...) by name, data of the points of the meshes
    """
    import pyvista

    places = lines.reshape(-1, 3).astype(np.float32)
    data = {name: np.ascontiguousarray(each).reshape(2 * len(lines), -1) for name, each in values.items()}
    data["radius"] = radius.ravel() / math.sqrt(math.cos(math.pi / sides))  # as wide as round ones in the mean
    cells = pyvista.CellArray.from_regular_cells(np.arange(len(places)).reshape(-1, 2))
    mesh = pyvista.PolyData(places, lines=cells)
    mesh.point_data.update(data)
    made = [mesh.tube(scalars="radius", absolute=True, n_sides=sides, capping=False)]
    if rounded:
        widest = np.argsort(-data["radius"], kind="stable")
        ends = widest[np.unique(places[widest], axis=0, return_index=True)[1]]
        balls = pyvista.PolyData(places[ends])
        balls.point_data.update({name: each[ends] for name, each in data.items()})
        ball = pyvista.Sphere(radius=1.0, theta_resolution=sides, phi_resolution=sides)
        made.append(balls.glyph(geom=ball, scale="radius", orient=False))
    return made


def strips(lines: np.ndarray, radius: np.ndarray, ahead: np.ndarray, colour: np.ndarray) -> pyvista.PolyData:
    """Return flat bars that face the eye, of many a fifth of the time of tubes.

    Parameters
    ----------
    lines, radius : as of :func:`tubes`
    ahead : (3,) or (m, 3), the direction to the eye
    colour : (m, 2, 3) uint8 of both ends
    """
    import pyvista

    side = np.cross(lines[:, 1] - lines[:, 0], ahead)
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-300)
    places = lines[:, :, None] + radius[:, :, None, None] * np.stack([side, -side], axis=1)[:, None]
    faces = 4 * np.arange(len(lines))[:, None] + [0, 1, 3, 2]
    mesh = pyvista.PolyData.from_regular_faces(places.reshape(-1, 3).astype(np.float32), faces)
    mesh.point_data["colour"] = np.repeat(colour.reshape(-1, 3), 2, axis=0)
    return mesh


@dataclass(frozen=True)
class Style:
    """How bars are drawn.

    Parameters
    ----------
    radius : (b,) [m] of tubes; None: bars are lines
    bar_width : of lines, and the least width of tubes, in pixels; None: by the size of the model
    nodes : whether to draw nodes as balls; None: for small models
    rims : whether bars that are wide enough have dark rims
    """

    radius: np.ndarray | None = field(default=None, repr=False)
    bar_width: float | None = None
    nodes: bool | None = None
    rims: bool = True


class Layer(NamedTuple):
    """Lines or tubes.

    Attributes
    ----------
    points : (n, 3) [m]
    lines : (m, 2) int
    colour : red, green, blue; of lines (m, 1, 3), or of both ends (m, 2, 3)
    width : in pixels of a picture of 1280 by 720; of tubes the least
    shift : how much nearer to the eye than their points they are, in such pixels
    radius : (m,) [m] of tubes; None: lines
    wider : by how much tubes are wider on each side, in such pixels, with only the sides away from the eye; None: whole
    """

    points: np.ndarray
    lines: np.ndarray
    colour: np.ndarray | tuple[int, int, int]
    width: float
    shift: float = 0.0
    radius: np.ndarray | None = None
    wider: float | None = None


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
        self._radius = style.radius
        self._corners = np.array(np.meshgrid(*motion.bounds.T)).reshape(3, -1).T
        self._plotter = pyvista.Plotter(
            off_screen=True, window_size=[side * self._factor for side in size], lighting="none"
        )
        self._plotter.disable_anti_aliasing()
        self._plotter.renderer.SetUseOIT(False)  # walls are drawn in their order
        self._plotter.background_color = "black" if transparent else "white"
        self._plotter.screenshot(return_img=True)  # the first one draws by itself, and chooses a camera
        self._transparent, self._on_nodes = transparent, on_nodes
        thick = self.width if self._radius is None else max(self.width, 2.0 * pixels * np.quantile(self._radius, 0.9))
        self._rims = style.rims and count <= TUBE_LIMIT and thick > _THIN * unit
        few = count <= 400 and shortest > 3.0 * self.width and thick < _STOUT * unit
        self._dots = few if style.nodes is None else style.nodes

    def close(self) -> None:
        """Give the window back."""
        self._plotter.close()

    def draw(
        self,
        points: np.ndarray,
        colours: np.ndarray,
        camera: Camera,
        surfaces: Sequence[Surface] = (),
        whole: np.ndarray | None = None,
        layers: Sequence[Layer] = (),
    ) -> np.ndarray:
        """Draw a frame.

        Parameters
        ----------
        points : (n, 3) float64 [m]
        colours : (n, 3) or (b, 3) uint8
        camera : of this frame
        surfaces : walls
        whole : (b,) bool, bars that are drawn; None: all
        layers : lines in addition to the bars

        Returns
        -------
        (height, width, 3) uint8, or (height, width, 4) with a transparent background
        """
        from PIL import Image

        self._plotter.clear_actors()
        left = slice(None) if whole is None else whole
        shades = colours[self._bars[left]] if self._on_nodes else colours[left, None]
        width, radius = self.width / self.unit, None if self._radius is None else self._radius[left]
        bars = Layer(points, self._bars[left], shades, width, radius=radius)
        if self._rims:  # lines in a dark shade behind, or wider tubes seen from within
            behind = -width if radius is None else 0.0
            self._add(bars._replace(colour=_EDGE * shades, shift=behind, wider=0.0), camera)
            bars = bars._replace(width=_CORE * width, radius=None if radius is None else _CORE * radius)
        for layer in (bars, *layers):
            self._add(layer, camera)
        if self._dots:  # on the bars, half as wide
            thick = self.thickness(camera)
            dots = self._nearer(points[np.unique(self._bars)], 1.1 * thick, camera)
            size = max(0.5 * thick, 2.6) * self.unit * self._factor
            look = {"color": NODE_COLOUR, "point_size": size, "render_points_as_spheres": True}
            self._plotter.add_mesh(dots.astype(np.float32), style="points", lighting=False, **look)
        self._add_walls(surfaces, camera)
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
        radius = 0.0 if self._radius is None else float(self._radius.max(initial=0.0))
        return max(self.width, self.size[1] / camera.half_height * radius) / self.unit

    def rim(self, points: np.ndarray, bars: np.ndarray, colour: tuple[int, int, int]) -> Layer:
        """Return a layer that outlines bars (numbers) by a pixel or so."""
        outline = max(1.2, 1.0 / self.unit)  # a pixel at least
        width = self.width / self.unit
        if self._radius is None:
            return Layer(points, self._bars[bars], colour, width + 2.0 * outline, -width - 1.0)
        behind = -1.0 if len(self._bars) > TUBE_LIMIT else 0.0  # flat bars hide nothing of themselves
        return Layer(points, self._bars[bars], colour, width, behind, self._radius[bars], outline)

    def _nearer(self, points: np.ndarray, shift: float, camera: Camera) -> np.ndarray:
        """Return points (n, 3) [m] nearer to the eye by pixels of a page, where they are seen at the same place."""
        ahead = camera.ahead(points)
        metres = shift * 2.0 * camera.half_height / self.size[1] * self.unit
        far = np.linalg.norm(ahead, axis=-1, keepdims=True)
        return points + np.minimum(metres / far, np.inf if camera.parallel else 0.6) * ahead

    def _add(self, layer: Layer, camera: Camera) -> None:
        if not len(layer.lines):
            return
        import pyvista

        lines = self._nearer(np.asarray(layer.points, dtype=float), layer.shift, camera)[layer.lines]
        shades = np.broadcast_to(np.asarray(layer.colour), lines.shape).astype(np.uint8)
        look: dict[str, Any] = {"rgb": True, "lighting": False, "reset_camera": False, "render": False}
        if layer.radius is None:
            cells = np.insert(np.arange(2 * len(lines)).reshape(-1, 2), 0, 2, axis=1)
            mesh = pyvista.PolyData(lines.reshape(-1, 3).astype(np.float32), lines=cells.ravel())
            width = max(layer.width * self.unit, 1.0) * self._factor
            self._plotter.add_mesh(mesh, scalars=shades.reshape(-1, 3), line_width=width, **look)
            return
        pixel = self.unit * camera.metres(lines.reshape(-1, 3)).reshape(-1, 2) / self.size[1]
        radius = np.maximum(layer.radius[:, None], 0.5 * layer.width * pixel) + (layer.wider or 0.0) * pixel
        if len(self._bars) > TUBE_LIMIT:
            self._plotter.add_mesh(strips(lines, radius, camera.ahead(lines[:, 0]), shades), scalars="colour", **look)
            return
        for mesh in tubes(lines, radius, 20 if len(self._bars) <= FEW else 8, True, colour=shades):
            self._plotter.add_mesh(mesh, scalars="colour", culling=layer.wider is not None and "front", **look)

    def _add_walls(self, surfaces: Sequence[Surface], camera: Camera) -> None:
        """Draw walls, which one sees through and which fade out behind, and their edges, from the farthest to the
        nearest."""
        import pyvista

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
            self._plotter.add_mesh(mesh, scalars=shade, rgb=True, **options).ForceTranslucentOn()
            self._add(Layer(points, np.asarray(surface.edge), EDGE_COLOUR, 1.8), camera)


def _width(count: int, lengths: np.ndarray, shortest: float, unit: float) -> float:
    """Return a width in pixels that shows the bars, and does not merge the chords of a slender truss."""
    least = float(np.clip(3.8 * (300.0 / max(count, 1)) ** 0.25, 1.2, 4.2))
    if count <= TUBE_LIMIT:
        least = min(least, max(2.4, 0.75 * shortest / unit))
    wish = min(0.11 * float(lengths.mean()) if count else 1.0, 0.4 * shortest)
    return float(np.clip(wish, least * unit, 6.0 * unit))

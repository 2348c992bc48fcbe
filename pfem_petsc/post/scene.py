"""The one renderer: bars, walls and lines over them, drawn by VTK without a display; frames move points in place."""

from __future__ import annotations

import functools
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from ..contact.walls.base import Surface
from ..errors import InputError
from ..mechanics.compiled import kernel
from .camera import Camera

TUBE_LIMIT = 20_000
"""Number of bars up to which bars are drawn as tubes of their radii; more are lines."""
FEW = 2000
"""Bars of a small model."""

WALL_COLOUR, EDGE_COLOUR, NODE_COLOUR = (116, 125, 138), (75, 85, 99), (31, 36, 44)
VARIABLE = "VTK_DEFAULT_OPENGL_WINDOW"

_LIGHT = np.array([-0.4, 0.7, 1.0]) / np.linalg.norm([-0.4, 0.7, 1.0])  # right, up, to the eye
_AMBIENT, _DIFFUSE, _SPECULAR = 0.42, 0.66, 0.35
_GL_BLEND = 0x0BE2
_ROUND = 2.5  # pixels: radius from which a bar has a round surface; thinner ones are flat, with a shade across
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


class _Mesh(NamedTuple):
    """Points and normals (p, 3) float32 and colours (p, 3) uint8 of all bars; no normals where bars are flat."""

    points: np.ndarray
    normals: np.ndarray
    colours: np.ndarray


class _Bars(NamedTuple):
    """Nodes (b, 2), radii (b,) [m], rows (b, 2) of the colours of both ends, and the form (m, 4) of a bar."""

    ends: np.ndarray
    radius: np.ndarray
    rows: np.ndarray
    form: np.ndarray


class _View(NamedTuple):
    """What bars see of the camera, each (4,): ``a[:3]·x + a[3]`` is the least radius [m] and the fade (0 to 1) at x;
    the direction to the eye is ``eye[:3] - eye[3] x``; and the direction to the light (3,)."""

    eye: np.ndarray
    least: np.ndarray
    fade: np.ndarray
    light: np.ndarray


@kernel
def _unit(a, other):
    """Return a vector over its length, or another one if it has none."""
    length = (a[0] * a[0] + a[1] * a[1] + a[2] * a[2]) ** 0.5
    return (a[0] / length, a[1] / length, a[2] / length) if length > 0.0 else other


@kernel
def _across(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@kernel
def _along(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel
def _fill(mesh, x, colours, bars, view):
    """Place the points of all bars, in a frame of their axis and the direction to the eye, and colour them.

    A point of the form is (end, along, across, facing): ``x[end] + radius (along a + across u + facing v)``. Bars of a
    negative radius are shrunk to nothing.
    """
    eye, least, fade, light = view
    form, flat = bars.form, len(mesh.normals) == 0
    shaded = flat and _along(light, light) > 0.0
    for k in range(len(bars.ends)):
        first, last = x[bars.ends[k, 0]], x[bars.ends[k, 1]]
        axis = _unit((last[0] - first[0], last[1] - first[1], last[2] - first[2]), (1.0, 0.0, 0.0))
        ahead = (eye[0] - eye[3] * first[0], eye[1] - eye[3] * first[1], eye[2] - eye[3] * first[2])
        side = _across(axis, ahead)
        if _along(side, side) < 1e-18 * _along(ahead, ahead):  # seen along its axis: any direction is across
            side = _across(axis, (0.0, 1.0, 0.0) if abs(axis[1]) < 0.9 else (1.0, 0.0, 0.0))
        side = _unit(side, (0.0, 0.0, 1.0))
        facing = _across(side, axis)
        lit, slope = 0.785 * max(0.0, _along(light, facing)), 0.35 * _along(light, side)
        there = bars.radius[k] >= 0.0
        for q in range(len(form)):
            end = int(form[q, 0])
            place, row, hue = x[bars.ends[k, end if there else 0]], k * len(form) + q, bars.rows[k, end]
            radius = max(bars.radius[k], _along(least, place) + least[3]) if there else 0.0
            pale = 0.5 * min(1.0, max(0.0, _along(fade, place) + fade[3]))
            # of the light that a cylinder sends back in the mean, with a slope from its bright to its dark side
            share = min(1.0, _AMBIENT + _DIFFUSE * max(0.0, lit + slope * form[q, 2])) if shaded else 1.0
            for c in range(3):
                normal = form[q, 1] * axis[c] + form[q, 2] * side[c] + form[q, 3] * facing[c]
                mesh.points[row, c] = place[c] + radius * normal
                colour = float(colours[hue, c])
                mesh.colours[row, c] = np.uint8((colour + (255.0 - colour) * pale) * share + 0.5)
                if not flat:
                    mesh.normals[row, c] = normal


def _form(kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (m, 4) of a bar, see :func:`_fill`, and its cells (c, 2 or 4).

    A ``line`` is two points, a ``strip`` faces the eye, a ``prism`` has open ends, and ``round`` bars and ``rough``
    ones, of fewer sides, are cylinders with half a sphere at each end.
    """
    if kind == "line":
        return np.array([[0.0, 0, 0, 0], [1, 0, 0, 0]]), np.array([[0, 1]])
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
    rows : (p,) int, the node or the bar whose colour each point of the mesh has
    """

    def __init__(self, plotter: Any, ends: np.ndarray, kind: str, on_nodes: bool, width: float = 1.0) -> None:
        import pyvista

        ends = np.ascontiguousarray(ends, dtype=np.int64)
        form, cells = _form(kind)
        count, m = len(ends), len(form)
        rows = ends if on_nodes else np.repeat(np.arange(count), 2).reshape(-1, 2)
        self.rows = rows[:, form[:, 0].astype(int)].ravel()
        self._bars = _Bars(ends, np.zeros(count), rows, form)
        kept = (cells + m * np.arange(count)[:, None, None]).reshape(-1, cells.shape[1])
        self.mesh = pyvista.PolyData()
        self.mesh.points = np.zeros((count * m, 3), dtype=np.float32)
        cells = pyvista.CellArray.from_regular_cells(kept)
        self.mesh.SetLines(cells) if kind == "line" else self.mesh.SetPolys(cells)
        self.mesh.point_data["colour"] = np.zeros((count * m, 3), dtype=np.uint8)
        solid = kind not in ("line", "strip")
        if solid:
            self.mesh.point_data.active_normals = np.zeros((count * m, 3), dtype=np.float32)
        if plotter is None:
            return
        shine = (
            {"ambient": _AMBIENT, "diffuse": _DIFFUSE, "specular": _SPECULAR, "specular_power": 10.0} if solid else {}
        )
        options: dict[str, Any] = {"scalars": "colour", "rgb": True, "preference": "point", "line_width": width}
        self.actor = plotter.add_mesh(self.mesh, lighting=solid, reset_camera=False, render=False, **options, **shine)
        self.actor.prop.specular_color = "white"
        self.actor.prop.interpolation = "Phong" if kind == "round" else "Gouraud"

    def move(
        self, points: np.ndarray, radius: np.ndarray, colours: np.ndarray | None = None, view: _View | None = None
    ) -> None:
        """Draw bars between points (n, 3) [m] with radii (b,) [m], negative for none, and colours (n or b, 3) uint8.

        Without a view, from any side.
        """
        if view is None:
            view = _View(np.array([0.36, 0.48, 0.8, 0.0]), np.zeros(4), np.zeros(4), np.zeros(3))
        if colours is None:
            colours = np.zeros((int(self._bars.rows.max(initial=-1)) + 1, 3), dtype=np.uint8)
        data = self.mesh.point_data
        normals = np.asarray(data["Normals"]) if "Normals" in data else np.zeros((0, 3), dtype=np.float32)
        mesh = _Mesh(np.asarray(self.mesh.points), normals, np.asarray(data["colour"]))
        bars = self._bars._replace(radius=np.ascontiguousarray(radius, dtype=float))
        _fill(mesh, np.ascontiguousarray(points, dtype=float), np.ascontiguousarray(colours), bars, view)
        self.mesh.GetPoints().Modified()
        for name in data:
            data[name].VTKObject.Modified()
        self.mesh.Modified()


@dataclass(frozen=True)
class Style:
    """How bars are drawn.

    Parameters
    ----------
    tubes : whether bars have the radii of their sections
    radius : (b,) [m] of the bars; None: not known
    bar_width : of bars without radii, and the least width of tubes, in pixels; None: by the size of the model
    nodes : whether to draw nodes as balls; None: for small models
    shaded : whether bars have shades
    """

    tubes: bool
    radius: np.ndarray | None = field(default=None, repr=False)
    bar_width: float | None = None
    nodes: bool | None = None
    shaded: bool = True


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
    radius: np.ndarray | None = None


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

        bars, count, area = motion.bars, len(motion.bars), size[0] * size[1]
        self._bars, self.size, self.unit = bars, size, unit
        # more pixels than asked for are drawn and averaged, for smooth edges
        self._factor = 3 if count <= FEW and area <= _MOST_PIXELS[0] else 2 if area <= _MOST_PIXELS[1] else 1
        pixels = size[1] / (2.0 * camera.half_height)
        lengths = pixels * np.linalg.norm(motion.start[bars[:, 1]] - motion.start[bars[:, 0]], axis=1)
        shortest = float(np.quantile(lengths, 0.1)) if count else 1.0
        self.width = style.bar_width or _width(count, lengths, shortest, unit)
        self._radius = np.zeros(count) if not style.tubes or style.radius is None else np.asarray(style.radius, float)
        self._corners = np.array(np.meshgrid(*motion.bounds.T)).reshape(3, -1).T
        window = [side * self._factor for side in size]
        self._plotter = pyvista.Plotter(off_screen=True, window_size=window, lighting="none")
        self._plotter.disable_anti_aliasing()
        self._light = pyvista.Light(light_type="scene light")
        self._plotter.add_light(self._light)
        self._plotter.renderer.SetUseOIT(False)  # walls are drawn in their order
        # a third of the time of a frame is blending, which only walls need; they are drawn last
        self._plotter.renderer.AddObserver("StartEvent", self._without_blending)
        self._plotter.background_color = "black" if transparent else "white"
        self._channels = 4 if transparent else 3
        if transparent:  # colours over nothing are multiplied by their opacity
            self._plotter.render_window.SetAlphaBitPlanes(1)
            self._plotter.renderer.SetBackgroundAlpha(0.0)
        thick = max(0.5 * self.width, pixels * float(np.quantile(self._radius, 0.9)) if count else 0.0)
        wide = thick >= _ROUND * unit
        self._shaded = style.shaded
        if not style.shaded:
            kind = "strip"
        elif count <= FEW:
            kind = "round" if wide else "rough"
        else:
            kind = (
                "line"
                if count > TUBE_LIMIT and not style.tubes
                else "rough"
                if wide and count <= TUBE_LIMIT
                else "strip"
            )
        self.segments = Segments(self._plotter, bars, kind, on_nodes, self.width * self._factor)
        nodes = count <= 400 and shortest > 3.0 * self.width if style.nodes is None else style.nodes
        self._nodes = self._balls() if nodes else None
        self._extra: list[Any] = []

    def _balls(self) -> tuple[Segments, np.ndarray, np.ndarray]:
        """Return nodes as bars without length, their numbers, and their radii."""
        used, radius = np.unique(self._bars), np.zeros(int(self._bars.max(initial=-1)) + 1)
        for end in (0, 1):
            np.maximum.at(radius, self._bars[:, end], self._radius)
        kind = "round" if len(used) <= FEW else "rough"
        return Segments(self._plotter, np.stack([used, used], axis=1), kind, False), used, 1.2 * radius[used]

    def _without_blending(self, *_: Any) -> None:
        self._plotter.render_window.GetState().vtkglDisable(_GL_BLEND)

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
        for actor in self._extra:
            self._plotter.remove_actor(actor, reset_camera=False, render=False)
        radius = self._radius if gone is None else np.where(gone, -1.0, self._radius)
        self.segments.move(points, radius, colours, self.view(camera, 0.5 * self.width, fades=True))
        if self._nodes is not None:
            balls, used, sizes = self._nodes
            ink = np.tile(np.array(NODE_COLOUR, dtype=np.uint8), (len(used), 1))
            balls.move(points, sizes, ink, self.view(camera, 0.7 * self.width))
        self._extra = [self._add(layer, camera) for layer in layers if len(layer.lines)]
        self._extra += self._add_walls(surfaces, camera)
        return self.picture(camera)

    def picture(self, camera: Camera) -> np.ndarray:
        """Return what the window shows from a camera, as :meth:`draw`."""
        import pyvista
        from PIL import Image
        from vtkmodules.vtkCommonCore import vtkUnsignedCharArray

        point_camera(self._plotter, camera)
        self._light.position = camera.centre + camera.distance * self.view(camera, 0.0).light
        self._light.focal_point = camera.centre
        window, (width, height) = self._plotter.render_window, self._plotter.window_size
        window.Render()
        made = vtkUnsignedCharArray()
        read = window.GetPixelData if self._channels == 3 else window.GetRGBACharPixelData
        read(0, 0, width - 1, height - 1, 0, made, 0)
        # reduced as plain channels, because they are multiplied by the opacity already; rows are from below
        mode = "RGB" if self._channels == 3 else "CMYK"
        image = Image.frombuffer(mode, (width, height), pyvista.convert_array(made), "raw", mode, 0, -1)
        picture = np.array(image.reduce(self._factor))
        return picture if self._channels == 3 else _unmultiplied(picture)

    def view(self, camera: Camera, least: float, fades: bool = False) -> _View:
        """Return what bars see of a camera, with a least radius in pixels."""
        metres = 2.0 * camera.half_height / self.size[1] * least
        near = 0.0 if camera.parallel else 1.0 / camera.distance
        flat = np.append(-near * metres * camera.towards, metres * (1.0 + near * camera.centre @ camera.towards))
        fade = np.zeros(4)
        if fades and not camera.parallel:  # what is far away is paler, to show thousands of bars in space
            depths = self._corners @ camera.towards
            fade = np.append(-camera.towards, depths.max()) / max(float(np.ptp(depths)), 1e-300)
        eye = camera.towards if camera.parallel else camera.centre + camera.distance * camera.towards
        light = float(self._shaded) * (_LIGHT @ np.stack([camera.right, camera.up, camera.towards]))
        return _View(np.append(eye, float(not camera.parallel)), flat, fade, light)

    def thickness(self, camera: Camera) -> float:
        """Return the width of the widest bar, in pixels of a page of 1280 by 720."""
        pixels = self.size[1] / (2.0 * camera.half_height)
        return max(self.width, 2.0 * pixels * float(self._radius.max(initial=0.0))) / self.unit

    def rim(self, points: np.ndarray, bars: np.ndarray, colour: tuple[int, int, int]) -> Layer:
        """Return a layer that outlines bars (numbers) by two pixels."""
        return Layer(points, self._bars[bars], colour, self.width / self.unit + 4.0, -1.0, self._radius[bars])

    def _add(self, layer: Layer, camera: Camera) -> Any:
        pixel = 2.0 * camera.half_height / self.size[1] * self.unit
        radius = np.zeros(len(layer.lines))
        if layer.radius is not None:
            radius = layer.radius + 2.0 * pixel
        points = np.asarray(layer.points, dtype=float) + layer.shift * pixel * camera.towards
        made = Segments(self._plotter, layer.lines, "strip", False)
        view = self.view(camera, max(0.5 * layer.width * self.unit, 0.4))._replace(light=np.zeros(3))
        colours = np.tile(np.array(layer.colour, dtype=np.uint8), (len(layer.lines), 1))
        made.move(points, radius, colours, view)
        return made.actor

    def _add_walls(self, surfaces: Sequence[Surface], camera: Camera) -> list[Any]:
        """Draw walls from the farthest to the nearest, and their edges."""
        actors = []
        # without perspective, walls are behind all bars, so that they hide none
        depth = 4.0 * np.linalg.norm(np.ptp(self._corners, axis=0)) if camera.parallel else 0.0
        for surface in sorted(surfaces, key=lambda each: float((np.asarray(each.points) @ camera.towards).mean())):
            points = np.asarray(surface.points, dtype=float) - depth * camera.towards
            normal = np.cross(*np.diff(points[np.asarray(surface.faces)[0]][:3], axis=0))
            facing = float(normal @ camera.towards) > 1e-12 * float(np.linalg.norm(normal))
            # a wall between the eye and the structure must be transparent
            strength = 150 if camera.parallel else 110 if facing else 35
            actors.append(add_wall(self._plotter, surface, points, strength, camera.towards))
            edge = np.asarray(surface.edge, dtype=np.int64).reshape(-1, 2)
            if len(edge):
                actors.append(self._add(Layer(points, edge, EDGE_COLOUR, 1.8), camera))
        return actors


def _unmultiplied(picture: np.ndarray) -> np.ndarray:
    """Return a picture (h, w, 4) that was multiplied by its opacity with plain colours."""
    alpha = picture[..., 3:].astype(np.uint16)
    colours = np.minimum(255 * picture[..., :3].astype(np.uint16) // np.maximum(alpha, 1), 255)
    return np.concatenate([colours, alpha], axis=2).astype(np.uint8)


def add_wall(plotter: Any, surface: Surface, points: np.ndarray, strength: int, towards: np.ndarray) -> Any:
    """Add a wall, which one sees through and which fades out behind, to a plotter; return the actor.

    Parameters
    ----------
    points : (n, 3) [m], where its points are
    strength : opacity at its face, up to 255
    towards : (3,), the direction to the eye: polygons are drawn from the farthest to the nearest
    """
    import pyvista
    from vtkmodules.vtkRenderingCore import vtkPolyDataMapper

    faces = np.asarray(surface.faces)
    order = np.argsort((points @ towards)[faces].mean(axis=1), kind="stable")
    mesh = pyvista.PolyData.from_regular_faces(points.astype(np.float32), faces[order])
    opacity = strength * (1.0 - np.clip(np.asarray(surface.depth), 0.0, 1.0))
    mesh.point_data["shade"] = np.column_stack([np.tile(WALL_COLOUR, (len(points), 1)), opacity]).astype(np.uint8)
    options: dict[str, Any] = {"reset_camera": False, "render": False, "lighting": False}
    actor = plotter.add_mesh(mesh, scalars="shade", rgb=True, preference="point", **options)
    actor.ForceTranslucentOn()
    state = plotter.render_window.GetState()
    mapper = vtkPolyDataMapper()  # that of pyvista passes no events on
    mapper.ShallowCopy(actor.mapper)
    mapper.SetInputData(mesh)
    mapper.AddObserver("UpdateShaderEvent", lambda *_: state.vtkglEnable(_GL_BLEND))
    actor.SetMapper(mapper)
    return actor


def point_camera(plotter: Any, camera: Camera) -> None:
    """Have a plotter look as a camera does."""
    plotter.camera.position = camera.centre + camera.distance * camera.towards
    plotter.camera.focal_point, plotter.camera.up = camera.centre, camera.up
    plotter.camera.parallel_projection, plotter.camera.parallel_scale = camera.parallel, camera.half_height
    plotter.camera.view_angle = 2.0 * np.degrees(np.arctan2(camera.half_height, camera.distance))
    plotter.renderer.ResetCameraClippingRange()


def _width(count: int, lengths: np.ndarray, shortest: float, unit: float) -> float:
    """Return a width in pixels that shows the bars, and does not merge the chords of a slender truss."""
    least = float(np.clip(3.8 * (300.0 / max(count, 1)) ** 0.25, 1.2, 4.2))
    if count <= TUBE_LIMIT:
        least = min(least, max(2.4, 0.75 * shortest / unit))
    wish = min(0.11 * float(lengths.mean()) if count else 1.0, 0.4 * shortest)
    return float(np.clip(wish, least * unit, 6.0 * unit))

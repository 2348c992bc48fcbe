"""Bars, walls and what is laid over them, drawn into an image; each frame moves the nodes and changes the colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from .camera import Camera
from .raster import blend_triangles, draw_bars, resolve
from .walls import Surface

__all__ = ["TUBE_LIMIT", "Layer", "Scene", "Style"]

TUBE_LIMIT = 20_000
"""Number of bars up to which bars are drawn as tubes of their radii; more are lines."""

WALL_COLOUR = (116, 125, 138)
EDGE_COLOUR = (75, 85, 99)
NODE_COLOUR = (31, 36, 44)
_LIGHT = np.array([-0.4, 0.7, 1.0]) / np.linalg.norm([-0.4, 0.7, 1.0])
_DARK = np.zeros(3)
_EVERYWHERE = 1e30  # how much farther away walls are where they hide nothing


@dataclass(frozen=True)
class Style:
    """How bars are drawn.

    Parameters
    ----------
    tubes : whether bars have the radii of their sections, and shades; None: up to :data:`TUBE_LIMIT` bars
    radius : (b,) [m] of the bars; None: not known
    bar_width : of bars without radii, and the least width of tubes, in pixels; None: by the size of the model
    nodes : whether to draw nodes as balls; None: for small models
    """

    tubes: bool | None = None
    radius: np.ndarray | None = field(default=None, repr=False)
    bar_width: float | None = None
    nodes: bool | None = None


@dataclass(frozen=True)
class Layer:
    """Lines in addition to the bars.

    Parameters
    ----------
    points : (n, 3) [m]
    lines : (m, 2) int
    colour : red, green, blue
    width : in pixels of a picture of 1280 by 720
    shift : how much nearer to the eye than their points they are, in such pixels, so that they hide what is at the same
        place, or are hidden by it
    rim : whether they are as near as their axes, so that what they outline hides them
    """

    points: np.ndarray
    lines: np.ndarray
    colour: tuple[int, int, int]
    width: float
    shift: float = 0.0
    rim: bool = False


class Scene:
    """A picture of bars without text, which can be drawn repeatedly.

    Parameters
    ----------
    points : (n, 3) float64 [m], nodes of the first frame, from which widths are chosen
    bars : (b, 2) int, ends of the bars
    camera : a camera at the distance of those of all frames
    bounds : (2, 3) [m], bounds of the motion, for depth
    size : width and height in pixels
    style : how bars are drawn
    transparent : whether the background is
    unit : pixels for each pixel of a page of 1280 by 720; None: by the size
    """

    def __init__(
        self,
        points: np.ndarray,
        bars: np.ndarray,
        camera: Camera,
        bounds: np.ndarray,
        size: tuple[int, int],
        style: Style | None = None,
        transparent: bool = False,
        unit: float | None = None,
    ) -> None:
        style = style or Style()
        self._bars, self._size, self._transparent = np.ascontiguousarray(bars, dtype=np.int64), size, transparent
        self.tubes = len(bars) <= TUBE_LIMIT if style.tubes is None else style.tubes
        # more pixels than asked for are drawn and averaged, for smooth edges
        area = size[0] * size[1]
        self._factor = 3 if len(bars) <= TUBE_LIMIT and area <= 1.5e6 else (2 if area <= 1e7 else 1)
        self.unit = min(size[0] / 1110, size[1] / 604) if unit is None else unit
        pixels = size[1] / (2.0 * camera.half_height)
        ends = points[bars[:, 1]] - points[bars[:, 0]]
        lengths = pixels * np.linalg.norm(ends, axis=1)
        shortest = float(np.quantile(lengths, 0.1)) if len(bars) else 1.0
        self.width = style.bar_width or _width(len(bars), lengths, shortest, self.unit)
        self._radius = np.zeros(len(bars))
        if self.tubes and style.radius is not None:
            self._radius = np.ascontiguousarray(style.radius, dtype=float)
        self.nodes = len(bars) <= 400 and shortest > 3.0 * self.width if style.nodes is None else style.nodes
        corners = np.array(np.meshgrid(*bounds.T)).reshape(3, -1).T
        self._corners = corners
        height, width = size[1] * self._factor, size[0] * self._factor
        self._image = np.zeros((height, width, 4), dtype=np.uint8)
        self._depth = np.zeros((height, width), dtype=np.float32)

    def draw(
        self,
        points: np.ndarray,
        colours: np.ndarray,
        on_nodes: bool,
        camera: Camera,
        surfaces: Sequence[Surface] = (),
        gone: np.ndarray | None = None,
        layers: Sequence[Layer] = (),
    ) -> np.ndarray:
        """Draw a frame.

        Parameters
        ----------
        points : (n, 3) float64 [m]
        colours : (n, 3) uint8 of nodes or (b, 3) of bars
        on_nodes : whether the colours are those of nodes
        camera : of this frame
        surfaces : walls
        gone : (b,) bool, bars that are left out
        layers : lines in addition to the bars

        Returns
        -------
        (height, width, 3) uint8, or (height, width, 4) with a transparent background
        """
        self._image[:], self._depth[:] = 0, -np.inf
        size = self._image.shape[1], self._image.shape[0]
        if camera.parallel:  # walls are behind all bars, so that they hide none
            self._draw_walls(surfaces, camera, size)
        x, y, near, scale = camera.project(points, size)
        if not camera.parallel:
            places = points if on_nodes else 0.5 * (points[self._bars[:, 0]] + points[self._bars[:, 1]])
            colours = self._paler(colours, places, camera)
        hidden = np.zeros(0, dtype=bool) if gone is None else gone
        least = 0.5 * self.width * self._factor
        # lines of a pixel have a shade each
        draw_bars(
            self._image,
            self._depth,
            *(x, y, near, scale, self._bars, hidden, self._radius, least, np.ascontiguousarray(colours), on_nodes),
            *(_LIGHT, camera.lift(size)),
        )
        if self.nodes:
            self._draw_nodes(x, y, near, scale, camera.lift(size))
        for layer in layers:
            self._draw_layer(layer, camera, size)
        if not camera.parallel:
            self._draw_walls(surfaces, camera, size)
        made = np.empty((self._size[1], self._size[0], 4), dtype=np.uint8)
        resolve(self._image, self._factor, self._transparent, made)
        return made if self._transparent else made[..., :3]

    def _draw_nodes(self, x: np.ndarray, y: np.ndarray, near: np.ndarray, scale: np.ndarray, lift: np.ndarray) -> None:
        used = np.unique(self._bars)
        itself = np.stack([used, used], axis=1)
        radius = np.zeros(len(x))
        for end in (0, 1):
            np.maximum.at(radius, self._bars[:, end], self._radius)
        colours = np.tile(np.array(NODE_COLOUR, dtype=np.uint8), (len(used), 1))
        least = 0.7 * self.width * self._factor
        hidden = np.zeros(0, dtype=bool)
        draw_bars(
            self._image,
            self._depth,
            *(x, y, near, scale, itself, hidden, 1.2 * radius[used], least, colours, False, _LIGHT, 1.05 * lift),
        )

    def _draw_layer(self, layer: Layer, camera: Camera, size: tuple[int, int]) -> None:
        x, y, near, scale = camera.project(np.asarray(layer.points, dtype=float), size)
        lift = camera.lift(size)
        near = near + layer.shift * self.unit * self._factor * (lift[0] + lift[1] * near)
        if layer.rim:
            lift = 0.0 * lift
        lines = np.ascontiguousarray(layer.lines, dtype=np.int64)
        colours = np.tile(np.array(layer.colour, dtype=np.uint8), (len(lines), 1))
        radius, hidden = np.zeros(len(lines)), np.zeros(0, dtype=bool)
        least = 0.5 * layer.width * self.unit * self._factor
        draw_bars(
            self._image,
            self._depth,
            *(x, y, near, scale, lines, hidden, radius, max(least, 0.5), colours, False, _DARK, lift),
        )

    def halo(self, points: np.ndarray, bars: np.ndarray, colour: tuple[int, int, int], camera: Camera) -> Layer:
        """Return a layer that outlines bars (numbers) by a rim of two pixels."""
        return Layer(points, self._bars[bars], colour, self.thickness(camera, bars) + 4.0, rim=True)

    def thickness(self, camera: Camera, bars: np.ndarray | slice = slice(None)) -> float:
        """Return the width of the widest of some bars (numbers), in pixels of a page of 1280 by 720."""
        pixels = self._size[1] / (2.0 * camera.half_height)
        return max(self.width, 2.0 * pixels * float(self._radius[bars].max(initial=0.0))) / self.unit

    def _paler(self, colours: np.ndarray, places: np.ndarray, camera: Camera) -> np.ndarray:
        """Return colours that fade with the depth of their positions (n, 3), to show thousands of bars in space."""
        depths = self._corners @ camera.towards
        deep = max(float(np.ptp(depths)), 1e-300)
        depth = np.clip((depths.max() - places @ camera.towards) / deep, 0.0, 1.0).astype(np.float32)
        return (colours + (255.0 - colours) * (0.5 * depth)[:, None]).astype(np.uint8)

    def _draw_walls(self, surfaces: Sequence[Surface], camera: Camera, size: tuple[int, int]) -> None:
        """Draw walls from the farthest polygon to the nearest, and their edges."""
        pieces = []
        for surface in surfaces:
            points = np.asarray(surface.points, dtype=float)
            first = points[surface.faces[0]]
            normal = np.cross(first[1] - first[0], first[2] - first[1])
            facing = float(normal @ camera.towards) / (np.linalg.norm(normal) or 1.0)
            # a wall between the eye and the structure must be transparent
            strength = 150 if camera.parallel else (110 if facing > 0 else 35)
            colours = np.empty((len(points), 4), dtype=np.uint8)
            colours[:, :3] = WALL_COLOUR
            colours[:, 3] = strength * (1.0 - np.clip(surface.depth, 0.0, 1.0))
            x, y, near, scale = camera.project(points, size)
            if camera.parallel:
                near = near - _EVERYWHERE
            corners = np.asarray(surface.faces)
            triangles = np.concatenate([corners[:, [0, k, k + 1]] for k in range(1, corners.shape[1] - 1)])
            order = np.argsort(near[triangles].mean(axis=1), kind="stable")
            pieces.append((float(near.mean()), (x, y, near, scale), triangles[order], colours, surface))
        lift = camera.lift(size)
        for _, projected, triangles, colours, surface in sorted(pieces, key=lambda piece: piece[0]):
            blend_triangles(self._image, self._depth, *projected, np.ascontiguousarray(triangles), colours)
            edge = np.ascontiguousarray(np.asarray(surface.edge, dtype=np.int64).reshape(-1, 2))
            ink = np.tile(np.array(EDGE_COLOUR, dtype=np.uint8), (len(edge), 1))
            radius, hidden = np.zeros(len(edge)), np.zeros(0, dtype=bool)
            least = max(0.5, 0.9 * self.unit * self._factor)
            draw_bars(self._image, self._depth, *projected, edge, hidden, radius, least, ink, False, _DARK, 0.0 * lift)


def _width(count: int, lengths: np.ndarray, shortest: float, unit: float) -> float:
    """Return a width in pixels that shows the bars, and does not merge the chords of a slender truss."""
    least = float(np.clip(3.8 * (300.0 / max(count, 1)) ** 0.25, 1.2, 4.2))
    if count <= TUBE_LIMIT:
        least = min(least, max(2.4, 0.75 * shortest / unit))
    wish = min(0.11 * float(lengths.mean()) if count else 1.0, 0.4 * shortest)
    return float(np.clip(wish, least * unit, 6.0 * unit))

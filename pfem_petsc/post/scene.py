"""Bars and walls in a VTK window that is set up once; each frame moves the nodes and changes the colours."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .camera import Camera
from .walls import Surface

__all__ = ["Scene"]

TUBE_LIMIT = 5000  # maximum number of bars drawn as shaded tubes; more are lines shaded through their colours
WALL_COLOUR = (116, 125, 138)
EDGE_COLOUR = "#4b5563"
NODE_COLOUR = "#1f242c"


class Scene:
    """A picture of bars without text, which can be drawn repeatedly.

    Parameters
    ----------
    points : (n, 3) float64 [m], nodes of the first frame
    bars : (b, 2) int, ends of the bars
    camera : the view of all frames
    bounds : (2, 3) [m], bounds of the motion, for depth
    surfaces : walls of the first frame
    size : width and height in pixels
    bar_width : in pixels; None: from the length of the bars in the picture
    nodes : whether to draw nodes as balls; None: for small models
    """

    def __init__(
        self,
        points: np.ndarray,
        bars: np.ndarray,
        camera: Camera,
        bounds: np.ndarray,
        surfaces: Sequence[Surface],
        size: tuple[int, int],
        bar_width: float | None = None,
        nodes: bool | None = None,
    ) -> None:
        import pyvista

        self._camera, self._bars = camera, bars
        self._tubes = len(bars) <= TUBE_LIMIT
        # draw twice the pixels and average them: smooth edges with any OpenGL library
        self._factor = 2 if self._tubes else 1
        window = (size[0] * self._factor, size[1] * self._factor)
        pixels = size[1] / (2.0 * camera.half_height)
        lengths = pixels * np.linalg.norm(points[bars[:, 1]] - points[bars[:, 0]], axis=1)
        shortest = float(np.quantile(lengths, 0.1))
        if bar_width is None:
            # thin enough that the chords of a slender truss do not merge
            scale = min(size[0] / 1100, size[1] / 600)
            wish = min(0.11 * float(lengths.mean()), 0.4 * shortest)
            bar_width = float(np.clip(wish, (2.0 if self._tubes else 1.2) * scale, 6.0 * scale))
        if nodes is None:
            nodes = len(bars) <= 400 and shortest > 3.0 * bar_width
        depths = np.array(np.meshgrid(*bounds.T)).reshape(3, -1).T @ camera.towards
        self._near, self._deep = depths.max(), max(float(np.ptp(depths)), 1e-300)

        self._plotter = plotter = pyvista.Plotter(off_screen=True, window_size=window)
        plotter.background_color = "white"
        if not self._tubes:
            plotter.enable_anti_aliasing("msaa", multi_samples=4)
        self._walls = [self._add_wall(surface) for surface in surfaces]
        # points far from the origin lose digits in the single precision of the graphics
        self._origin = camera.centre.copy()
        lines = np.column_stack([np.full(len(bars), 2), bars]).ravel()
        self._lines = pyvista.PolyData((points - self._origin).astype(np.float32), lines=lines)
        self._by_node = np.zeros((len(points), 3), dtype=np.uint8)
        self._by_bar = np.zeros((len(bars), 3), dtype=np.uint8)
        self._actor = None
        self._width = bar_width * self._factor
        self._balls = None
        if nodes:
            self._balls = pyvista.PolyData(self._lines.points.copy())
            ball = plotter.add_mesh(
                self._balls,
                color=NODE_COLOUR,
                point_size=1.35 * self._width,
                render_points_as_spheres=True,
                ambient=0.3,
                reset_camera=False,
            )
            ball.SetPosition(*self._origin)
        camera.apply(plotter.camera)

    def draw(
        self,
        points: np.ndarray,
        colours: np.ndarray,
        on_nodes: bool,
        surfaces: Sequence[Surface] | None = None,
        shown: Sequence[bool] | None = None,
        gone: np.ndarray | None = None,
    ) -> np.ndarray:
        """Draw a frame.

        Parameters
        ----------
        points : (n, 3) float64 [m]
        colours : (n, 3) uint8 of nodes or (b, 3) of bars
        on_nodes : whether the colours are those of nodes
        surfaces : the walls at their current positions; None: unchanged
        shown : which of them are drawn; None: unchanged
        gone : (b,) bool, bars that are left out; None: unchanged

        Returns
        -------
        (height, width, 3) uint8
        """
        if surfaces is not None:
            for surface, meshes in zip(surfaces, self._walls, strict=True):
                for mesh, _ in meshes:
                    mesh.points = self._behind(surface.points)
        if shown is not None:
            for visible, meshes in zip(shown, self._walls, strict=True):
                for _, actor in meshes:
                    actor.SetVisibility(visible)
        if gone is not None:
            self._leave_out(gone)
        moved = (points - self._origin).astype(np.float32)
        self._lines.points = moved
        if self._balls is not None:
            self._balls.points = moved
        if not self._tubes and on_nodes:
            ends = colours[self._bars].astype(np.uint16)
            colours, on_nodes = ((ends[:, 0] + ends[:, 1]) // 2).astype(np.uint8), False
        if not self._camera.parallel:
            places = points if on_nodes else 0.5 * (points[self._bars[:, 0]] + points[self._bars[:, 1]])
            colours = self._paler(colours if self._tubes else self._lit(points, colours), places)
        target = self._lines.point_data if on_nodes else self._lines.cell_data
        target["colour"] = colours
        if self._actor is None:
            self._actor = self._plotter.add_mesh(
                self._lines,
                scalars="colour",
                preference="point" if on_nodes else "cell",
                rgb=True,
                line_width=self._width,
                render_lines_as_tubes=self._tubes,
                lighting=self._tubes,
                ambient=0.35,
                diffuse=0.75,
                show_scalar_bar=False,
                reset_camera=False,
            )
            self._actor.SetPosition(*self._origin)
        self._camera.apply(self._plotter.camera)
        self._plotter.render()
        image = self._plotter.screenshot(return_img=True)
        if self._factor == 2:
            height, width = image.shape[0] // 2, image.shape[1] // 2
            image = image.reshape(height, 2, width, 2, 3).astype(np.uint16).sum(axis=(1, 3)) // 4
        return image.astype(np.uint8)

    def close(self) -> None:
        """Free the window."""
        self._plotter.close()

    def _leave_out(self, gone: np.ndarray) -> None:
        """Draw bars (b,) as points inside one of their nodes."""
        lines = np.column_stack([np.full(len(self._bars), 2), self._bars])
        lines[gone, 2] = lines[gone, 1]
        self._lines.lines = lines.ravel()

    def _lit(self, points: np.ndarray, colours: np.ndarray) -> np.ndarray:
        """Return colours of bars shaded like thin cylinders, for lines that the graphics does not shade."""
        along = points[self._bars[:, 1]] - points[self._bars[:, 0]]
        length = np.linalg.norm(along, axis=1)
        light = self._camera.towards + 0.7 * self._camera.up - 0.4 * self._camera.right
        cosine = along @ (light / np.linalg.norm(light)) / np.where(length > 0, length, 1.0)
        return colours * (0.5 + 0.5 * np.sqrt(np.clip(1.0 - cosine**2, 0.0, 1.0)))[:, None]

    def _paler(self, colours: np.ndarray, places: np.ndarray) -> np.ndarray:
        """Return colours that fade with the depth of their positions (n, 3), to show thousands of bars in space."""
        depth = np.clip((self._near - places @ self._camera.towards) / self._deep, 0.0, 1.0)
        return (colours + (255.0 - colours) * (0.5 * depth)[:, None]).astype(np.uint8)

    def _behind(self, points: np.ndarray) -> np.ndarray:
        """Return the points of a wall as drawn; without perspective it is behind all bars, so that it hides none."""
        if self._camera.parallel:
            points = points - 3.0 * self._camera.half_height * self._camera.towards
        return points

    def _add_wall(self, surface: Surface) -> list[tuple[Any, Any]]:
        """Draw a wall; return its meshes, whose points move with it, with their actors."""
        import pyvista

        points = self._behind(surface.points)
        first = points[surface.faces[0]]
        normal = np.cross(first[1] - first[0], first[2] - first[1])
        facing = float(normal @ self._camera.towards) / (np.linalg.norm(normal) or 1.0)
        # a wall between the eye and the structure must be transparent
        strength = 150 if self._camera.parallel else (110 if facing > 0 else 35)
        faces = np.column_stack([np.full(len(surface.faces), surface.faces.shape[1]), surface.faces]).ravel()
        body = pyvista.PolyData(points, faces=faces)
        rgba = np.empty((len(points), 4), dtype=np.uint8)
        rgba[:, :3] = WALL_COLOUR
        rgba[:, 3] = strength * (1.0 - np.clip(surface.depth, 0.0, 1.0))
        body.point_data["colour"] = rgba
        meshes = [(body, self._plotter.add_mesh(body, scalars="colour", rgb=True, lighting=False, reset_camera=False))]
        if len(surface.edge):
            lines = np.column_stack([np.full(len(surface.edge), 2), surface.edge]).ravel()
            outline = pyvista.PolyData(points, lines=lines)
            actor = self._plotter.add_mesh(
                outline,
                color=EDGE_COLOUR,
                line_width=2.0 * self._factor,
                lighting=False,
                reset_camera=False,
            )
            meshes.append((outline, actor))
        return meshes

"""A closed surface of triangles: its file, what is inside, and where lines pass through it."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import pyvista


ON = 1e-6
"""Points nearer to the surface than this fraction of the bar lengths count as inside: those on it are inside."""


_SAME = 1e-9
"""Crossings of a bar closer than this fraction of it are one."""


@dataclass
class Surface:
    """Triangles that enclose a volume, with normals outwards from what is filled."""

    points: np.ndarray
    """(points, 3) float64 [m]."""
    triangles: np.ndarray
    """(triangles, 3) int64."""
    layers: list[np.ndarray] = field(default_factory=list)
    """Triangles of bodies that do not touch each other, if there are several such layers; a point is inside the surface
    where it is inside an odd number of them."""
    warnings: list[str] = field(default_factory=list)

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner (3,) [m] of the box around it."""
        return self.points.min(axis=0), self.points.max(axis=0)

    @property
    def volume(self) -> float:
        """The volume [m3] inside."""
        return volume_of(self.points, self.triangles)

    @property
    def area(self) -> float:
        """The area [m2] of the triangles."""
        return area_of(self.points, self.triangles)

    @cached_property
    def _data(self) -> list[pyvista.PolyData]:
        import pyvista

        layers = self.layers if len(self.layers) > 1 else [self.triangles]
        return [pyvista.PolyData.from_regular_faces(self.points, triangles) for triangles in layers]

    @cached_property
    def _locator(self) -> Any:
        import pyvista
        from vtkmodules.vtkCommonDataModel import vtkStaticCellLocator

        locator = vtkStaticCellLocator()
        locator.SetDataSet(pyvista.PolyData.from_regular_faces(self.points, self.triangles))
        locator.BuildLocator()
        return locator

    def distances(self, points: np.ndarray) -> np.ndarray:
        """Return the signed distances (n,) [m] of points (n, 3) from the surface: negative inside.

        Where bodies touch, the distance is that from the nearest of their surfaces.
        """
        import pyvista

        inside, nearest = np.zeros(len(points), bool), np.full(len(points), np.inf)
        for layer in self._data if len(points) else ():
            found = np.array(pyvista.PolyData(points).compute_implicit_distance(layer)["implicit_distance"])
            inside ^= found < 0.0
            nearest = np.minimum(nearest, np.abs(found))
        return np.where(inside, -nearest, nearest)

    def rough_distances(self, points: np.ndarray, spacing: float) -> np.ndarray:
        """Return signed distances (n,) [m] that are exact near the surface, and elsewhere too small, never too large.

        Points in one cube of 4 spacings get a bound from the distance of its middle, if that lies far enough from the
        surface: distances of two points differ by no more than they are apart.
        """
        edge = 4.0 * spacing
        reach = 0.5 * np.sqrt(3.0) * edge
        cubes = np.floor((points - self.bounds[0]) / edge).astype(np.int64)
        low = cubes.min(axis=0, initial=0)
        span = cubes.max(axis=0, initial=0) - low + 1
        key = np.ravel_multi_index(tuple((cubes - low).T), tuple(span)) if len(points) else np.empty(0, np.int64)
        _, first, of_cube = np.unique(key, return_index=True, return_inverse=True)
        middle = self.distances((cubes[first] + 0.5) * edge + self.bounds[0])
        bound = np.sign(middle) * (np.abs(middle) - reach)
        found = bound[of_cube]
        near = np.flatnonzero((np.abs(middle) < reach + 2.0 * spacing)[of_cube])
        found[near] = self.distances(points[near])
        return found

    def inside_parts(
        self, starts: np.ndarray, ends: np.ndarray, inside: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the parts of lines inside the surface.

        Parameters
        ----------
        starts, ends : (n, 3) float64 [m]
        inside : (n,) bool
            Lines that are inside entirely if they do not meet a triangle; the others are examined.

        Returns
        -------
        line : (parts,) int64
            Ascending.
        span : (parts, 2) float64
            Where each part begins and ends, from 0 (start) to 1 (end).
        """
        line, span, crossed = self.pieces(starts, ends)
        certain = np.zeros(len(starts), bool) if inside is None else inside & ~crossed
        way = ends - starts
        examined = np.flatnonzero(~certain[line])
        middles = starts[line[examined]] + span[examined].mean(axis=1)[:, None] * way[line[examined]]
        kept = certain[line]
        kept[examined] = self.distances(middles) <= ON * np.linalg.norm(way[line[examined]], axis=1)
        line, span = line[kept], span[kept]
        # parts that meet at a crossing that does not lead out of the surface are one
        joined = (line[1:] == line[:-1]) & (span[1:, 0] - span[:-1, 1] <= 2.0 * _SAME)
        first = np.flatnonzero(np.concatenate([[True], ~joined])[: len(line)])
        last = np.append(first[1:], len(line))[: len(first)] - 1
        return line[first], np.stack([span[first, 0], span[last, 1]], axis=1)

    def pieces(self, starts: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Divide lines where they meet triangles: the line of each piece, ascending, where it begins and ends, from 0
        to 1, and which lines (n,) meet some."""
        line, t = self._crossings(starts, ends)
        n = np.arange(len(starts))
        crossed = np.isin(n, line)
        line, t = np.concatenate([n, line, n]), np.concatenate([np.zeros(len(n)), t, np.ones(len(n))])
        order = np.lexsort((t, line))
        line, t = line[order], t[order]
        pieces = np.flatnonzero((line[1:] == line[:-1]) & (np.diff(t) > _SAME))
        line, span = line[pieces], np.stack([t[pieces], t[pieces + 1]], axis=1)
        # crossings next to an end or to each other are one
        span[span <= _SAME], span[span >= 1.0 - _SAME] = 0.0, 1.0
        return line, span, crossed

    def _crossings(self, starts: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the lines that intersect triangles, and where: from 0 at their start to 1 at their end."""
        from vtkmodules.vtkCommonCore import vtkIdList, vtkPoints

        points, cells, locator = vtkPoints(), vtkIdList(), self._locator
        points.SetDataTypeToDouble()
        lines: list[int] = []
        places: list[tuple[float, float, float]] = []
        for n, (a, b) in enumerate(zip(starts.tolist(), ends.tolist())):
            locator.IntersectWithLine(a, b, 0.0, points, cells)
            for k in range(points.GetNumberOfPoints()):
                lines.append(n)
                places.append(points.GetPoint(k))
        line, place = np.array(lines, np.int64), np.array(places).reshape(-1, 3)
        way = ends[line] - starts[line]
        along = np.einsum("ij,ij->i", place - starts[line], way) / np.einsum("ij,ij->i", way, way)
        return line, np.clip(along, 0.0, 1.0)


def area_of(points: np.ndarray, triangles: np.ndarray) -> float:
    """Return the area of triangles."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def volume_of(points: np.ndarray, triangles: np.ndarray) -> float:
    """Return the volume that closed triangles enclose, positive with normals outwards, by the divergence theorem."""
    a, b, c = (points[triangles[:, k]] - points.mean(axis=0) for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)

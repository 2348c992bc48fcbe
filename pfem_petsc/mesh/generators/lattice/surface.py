"""A closed surface of triangles in a file: its bodies, what is inside, and where lines pass through it."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ....errors import InputError
from ...tools import components
from .expressions import read_vtk

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
    bodies: list[np.ndarray] = field(default_factory=list)
    """Triangles of each body, with normals outwards from it as if there were no others; a point is inside the surface
    where it is inside an odd number of them."""
    warnings: list[str] = field(default_factory=list)

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner (3,) [m] of the box around it."""
        return self.points.min(axis=0), self.points.max(axis=0)

    @property
    def volume(self) -> float:
        """The volume [m3] inside, by the divergence theorem: positive with normals outwards."""
        a, b, c = (self.points[self.triangles[:, k]] - self.points.mean(axis=0) for k in range(3))
        return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)

    @property
    def area(self) -> float:
        """The area [m2] of the triangles."""
        a, b, c = (self.points[self.triangles[:, k]] for k in range(3))
        return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())

    @cached_property
    def _data(self) -> list[pyvista.PolyData]:
        """The whole surface, then its bodies if there are several."""
        import pyvista

        bodies = self.bodies if len(self.bodies) > 1 else []
        return [pyvista.PolyData.from_regular_faces(self.points, each) for each in (self.triangles, *bodies)]

    @cached_property
    def _locator(self) -> Any:
        from vtkmodules.vtkCommonDataModel import vtkStaticCellLocator

        locator = vtkStaticCellLocator()
        locator.SetDataSet(self._data[0])
        locator.BuildLocator()
        return locator

    def distances(self, points: np.ndarray) -> np.ndarray:
        """Return the signed distances (n,) [m] of points (n, 3) from the surface: negative inside.

        Where bodies touch, the distance is that from the nearest of their surfaces.
        """
        whole, *bodies = self._data
        found = _signed_distances(points, whole)
        if not bodies:
            return found
        inside = np.zeros(len(points), bool)  # where bodies touch, the nearest triangle does not tell
        for body, own in zip(bodies, self.bodies):
            low, high = self.points[own].min(axis=(0, 1)), self.points[own].max(axis=(0, 1))
            near = np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))
            inside[near] ^= _signed_distances(points[near], body) < 0.0
        return np.where(inside, -np.abs(found), np.abs(found))

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
            lines += [n] * points.GetNumberOfPoints()
            places += map(points.GetPoint, range(points.GetNumberOfPoints()))
        line, place = np.array(lines, np.int64), np.array(places).reshape(-1, 3)
        way = ends[line] - starts[line]
        along = np.einsum("ij,ij->i", place - starts[line], way) / np.einsum("ij,ij->i", way, way)
        return line, np.clip(along, 0.0, 1.0)


def _signed_distances(points: np.ndarray, body: pyvista.PolyData) -> np.ndarray:
    """Return the distances (n,) [m] of points (n, 3) from a body: negative inside."""
    import pyvista

    if len(points) == 0:
        return np.empty(0)
    return np.array(pyvista.PolyData(points).compute_implicit_distance(body)["implicit_distance"])


_SUFFIXES = (".stl", ".obj", ".ply")

_MERGED = 1e-7
"""Points of a file closer than this fraction of its diagonal are merged if it is not closed without that."""


_CLOSE = 1e-6
"""Points closer than this fraction of the diagonal of all bodies touch each other."""
_FLAT = 1e-9
"""Bodies with less volume than this fraction of their area times their size are left out."""


def bodies_of(points: np.ndarray, triangles: np.ndarray, where: str) -> Surface:
    """Return the surface of the bodies of triangles, every edge of which has an even number of them: by the even-odd
    rule outer bodies, cavities in them, bodies in these, and so on.

    Raises
    ------
    InputError
        Beginning with ``where``, if bodies intersect, if a body has no inner side, or if triangles at an edge cannot be
        assigned to bodies.
    """
    triangles, copies = _without_copies(triangles)
    twice = f"{copies} triangles are in the file more than once: bodies at the same place count as one"
    warnings = [twice] * bool(copies)
    parts, given = [], []
    for members, turned in _connected(points, triangles, where) if len(triangles) else ():
        own = triangles[members]
        own[turned] = own[turned, ::-1]
        body = Surface(points, own)
        volume = body.volume
        if abs(volume) <= _FLAT * body.area * float(np.ptp(points[own.ravel()], axis=0).max()):
            x = ", ".join(f"{coordinate:.6g}" for coordinate in points[own[0, 0]])
            warnings.append(f"left out {len(own)} triangles that enclose no volume, at ({x}) in the file")
            continue
        parts.append(own if volume > 0.0 else own[:, ::-1].copy())
        given.append(0 if turned.any() else np.sign(volume))
    if not parts:
        return Surface(points, np.empty((0, 3), np.int64))
    inside = _nested(points, parts, where)
    for i in np.flatnonzero(inside.any(axis=1)):
        (around,) = [j for j in np.flatnonzero(inside[i]) if inside[j].sum() == inside[i].sum() - 1]
        if given[i] == given[around] != 0:
            x = ", ".join(f"{coordinate:.6g}" for coordinate in points[parts[i][0, 0]])
            what = "a cavity" if inside[i].sum() % 2 else "filled"
            warnings.append(
                f"the body at ({x}) in the file lies in another one of the same orientation: it is taken as {what}"
            )
    turned = [own[:, ::-1] if depth % 2 else own for own, depth in zip(parts, inside.sum(axis=1))]  # cavities
    return Surface(points, np.concatenate(turned), parts, [f"{where}: {text}" for text in warnings])


def _without_copies(triangles: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the triangles, each once, and the number of others; of those with opposite normals, between two bodies, as
    many are left as one side has more."""
    _, same = np.unique(np.sort(triangles, axis=1), axis=0, return_inverse=True)
    same = same.ravel()
    lowest = triangles.argmin(axis=1)
    rows = np.arange(len(triangles))
    side = np.where(triangles[rows, (lowest + 1) % 3] < triangles[rows, (lowest + 2) % 3], 1, -1)
    net = np.bincount(same, side)[same]
    kept = np.flatnonzero(net * side > 0)
    once = np.sort(np.unique(same[kept], return_index=True)[1])
    return triangles[kept[once]], int((np.abs(net[kept[once]]) - 1).sum())


def _connected(points: np.ndarray, triangles: np.ndarray, where: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the numbers of the triangles of each body, connected by edges with two triangles, and which are turned
    against the first."""
    m = len(triangles)
    edges = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    forward, owner = edges[:, 0] < edges[:, 1], np.repeat(np.arange(m), 3)
    _, edge, count = np.unique(
        edges.min(axis=1) * len(points) + edges.max(axis=1), return_inverse=True, return_counts=True
    )
    order = np.argsort(edge, kind="stable")
    halves = order[count[edge[order]] == 2].reshape(-1, 2)
    one, two = owner[halves].T
    against = forward[halves[:, 0]] == forward[halves[:, 1]]
    # each triangle is in this graph twice: as it is, t, and turned, t + m
    pairs = [np.stack([one, two + m * against], axis=1), np.stack([one + m, two + m * ~against], axis=1)]
    part = components(2 * m, np.concatenate(pairs))
    if (part[:m] == part[m:]).any():
        x = ", ".join(f"{value:.6g}" for value in points[triangles[int((part[:m] == part[m:]).argmax()), 0]])
        raise InputError(f"{where}: the surface at ({x}) has one side only, like a Möbius strip: correct its triangles")
    body, turned = np.minimum(part[:m], part[m:]), part[:m] > part[m:]
    _, own = np.unique(body[owner] * len(count) + edge, return_inverse=True)
    balance = np.bincount(own, np.where(forward ^ turned[owner], 1, -1))[own]
    if balance.any():
        half = int(np.flatnonzero(balance)[0])
        a, b = (", ".join(f"{x:.6g}" for x in points[node]) for node in edges[half])
        raise InputError(
            f"{where}: the edge from ({a}) to ({b}) in the file has {count[edge[half]]} triangles, and it is not known "
            "which of them belong to one body: unite bodies that touch in the program that made it"
        )
    order = np.argsort(body, kind="stable")
    starts = np.flatnonzero(np.diff(body[order], prepend=-1))
    return [(members, turned[members]) for members in np.split(order, starts[1:])]


def _nested(points: np.ndarray, parts: list[np.ndarray], where: str) -> np.ndarray:
    """Return (bodies, bodies) bool: whether the first lies in the second."""
    n = len(parts)
    inside = np.zeros((n, n), bool)
    corners = [points[own.ravel()] for own in parts]
    low, high = np.stack([own.min(axis=0) for own in corners]), np.stack([own.max(axis=0) for own in corners])
    close = _CLOSE * float(np.linalg.norm(high.max(axis=0) - low.min(axis=0)))
    for j in range(n):
        near = ((low <= high[j] + close) & (high >= low[j] - close)).all(axis=1)
        near[j] = False
        surface = Surface(points, parts[j])
        for i in np.flatnonzero(near):
            sides = _sides(points, parts[i], surface, close)
            if len(sides) != 1:
                a, b = (", ".join(f"{x:.6g}" for x in points[parts[k][0, 0]]) for k in (i, j))
                raise InputError(
                    f"{where}: two bodies intersect, one of which has the corner ({a}) in the file, the other ({b}): "
                    "unite them in the program that made it"
                )
            inside[i, j] = sides == {-1}
    return inside


def _sides(points: np.ndarray, own: np.ndarray, other: Surface, close: float) -> set[int]:
    """Return on which sides of another body the edges of one are, -1 inside and 1 outside."""
    edges = np.concatenate([own[:, [0, 1]], own[:, [1, 2]], own[:, [2, 0]]])
    edges = edges[edges[:, 0] < edges[:, 1]]
    ends = points[edges]
    low, high = other.bounds
    near = ((ends.min(axis=1) <= high + close) & (ends.max(axis=1) >= low - close)).all(axis=1)
    starts, stops = ends[near, 0], ends[near, 1]
    line, span, _ = other.pieces(starts, stops)
    distance = other.distances(starts[line] + span.mean(axis=1)[:, None] * (stops - starts)[line])
    return {*np.sign(distance[np.abs(distance) > close]).astype(int).tolist(), *([] if near.all() else [1])}


def read_surface(path: Path, scale: float) -> Surface:
    """Read a surface; to be called on one rank.

    Raises
    ------
    InputError
        If the file is not there, is not of triangles, or the surface is open.
    """
    where = f"mesh.surface.file: {path}"
    if path.suffix.lower() not in _SUFFIXES:
        raise InputError(f"{where}: no reader for {path.suffix or 'no suffix'}; known: {', '.join(_SUFFIXES)}")
    data = read_vtk(path, where)
    points, triangles = _triangles(data)
    if len(triangles) == 0 or not np.isfinite(points).all():
        raise InputError(f"{where}: no surface of triangles could be read from it")
    count, edge = _open_edges(triangles)
    if count:
        merged = _triangles(data, _MERGED)
        fewer, other = _open_edges(merged[1])
        if len(merged[1]) and fewer < count:  # a surface that has lost all triangles is no better
            (points, triangles), count, edge = merged, fewer, other
    if count:
        a, b = (", ".join(f"{x:.6g}" for x in points[node]) for node in edge)
        raise InputError(
            f"{where}: the surface is not closed: {count} of its edges have a triangle on one side only, like that "
            f"from ({a}) to ({b}) in the file; close it in the program that made it (PyVista: mesh.fill_holes(size))"
        )
    surface = bodies_of(points, triangles, where)
    if not surface.bodies:
        raise InputError(f"{where}: the surface encloses no volume")
    surface.points = scale * points
    return surface


def _triangles(data: pyvista.PolyData, tolerance: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return points and triangles; points within the tolerance, in diagonals, are merged, flat triangles left out."""
    data = data.triangulate()
    if data.n_cells == 0:
        return np.empty((0, 3)), np.empty((0, 3), np.int64)
    data = data.clean(tolerance=tolerance, absolute=False)
    corners = data.faces.reshape(-1, 4)[:, 1:].astype(np.int64)
    return np.array(data.points, np.float64), corners[(corners != np.roll(corners, 1, axis=1)).all(axis=1)]


def _open_edges(triangles: np.ndarray) -> tuple[int, np.ndarray]:
    """Return how many edges have an odd number of triangles, and the first of them."""
    edges = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    pairs, count = np.unique(edges, axis=0, return_counts=True)
    wrong = pairs[count % 2 == 1]
    return len(wrong), wrong[0] if len(wrong) else np.empty(0, np.int64)

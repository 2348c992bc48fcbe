"""A surface of triangles from a file, convex or not, closed or open; nodes stay in front of it, or on either side."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import ValidationInfo, model_validator

from ...case.base import Digest, FileName, PositiveFloat, Vector3
from ...case.files import digest_of, found_file
from ...case.toml import value_text
from ...errors import InputError
from ...formats import read_triangles
from ...mechanics.compiled import by_reference
from ...mesh.tools import coincident
from ..triangles import Triangles, stopping_faces, tangent_planes
from .base import BaseWall, Surface, WallKeys

SAME = 1e-9
"""Points closer than this fraction of the size of the surface are one, and triangles of less height are lines."""

_SIZES = 1e-100, 1e100
"""Sizes [m] between which products of lengths are numbers."""

_THIN = 1e-6
"""Thickness of sheets that stop nodes from either side, as a fraction of their size, unless it is given."""

_APART = 1e-3
"""Distance of both ends from an open surface, as a fraction of their length, beyond which bars through it are."""

_SHARP = 0.7
"""Cosine between the normals at an edge, below which pictures show it."""


class Parameters(WallKeys):
    """Keys of a surface of triangles."""

    file: FileName
    """STL, OBJ or PLY file with the surface, relative to the case file"""
    scale: PositiveFloat = 1.0
    """metres per unit of length of the file"""
    point: Vector3 = (0.0, 0.0, 0.0)
    """where the origin of the file is [m]"""
    side: Literal["front", "both"] = "front"
    """where nodes may be: in front of the triangles, whose corners are then counter-clockwise, or on either side"""
    flip: bool = False
    """true: the front is where the file has the back"""
    thickness: PositiveFloat | None = None
    """of a surface that stops nodes from both sides [m], half of it on each; default: 1e-6 of its size"""
    digest: Digest | None = None
    """SHA-256 of the content of the file, which results and checkpoints keep; default: that of the file"""

    @model_validator(mode="after")
    def _found(self, info: ValidationInfo) -> Parameters:
        if self.side == "front" and self.thickness is not None:
            raise ValueError('thickness is that of a surface with side = "both"')
        if self.side == "both" and self.flip:
            raise ValueError('flip has no effect on a surface with side = "both"')
        if self.inertia is not None and self.centre_of_mass is None:
            raise ValueError("inertia of a surface of triangles needs its centre_of_mass [m]")
        if info.context is not None:
            self._take(**found_file(self.file, self.digest, info.context.folder))
        return self


class Wall(BaseWall):
    """Triangles where the file has them.

    Attributes
    ----------
    triangles, compiled : :class:`~pfem_petsc.contact.triangles.Triangles`, as they are and for loops
    points : (n, 3) float64 [m]; corners : (t, 3) int64
    closed : whether every edge has two triangles; then nodes behind the surface are inside a body
    note : what the check before a run tells of it
    """

    faces = 3

    def __init__(self, parameters: Parameters) -> None:
        path, where = Path(parameters.file), f"file = {value_text(parameters.file)}: "
        try:
            points, corners = read_triangles(path)
        except InputError as error:
            raise InputError(f"{where}{error}") from error
        if parameters.digest and parameters.digest != digest_of(path):
            raise InputError(
                f"{where}is not the file that the case was made with (digest {parameters.digest[:12]}...): "
                "restore it, or start a new run without the key digest"
            )
        self.points, self.corners, self._edges = checked(points, corners, where)
        size = parameters.scale * float(np.ptp(self.points, axis=0).max())
        if not _SIZES[0] <= size <= _SIZES[1]:
            raise InputError(
                f"{where}the surface is {size:.3g} m large, whose square double precision cannot hold; correct "
                f"the wall's scale = {parameters.scale!r}, metres per unit of length of the file"
            )
        self.points = parameters.scale * self.points + np.array(parameters.point)
        if parameters.flip:
            self.corners = self.corners[:, ::-1].copy()
        both = parameters.side == "both"
        extents = np.sort(np.ptp(self.points, axis=0))
        thickness = _THIN * extents[2] if parameters.thickness is None else parameters.thickness
        self.triangles = Triangles.of(self.points, self.corners, both, 0.5 * thickness * both)
        self.compiled = by_reference(self.triangles)
        self.closed = bool((self._edges[1] == 2).all())
        self.note = f", {len(self.corners)} triangles, {'closed' if self.closed else 'open'}"
        self.centre = 0.5 * (self.points.min(axis=0) + self.points.max(axis=0))
        a, b, c = (self.points[self.corners[:, k]] - self.centre for k in range(3))
        self.solid = parameters.thickness is not None if both else self.closed
        holds = self.closed and not both and np.einsum("ti,ti->", a, np.cross(b, c)) < 0.0  # nodes are inside
        self.width = np.inf if holds else extents[0 if self.closed else 1]
        self.thickness = thickness if both else None

    def _tangents(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return :func:`~pfem_petsc.contact.triangles.tangent_planes` of positions (m, 3)."""
        found = np.empty((len(x), 3)), np.empty(len(x)), np.empty(len(x))
        tangent_planes(self.compiled, np.ascontiguousarray(x), *found)
        return found

    def planes(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self._tangents(x)[:2]

    def gaps(self, x: np.ndarray) -> np.ndarray:
        """Return the distances (m,) of positions (m, 3) from the surface [m]: negative inside a body, without a sign
        where the surface is open, because what is behind it may have come there beside it."""
        distances = self._tangents(x)[2]
        return distances if self.closed or self.triangles.limits[0, 0] else np.abs(distances)

    def crossed(self, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """Return (m,) bool: bars from ``starts`` to ``ends`` (m, 3) that are deep in a body, or pass through another
        surface with both ends away from it."""
        if self.solid:
            return super().crossed(starts, ends)
        apart = np.minimum(self.gaps(starts), self.gaps(ends)) > _APART * np.linalg.norm(ends - starts, axis=1)
        n = len(starts)
        free, normals, offsets = np.zeros((n, 3), dtype=bool), np.empty((n, 3, 3)), np.empty((2, n, 3))
        for k, ways in enumerate((np.stack([starts, ends]), np.stack([ends, starts]))):
            stopping_faces(self.compiled, ways, free, np.zeros(n), normals, offsets[k])
        return apart & np.isfinite(offsets).any(axis=(0, 2))


def checked(
    points: np.ndarray, corners: np.ndarray, where: str
) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return the points (n, 3) of a surface, those at one place once, the corners (t, 3) of its triangles, without
    those that have two corners at one place, and its edges: ends (e, 2), numbers of triangles (e,), of sides (t, 3).

    Raises
    ------
    InputError
        Beginning with ``where``, if triangles are lines, two are the same, three meet at an edge, or the two at an edge
        do not have the same side in front.
    """
    size = float(np.ptp(points[corners].reshape(-1, 3), axis=0).max())
    if not 0.0 < size < np.inf:
        raise InputError(f"{where}all points of the surface are at one place, or too far away")
    kept, corners = np.unique(coincident(points, SAME * size)[corners], return_inverse=True)
    points, corners = points[kept], corners.reshape(-1, 3)
    corners = corners[(corners != np.roll(corners, 1, axis=1)).all(axis=1)]

    def refused(what: str, wrong: np.ndarray, ends: np.ndarray, way_out: str) -> None:
        if len(wrong):
            at = " to ".join(f"({', '.join(f'{x:.6g}' for x in points[end])})" for end in ends[wrong[0]])
            raise InputError(f"{where}{what}, at {at} in the file ({len(wrong)} such places): {way_out}")

    sides = np.roll(points[corners], -1, axis=1) - points[corners]
    heights = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) / np.linalg.norm(sides, axis=2).max(axis=1)
    remesh = "repair it in the program that made it (in MeshLab: Filters, Cleaning and Repairing)"
    refused("a triangle is a line", np.flatnonzero(heights <= SAME * size), corners, remesh)
    directed = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2)
    n = len(points)
    keys, number, count = np.unique(np.sort(directed, axis=1) @ [n, 1], return_inverse=True, return_counts=True)
    ends, number = np.stack([keys // n, keys % n], axis=1), number.ravel()
    two = np.sort(number.reshape(-1, 3), axis=1)[:, :2] @ [len(keys), 1]  # edges, which determine a triangle
    twice = np.setdiff1d(np.arange(len(corners)), np.unique(two, return_index=True)[1])
    refused("a triangle is in the file twice", twice, corners, remesh)
    apart = "divide it into surfaces of walls of their own"
    refused("more than two triangles meet at an edge", np.flatnonzero(count > 2), ends, apart)
    turns = np.bincount(number, np.where(directed[:, 0] < directed[:, 1], 1, -1))
    turned = np.flatnonzero((count == 2) & (turns != 0))
    uniform = "orient them the same way (in PyVista: mesh.compute_normals(consistent_normals=True))"
    refused("two triangles have opposite sides in front at their edge", turned, ends, uniform)
    if not len(corners):
        raise InputError(f"{where}has no triangles that are not points or lines")
    return points, corners, (ends, count, number.reshape(-1, 3))


def surface(parameters: Parameters, bounds: np.ndarray) -> Surface:
    """Return the triangles for pictures, outlined at their border and sharp edges."""
    wall = Wall(parameters)
    ends, count, number = wall._edges
    a, b, c = (wall.points[wall.corners[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    total = np.zeros((len(ends), 3))
    np.add.at(total, number.ravel(), np.repeat(normals, 3, axis=0))
    # the sum of two unit vectors has the squared length 2 + 2 cos
    points, lines = wall.points, ends[(count == 1) | ((total**2).sum(axis=1) < 2.0 + 2.0 * _SHARP)]
    if not len(lines):
        points, lines = _with_sections(points, ends, number, wall.centre)
    return Surface(parameters.name, points, wall.corners, np.zeros(len(points)), lines)


def _with_sections(
    points: np.ndarray, ends: np.ndarray, number: np.ndarray, centre: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return points, and the lines (e, 2) where planes across the axes through the centre intersect triangles, from
    which one sees that a surface is round; ``ends`` (e, 2) of edges, ``number`` (t, 3) of the sides of triangles."""
    every, lines = [points], []
    for axis in range(3):
        heights = points[ends, axis] - centre[axis]
        cut = (heights[:, 0] >= 0.0) != (heights[:, 1] >= 0.0)
        part = heights[cut, :1] / (heights[cut, :1] - heights[cut, 1:])
        place = np.cumsum(cut) - 1 + sum(map(len, every))
        every.append(points[ends[cut, 0]] + part * (points[ends[cut, 1]] - points[ends[cut, 0]]))
        lines.append(place[number[cut[number]]].reshape(-1, 2))  # each triangle has two sides of these, or none
    points, drawn = np.concatenate(every), np.concatenate(lines)
    return points, drawn[(points[drawn[:, 0]] != points[drawn[:, 1]]).any(axis=1)]

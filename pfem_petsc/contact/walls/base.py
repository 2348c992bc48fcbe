"""Base classes of wall types: keys, surface at rest, motion, and the shapes that pictures draw."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Field, field_validator, model_validator

from ...case.base import (
    Finite,
    Inertia,
    PositiveFloat,
    StrictModel,
    SurfaceKeys,
    Table2,
    Table4,
    Vector3,
    WallParameters,
)
from ...errors import InputError, raised
from ...registry import added_file, lookup
from ..plugins import checked

WALLS = "pfem_petsc.contact.walls"
"""The package of the walls."""

_ALIKE = 1e-6
"""Relative difference up to which numbers of a file count as equal."""

_DEEP = 0.125
"""Depth of bars in a body, as a fraction of its width, beyond which they are reported."""
_SAMPLES = 9
"""Places along a bar at which the least distance is looked for first."""
_ROUNDS = 16
"""Most steps from there to where it is; the last one, an odd one from zero, finds edges."""
_SAME = 1e-15
"""Part of the length to which that is found, and slope of the distance that counts as none."""
_AT_END = 1e-7
"""Part of the length next to an end of a bar, where walls stop the node."""


def has_length(value: tuple[float, float, float], what: str) -> tuple[float, float, float]:
    """Check that a vector has nonzero length; return it."""
    largest = max(map(abs, value))
    if not largest > 0.0:
        raise ValueError(f"has zero length; give {what}")
    if not 1e-100 < largest < 1e100:
        # the squares of its components would overflow or vanish
        raise ValueError(f"has components out of range (1e-100 to 1e100); give {what} as a vector of about length 1")
    return value


def direction(what: str) -> AfterValidator:
    """Annotation of a vector that gives a direction, which messages call ``what``."""
    return AfterValidator(lambda value: has_length(value, what))


class Hinge(StrictModel):
    """An axis fixed in space about which a wall with inertia turns freely."""

    centre: Vector3
    """a point of the axis at rest [m]; that of a rotation moves with the wall"""
    axis: Vector3
    """direction of the axis, of any nonzero length"""

    @field_validator("axis")
    @classmethod
    def _has_length(cls, value: tuple[float, float, float]) -> tuple[float, float, float]:
        return has_length(value, f"the direction of the axis of the {cls.__name__.lower()}")


class Rotation(Hinge):
    """Rotation of a wall about an axis."""

    exactly_one = (("angular_velocity", "angles"),)

    angular_velocity: Finite | None = None
    """constant angular velocity [rad/s], by the right-hand rule"""
    angles: Table2 | None = None
    """rows [t, angle]: rotation from rest [s, rad], at rest before the first and after the last"""
    interpolation: Literal["smooth", "linear"] = "smooth"
    """interpolation of ``angles`` between its rows: a cubic spline, or straight lines with velocity jumps at rows"""


class WallKeys(SurfaceKeys, WallParameters):
    """Keys that all wall types share."""

    velocity: Vector3 | None = None
    """velocity of the wall [m/s]: constant, or the initial one of a wall with mass"""
    rotation: Rotation | None = None
    """rotation of the wall about an axis, as prescribed; beside ``velocity``, ``motion`` or ``mass``, which move it"""
    mass: PositiveFloat | None = None
    """mass [kg] of a wall that moves under the contact forces; they turn it if it has ``inertia``"""
    inertia: Inertia | None = None
    """moments of inertia [kg m2] of a wall with mass that turns under the contact forces, about the centre of mass:
    [Ix, Iy, Iz] for principal axes along those of space at rest, or the rows of the symmetric matrix"""
    centre_of_mass: Vector3 | None = None
    """centre of mass of a wall with inertia, at rest [m]; default: the centre of a sphere or rectangle, the point of a
    plane or cylinder"""
    angular_velocity: Vector3 | None = None
    """initial angular velocity [rad/s] of a wall with inertia, by the right-hand rule"""
    hinge: Hinge | None = None
    """axis about which alone a wall with inertia turns"""
    gravity: bool = False
    """true: gravity acts on a wall with mass, as on the truss"""
    motion: Table4 | None = None
    """rows [t, dx, dy, dz]: displacement of the wall [s, m], at rest before the first and after the last"""
    motion_file: Annotated[str, Field(min_length=1)] | None = None
    """the rows of ``motion`` from the columns of a CSV or NPZ file: its name, or a table"""
    interpolation: Literal["smooth", "linear"] = "smooth"
    """interpolation of ``motion`` between its rows: a cubic spline, or straight lines with velocity jumps at rows"""
    adjust: bool = False
    """true: nodes that start beyond the wall are moved onto it, unstressed bars included"""

    tied: bool = False
    """true: a node that touches the wall is fixed to it from then on, in all directions"""

    @model_validator(mode="after")
    def _moves_one_way(self) -> WallKeys:
        turning = [key for key in ("centre_of_mass", "angular_velocity", "hinge") if getattr(self, key) is not None]
        for wrong, text in (
            (
                self.velocity is not None and self.motion is not None,
                "expected at most one of the keys velocity, motion",
            ),
            (self.interpolation == "linear" and self.motion is None, 'interpolation = "linear" requires motion'),
            (self.gravity and self.mass is None, "gravity = true needs the wall's mass [kg]"),
            (self.mass is not None and self.motion is not None, "expected at most one of the keys mass, motion"),
            (
                turning and self.inertia is None,
                f"{''.join(turning[:1])} is that of a wall with inertia [kg m2], which this wall has not",
            ),
            (self.inertia is not None and self.mass is None, "inertia needs the wall's mass [kg]"),
            (
                self.inertia is not None and self.rotation is not None,
                "expected at most one of the keys inertia, rotation",
            ),
        ):
            if wrong:
                raise ValueError(text)
        if self.inertia is not None:
            self._check_inertia()
        if self.tied and (self.friction or self.static_friction or self.restitution):
            raise ValueError("a tied wall cannot have friction or restitution: nodes neither slip nor leave")
        return self

    def _check_inertia(self) -> None:
        tensor = self.tensor
        moments = np.linalg.eigvalsh(tensor)
        hinge = self.hinge and self.hinge.axis
        spin, axis = (np.array(each or (0.0, 0.0, 0.0)) for each in (self.angular_velocity, hinge))
        for wrong, text in (
            (
                np.abs(tensor - tensor.T).max() > _ALIKE * np.abs(tensor).max(),
                f"inertia is not symmetric: {tensor.tolist()}",
            ),
            (
                moments[0] <= 0.0 or moments[2] > (1.0 + _ALIKE) * (moments[0] + moments[1]),
                f"inertia has the principal moments {', '.join(f'{moment:.4g}' for moment in moments)} kg m2, which no "
                "body has: they must be positive, and none larger than the sum of the others",
            ),
            (self.hinge is not None and self.velocity is not None, "expected at most one of the keys hinge, velocity"),
            (
                np.linalg.norm(np.cross(spin, axis)) > _ALIKE * np.linalg.norm(spin) * np.linalg.norm(axis),
                "angular_velocity must be along the axis of the hinge",
            ),
        ):
            if wrong:
                raise ValueError(text)

    @property
    def tensor(self) -> np.ndarray:
        """The matrix (3, 3) of :attr:`inertia` [kg m2]."""
        given = np.array(self.inertia)
        return np.diag(given) if given.ndim == 1 else given


class BaseWall(ABC):
    """The surface of a wall at rest: nodes stay where n . x >= d, with the unit normals n and offsets d of its tangent
    planes.

    Attributes
    ----------
    flat : whether the tangent plane is the same everywhere; then ``normal`` (3,) and ``offset`` [m] are that plane
    partial : whether nodes can pass beside it, so that their previous positions matter (:meth:`stops`)
    solid : whether bars can be deep in it, and be pushed out, rather than cross it
    faces : how many planes a node can touch at once; more than one for a surface of triangles
    width : smallest extent [m] of a wall that bars can cross between their nodes, infinite for others
    thickness : of a sheet [m], None of others
    centre : (3,) [m], the point whose position is recorded if the wall moves
    """

    flat = False
    partial = False
    solid = True
    faces = 1
    width = np.inf
    thickness: float | None = None
    centre: np.ndarray

    @abstractmethod
    def planes(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the tangent planes nearest to positions (m, 3) [m]: unit normals (m, 3) and offsets (m,) [m].

        The normals have the length 1 and point to the allowed side, n . x >= d; n . x - d is the distance of x from
        the surface [m], negative beyond it. m may be zero.
        """

    def gaps(self, x: np.ndarray) -> np.ndarray:
        """Return the distances (m,) of positions (m, 3) from the surface [m], n . x - d. Curved walls far from the
        origin lose digits in that difference, and compute it from positions relative to their centre."""
        normals, offsets = self.planes(x)
        return np.einsum("ij,ij->i", normals, x) - offsets

    def stops(self, before: np.ndarray, x: np.ndarray, tolerance: float) -> np.ndarray:
        """Return (m,) bool: nodes that the wall stops between ``before`` (m, 3) and ``x`` (m, 3); for partial walls."""
        return np.ones(len(x), dtype=bool)

    def crossed(self, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """Return (m,) bool: bars from ``starts`` to ``ends`` (m, 3) that intersect a wall of finite width."""
        return self.deepest(np.stack([starts, ends], axis=1))[1] < -_DEEP * self.depth

    def deepest(self, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return where between their ends (m, 2, 3) bars are deepest beyond the wall, from 0 to 1, and the distances
        there (m,) [m]; infinite where that is at an end, which walls stop as a node, and of bars that are far from it.
        """
        where, least, along = np.zeros(len(ends)), np.full(len(ends), np.inf), ends[:, 1] - ends[:, 0]
        # the distance changes along a bar by no more than the way
        lengths = np.linalg.norm(along, axis=1)
        near = np.flatnonzero(self.gaps(ends.mean(axis=1)) <= 0.5 * lengths)
        if not len(near):
            return where, least
        start, along, lengths, places = ends[near, 0], along[near], lengths[near], np.linspace(0.0, 1.0, _SAMPLES)
        best = np.stack([self.gaps(start + t * along) for t in places]).argmin(axis=0)

        def tangents(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            points = start + t[:, None] * along
            normals, offsets = self.planes(points)
            return np.einsum("mi,mi->m", normals, along), np.einsum("mi,mi->m", normals, points) - offsets

        # where the distance begins to grow along the bar: where a line through the slopes at both sides has the root,
        # which finds it on round walls, in turn with where tangents meet, which finds edges
        low, high = places[np.maximum(best - 1, 0)], places[np.minimum(best + 1, _SAMPLES - 1)]
        (falling, before), (rising, after) = tangents(low), tangents(high)
        last = low
        for k in range(_ROUNDS):
            between = np.maximum(rising - falling, 1e-300)
            t = (low * rising - high * falling) / between
            if k % 2:
                t = (before - after + high * rising - low * falling) / between
            t = np.clip(t, low, high)
            slope, gap = tangents(t)
            falls = slope < 0.0
            low, falling, before = (np.where(falls, *pair) for pair in ((t, low), (slope, falling), (gap, before)))
            high, rising, after = (np.where(falls, *pair) for pair in ((high, t), (rising, slope), (after, gap)))
            if ((np.abs(t - last) < _SAME) | (high - low < _SAME) | (np.abs(slope) < _SAME * lengths)).all():
                break
            last = t
        between, gaps = (t > _AT_END) & (t < 1.0 - _AT_END), self.gaps(start + t[:, None] * along)
        where[near], least[near] = t, np.where(between, gaps, np.inf)
        return where, least

    @property
    def depth(self) -> float:
        """Extent [m] of a solid wall where bars are across it: the thickness of a sheet, else the width."""
        return self.width if self.thickness is None else self.thickness


class RoundWall(BaseWall):
    """The sphere |x - c| = R, or with an axis a the cylinder |(I - a a^T) (x - c)| = R; compiled loops know both, see
    :func:`~pfem_petsc.contact.surfaces.tangent`.

    Attributes
    ----------
    axis : (3,) unit vector, zero for a sphere
    radius : R [m]; sign : 1.0 if nodes stay outside, -1.0 inside
    across : (3,) unit vector, the normal at the centre or axis itself
    """

    def __init__(self, parameters: Any, axis: np.ndarray, across: np.ndarray) -> None:
        self.centre = np.array(parameters.point, dtype=np.float64)
        self.axis, self.across = axis, across
        self.radius = parameters.radius
        self.sign = 1.0 if parameters.side == "outside" else -1.0
        self.width = 2.0 * self.radius if self.sign > 0.0 else np.inf

    def _arms(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the vectors from the centre or axis to positions, and their lengths."""
        arm = x - self.centre
        arm -= np.multiply.outer(arm @ self.axis, self.axis)
        return arm, np.linalg.norm(arm, axis=1)

    def planes(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        arm, length = self._arms(x)
        far = length[:, None] > 1e-12 * self.radius
        normals = np.where(far, arm / np.maximum(length, 1e-300)[:, None], self.across)
        return self.sign * normals, self.sign * (np.einsum("ij,ij->i", normals, x - arm) + self.radius)

    def gaps(self, x: np.ndarray) -> np.ndarray:
        return self.sign * (self._arms(x)[1] - self.radius)


def made_wall(parameters: WallKeys, x: np.ndarray, key: str) -> BaseWall:
    """Return the wall of its keys, after a look at what it gives for positions (m, 3) [m].

    Raises
    ------
    InputError
        If a key is wrong, beginning with the file and the ``key`` of the wall's table, or a class that is not of the
        program does not do what :class:`BaseWall` says.
    """
    module = lookup(WALLS, parameters.type, "wall.type")
    file = added_file(WALLS, parameters.type)
    if not file:
        try:
            return module.Wall(parameters)
        except InputError as error:  # a wall knows its keys, but not the file that they are in
            raise InputError(f"{key}.{error}") from error
    try:
        wall = module.Wall(parameters)
        flaw = _flaw(wall, x)
    except Exception as error:  # noqa: BLE001 - of a user
        flaw = f"it {raised(error, file)}"
    if flaw:
        raise InputError(f"wall {parameters.name!r}: {file}: the class Wall: {flaw}")
    for name in ("planes", "gaps"):
        setattr(wall, name, checked(getattr(wall, name), f"wall {parameters.name!r}: {file}: {name}"))
    return wall


def _flaw(wall: BaseWall, x: np.ndarray) -> str:
    """Return how a wall differs from what :class:`BaseWall` says, empty if it does not."""
    if np.shape(wall.centre) != (3,):
        return f"its centre is {wall.centre!r:.80}; it must be an array (3,)"
    if wall.flat and not (
        np.shape(wall.normal) == (3,) and abs(np.linalg.norm(wall.normal) - 1.0) < 1e-6 and np.isfinite(wall.offset)
    ):
        return f"its normal is {wall.normal!r:.80} and its offset {wall.offset!r:.80}; give a unit vector and a number"
    must = "it must return unit normals (m, 3) and offsets (m,) for positions (m, 3)"
    planes = wall.planes(x)
    shapes = [np.shape(each) for each in planes] if isinstance(planes, tuple) else type(planes).__name__
    if shapes != [x.shape, x.shape[:1]]:
        return f"planes returned {shapes} for positions {x.shape}; {must}"
    normals, offsets = map(np.asarray, planes)
    right = (np.abs(np.linalg.norm(normals, axis=1) - 1.0) < 1e-6) & np.isfinite(offsets)
    if not right.all():
        at = int(np.argmin(right))
        found = f"the normal {normals[at].tolist()} and the offset {offsets[at]} at {x[at].tolist()}"
        return f"planes returned {found}; {must}"
    return ""


@dataclass(frozen=True)
class Surface:
    """Polygons of a wall for pictures, with the depth of each point beyond the face.

    Parameters
    ----------
    name : the wall's name
    points : (n, 3) float64 [m]
    faces : (f, 4) or (f, 3) int64, corners of quadrilaterals or triangles
    depth : (n,) float64, 0 on the face that nodes touch, 1 where the picture fades out
    edge : (e, 2) int64, lines that outline the face
    """

    name: str
    points: np.ndarray
    faces: np.ndarray
    depth: np.ndarray
    edge: np.ndarray


def slab(name: str, face: np.ndarray, normal: np.ndarray, thickness: float) -> Surface:
    """Return a slab behind a quadrilateral face (4, 3) [m] whose unit normal points to the allowed side."""
    return Surface(
        name,
        np.concatenate([face, face - thickness * normal]),
        np.array([[0, 1, 2, 3], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]]),
        depth=np.repeat([0.0, 1.0], 4),
        edge=np.array([[0, 1], [1, 2], [2, 3], [3, 0]]),
    )


def perpendicular(axis: np.ndarray) -> np.ndarray:
    """Return a unit vector across an axis."""
    across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    return across / np.linalg.norm(across)


def revolved(name: str, profile: np.ndarray, centre: np.ndarray, axis: np.ndarray, segments: int = 48) -> Surface:
    """Return the surface of revolution of a profile (p, 2), radius and height [m], about an axis through ``centre``."""
    first = perpendicular(axis)
    second = np.cross(axis, first)
    angles = 2.0 * np.pi * np.arange(segments) / segments
    around = np.multiply.outer(np.cos(angles), first) + np.multiply.outer(np.sin(angles), second)
    points = centre + profile[:, None, :1] * around + profile[:, None, 1:] * axis
    rings = np.arange(len(profile) * segments).reshape(len(profile), segments)
    after = np.roll(rings, -1, axis=1)
    faces = np.stack([rings[:-1], after[:-1], after[1:], rings[1:]], axis=2).reshape(-1, 4)
    edge = np.concatenate([np.stack([rings[k], after[k]], axis=1) for k in (0, -1)])
    return Surface(name, points.reshape(-1, 3), faces, depth=np.zeros(points.shape[0] * segments), edge=edge)

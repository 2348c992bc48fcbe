"""Planes, spheres and cylinders in compiled loops: normals and distances of nodes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np

from ..mechanics.compiled import inlined, kernel, record
from .rotations import along, dot, minus, put, times, vector
from .walls.base import BaseWall, RoundWall

OTHER = np.inf
"""Radius of walls that are neither flat nor round, which compiled loops do not know."""


@record
class Surfaces(NamedTuple):
    """Walls (w,) where they are at a time.

    Attributes
    ----------
    normals : (w, 3) of planes; of round walls at the centre itself
    offsets : (w,) of planes n . x = d [m]
    centres, axes : (w, 3) of round walls [m]; the axis is zero for a sphere
    radii : (w,) positive where nodes stay outside, negative where inside, zero for planes [m]; ``OTHER``
    """

    normals: np.ndarray
    offsets: np.ndarray
    centres: np.ndarray
    axes: np.ndarray
    radii: np.ndarray

    @classmethod
    def of(cls, walls: Sequence[BaseWall], turning: np.ndarray) -> Self:
        """Return the surfaces of walls at rest; ``turning`` (w,) bool: walls that turn, which are other ones."""
        normals, centres, axes = np.zeros((3, len(walls), 3))
        made = cls(normals, np.zeros(len(walls)), centres, axes, np.full(len(walls), OTHER))
        for k in np.flatnonzero(~turning):
            wall, kind = walls[k], type(walls[k])
            if wall.flat:
                made.normals[k], made.offsets[k], made.radii[k] = wall.normal, wall.offset, 0.0
            # a class that derives from such a wall may be another surface
            elif (kind.planes, kind.gaps) == (RoundWall.planes, RoundWall.gaps):
                made.normals[k], made.axes[k] = wall.sign * wall.across, wall.axis
                made.centres[k], made.radii[k] = wall.centre, wall.sign * wall.radius
        return made

    def copy(self) -> Self:
        """Return these surfaces to be moved, see :func:`~pfem_petsc.stepping.contact_phase.place_walls`."""
        return self._replace(offsets=self.offsets.copy(), centres=self.centres.copy())

    def at(self, displacements: np.ndarray) -> Self:
        """Return the surfaces of walls with displacements (w, 3) [m]."""
        offsets = self.offsets + np.einsum("ij,ij->i", self.normals, displacements)
        return self._replace(offsets=offsets, centres=self.centres + displacements)


@inlined
def is_round(radius):
    """Return whether a wall with one of the ``radii`` of :class:`Surfaces` is a sphere or a cylinder."""
    return (radius != 0.0) & (radius != OTHER)


@inlined
def beyond(normal, offset, place):
    """Return the distance of a place (3,) from the plane n . x = d [m], rounded as in searches for nodes beyond it."""
    return -offset + normal[0] * place[0] + normal[1] * place[1] + normal[2] * place[2]


@inlined
def tangent(k, surfaces, place):
    """Return the normal of surface k nearest to a place (3,), and the distance from it [m], negative beyond it."""
    normal, radius = vector(surfaces.normals, k), surfaces.radii[k]
    if radius == 0.0:
        return normal, beyond(normal, surfaces.offsets[k], place)
    arm, axis = minus(place, vector(surfaces.centres, k)), vector(surfaces.axes, k)
    arm = along(arm, -dot(arm, axis), axis)
    length, side = math.sqrt(dot(arm, arm)), 1.0 if radius > 0.0 else -1.0
    if length > 1e-12 * abs(radius):
        normal = times(side / length, arm)
    return normal, side * length - radius


@kernel
def wall_gaps(nodes, x, surfaces):
    """Return normals (m, w, 3) and distances (m, w) [m] of nodes (m,) at x (owned, 3) from :class:`Surfaces`."""
    normals, gaps = np.empty((len(nodes), len(surfaces.radii), 3)), np.empty((len(nodes), len(surfaces.radii)))
    for j in range(len(nodes)):
        for k in range(gaps.shape[1]):
            normal, gaps[j, k] = tangent(k, surfaces, vector(x, nodes[j]))
            put(normals[j], k, normal)
    return normals, gaps

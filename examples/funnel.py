"""A circular cone; nodes stay inside."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from pfem_petsc.case.base import Vector3
from pfem_petsc.contact.walls.base import BaseWall, Surface, WallKeys, direction, revolved

__all__ = ["Parameters", "Wall", "surface"]


class Parameters(WallKeys):
    """Keys of a conical wall."""

    point: Vector3
    """Apex [m]."""
    axis: Annotated[Vector3, direction("the direction of the axis")]
    """From the apex into the cone; of any length but zero."""
    half_angle: Annotated[float, Field(gt=0.0, lt=90.0)]
    """Angle between axis and surface [degrees]."""


class Wall(BaseWall):
    """The cone of points whose direction from the apex makes the half angle with the axis."""

    def __init__(self, parameters: Parameters) -> None:
        self.centre = np.array(parameters.point, dtype=np.float64)
        self.axis = np.array(parameters.axis) / np.linalg.norm(parameters.axis)
        angle = np.radians(parameters.half_angle)
        self.sine, self.cosine = np.sin(angle), np.cos(angle)
        # outward direction of points on the axis, where every direction will do
        helper = np.cross(self.axis, np.eye(3)[np.argmin(np.abs(self.axis))])
        self.helper = helper / np.linalg.norm(helper)

    def planes(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        arm = x - self.centre
        radial = arm - np.multiply.outer(arm @ self.axis, self.axis)
        radius = np.linalg.norm(radial, axis=1)[:, None]
        outward = np.where(radius > 1e-300, radial / np.maximum(radius, 1e-300), self.helper)
        normals = self.sine * self.axis - self.cosine * outward
        return normals, normals @ self.centre  # all tangent planes of a cone meet in its apex


def surface(parameters: Parameters, bounds: np.ndarray) -> Surface:
    """The cone as it is drawn: from its apex to the far end of the structure."""
    wall = Wall(parameters)
    corners = np.array([[bounds[i, 0], bounds[j, 1], bounds[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    height = max(float(((corners - wall.centre) @ wall.axis).max()), 1e-3)
    profile = np.array([[0.0, 0.0], [height * wall.sine / wall.cosine, height]])
    return revolved(parameters.name, profile, wall.centre, wall.axis)

"""An infinite circular cylinder; nodes stay outside or inside."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import field_validator

from ...case.base import PositiveFloat, Vector3
from .base import BaseWall, Surface, WallKeys, direction, perpendicular, revolved
from .sphere import radial_planes


class Parameters(WallKeys):
    """Keys of a cylindrical wall."""

    point: Vector3
    """Any point of the axis [m]."""
    axis: Vector3
    """Direction of the axis, of any nonzero length."""
    radius: PositiveFloat
    """Radius [m]."""
    side: Literal["outside", "inside"] = "outside"
    """where nodes may be"""

    @field_validator("axis")
    @classmethod
    def _has_length(cls, value: tuple[float, float, float]) -> tuple[float, float, float]:
        return direction(value, "the direction of the axis")


class Wall(BaseWall):
    """The cylinder of points at a distance R from its axis."""

    def __init__(self, parameters: Parameters) -> None:
        self.centre = np.array(parameters.point, dtype=np.float64)
        axis = np.array(parameters.axis)
        self.axis = axis / np.linalg.norm(axis)
        self.radius = parameters.radius
        self.sign = 1.0 if parameters.side == "outside" else -1.0
        self.width = 2.0 * self.radius if self.sign > 0.0 else np.inf
        self.across = perpendicular(self.axis)

    def planes(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        arm = x - self.centre
        along = np.multiply.outer(arm @ self.axis, self.axis)
        return radial_planes(arm - along, self.centre + along, self.radius, self.sign, self.across)

    def gaps(self, x: np.ndarray) -> np.ndarray:
        arm = x - self.centre
        return self.sign * (np.linalg.norm(arm - np.multiply.outer(arm @ self.axis, self.axis), axis=1) - self.radius)


def surface(parameters: Parameters, bounds: np.ndarray) -> Surface:
    """Return the cylinder for pictures, as long as the projection of the structure on its axis plus a margin."""
    wall = Wall(parameters)
    corners = np.array([[bounds[i, 0], bounds[j, 1], bounds[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    along = (corners - wall.centre) @ wall.axis
    margin = 0.05 * (np.linalg.norm(bounds[1] - bounds[0]) or 1.0)
    profile = np.array([[wall.radius, along.min() - margin], [wall.radius, along.max() + margin]])
    return revolved(parameters.name, profile, wall.centre, wall.axis)

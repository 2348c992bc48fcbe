"""An infinite circular cylinder; nodes stay outside or inside."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np

from ...case.base import PositiveFloat, Vector3
from .base import RoundWall, Surface, WallKeys, direction, perpendicular, revolved


class Parameters(WallKeys):
    """Keys of a cylindrical wall."""

    point: Vector3
    """Any point of the axis [m]."""
    axis: Annotated[Vector3, direction("the direction of the axis")]
    """Direction of the axis, of any nonzero length."""
    radius: PositiveFloat
    """Radius [m]."""
    side: Literal["outside", "inside"] = "outside"
    """where nodes may be"""


class Wall(RoundWall):
    """The cylinder of points at a distance R from its axis."""

    def __init__(self, parameters: Parameters) -> None:
        axis = np.array(parameters.axis)
        axis = axis / np.linalg.norm(axis)
        super().__init__(parameters, axis, perpendicular(axis))


def surface(parameters: Parameters, bounds: np.ndarray) -> Surface:
    """Return the cylinder for pictures, as long as the projection of the structure on its axis plus a margin."""
    wall = Wall(parameters)
    corners = np.array([[bounds[i, 0], bounds[j, 1], bounds[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    along = (corners - wall.centre) @ wall.axis
    margin = 0.05 * (np.linalg.norm(bounds[1] - bounds[0]) or 1.0)
    profile = np.array([[wall.radius, along.min() - margin], [wall.radius, along.max() + margin]])
    return revolved(parameters.name, profile, wall.centre, wall.axis)

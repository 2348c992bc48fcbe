"""A finite rectangle; it stops nodes that come from the side its normal points to, and nodes can pass beside it."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import model_validator

from ...case.base import PositiveFloat, Vector3, listed
from .base import Surface, WallKeys, direction, slab
from .plane import Wall as Plane

_SLACK = 1e-6  # distance of both ends from the plane, over their length, beyond which bars cross it


class Parameters(WallKeys):
    """Keys of a rectangular wall."""

    point: Vector3
    """Centre of the rectangle [m]."""
    normal: Annotated[Vector3, direction("the direction that nodes come from")]
    """Points to the side that nodes come from, of any nonzero length."""
    along: Vector3
    """Direction of the first edges; its component along the normal is ignored."""
    size: Annotated[tuple[PositiveFloat, PositiveFloat], listed]
    """Lengths of the edges along ``along`` and across it [m]."""

    @model_validator(mode="after")
    def _spans(self) -> Parameters:
        if not np.linalg.norm(np.cross(self.normal, self.along)) > 1e-9 * np.linalg.norm(self.along) * np.linalg.norm(
            self.normal
        ):
            raise ValueError("along must not be parallel to normal, nor zero")
        return self


class Wall(Plane):
    """A part of the plane n . x = d."""

    partial = True
    solid = False

    def __init__(self, parameters: Parameters) -> None:
        super().__init__(parameters)
        along = np.array(parameters.along)
        along = along - (along @ self.normal) * self.normal
        self.first = along / np.linalg.norm(along)
        self.second = np.cross(self.normal, self.first)
        self.half = 0.5 * np.array(parameters.size)
        self.width = min(parameters.size)

    def stops(self, before: np.ndarray, x: np.ndarray, tolerance: float) -> np.ndarray:
        start = before @ self.normal - self.offset
        end = x @ self.normal - self.offset
        # the point where the path crosses the plane; the foot of x if it does not
        part = np.where(end < 0.0, np.clip(start, 0.0, None) / np.maximum(start - end, 1e-300), 1.0)
        return self._has(before + np.minimum(part, 1.0)[:, None] * (x - before)) & (start >= -tolerance)

    def _has(self, x: np.ndarray) -> np.ndarray:
        """Return (m,) bool: points (m, 3) of the plane that are in the rectangle."""
        point = x - self.centre
        return (np.abs(point @ self.first) <= self.half[0]) & (np.abs(point @ self.second) <= self.half[1])

    def crossed(self, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
        first, second = starts @ self.normal - self.offset, ends @ self.normal - self.offset
        across = np.minimum(np.abs(first), np.abs(second)) > _SLACK * np.linalg.norm(ends - starts, axis=1)
        across &= (first < 0.0) != (second < 0.0)
        part = np.where(across, first / np.where(across, first - second, 1.0), 0.0)
        return across & self._has(starts + part[:, None] * (ends - starts))


def surface(parameters: Parameters, bounds: np.ndarray) -> Surface:
    """Return the rectangle for pictures."""
    wall = Wall(parameters)
    a, b = wall.half[0] * wall.first, wall.half[1] * wall.second
    face = np.array([wall.centre - a - b, wall.centre + a - b, wall.centre + a + b, wall.centre - a + b])
    return slab(parameters.name, face, wall.normal, 0.05 * (np.linalg.norm(bounds[1] - bounds[0]) or 1.0))

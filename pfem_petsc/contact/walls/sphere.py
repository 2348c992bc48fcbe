"""A sphere; nodes stay outside or inside."""

from __future__ import annotations

from typing import Literal

import numpy as np

from ...case.base import PositiveFloat, Vector3
from .base import BaseWall, Surface, WallKeys, revolved


class Parameters(WallKeys):
    """Keys of a spherical wall."""

    point: Vector3
    """Centre [m]."""
    radius: PositiveFloat
    """Radius [m]."""
    side: Literal["outside", "inside"] = "outside"
    """where nodes may be"""


def radial_planes(
    arm: np.ndarray, centres: np.ndarray, radius: float, sign: float, helper: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the tangent planes at the feet of points with arms (m, 3) from their centres (m, 3).

    ``sign`` +1 for outside, -1 for inside; ``helper`` (3,) is the normal for a point at the centre itself.
    """
    length = np.linalg.norm(arm, axis=1)
    normals = np.where(length[:, None] > 1e-12 * radius, arm / np.maximum(length, 1e-300)[:, None], helper)
    offsets = sign * (np.einsum("ij,ij->i", normals, centres) + radius)
    return sign * normals, offsets


class Wall(BaseWall):
    """The sphere |x - c| = R."""

    def __init__(self, parameters: Parameters) -> None:
        self.centre = np.array(parameters.point, dtype=np.float64)
        self.radius = parameters.radius
        self.sign = 1.0 if parameters.side == "outside" else -1.0
        self.width = 2.0 * self.radius if self.sign > 0.0 else np.inf

    def planes(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        centres = np.broadcast_to(self.centre, x.shape)
        return radial_planes(x - self.centre, centres, self.radius, self.sign, np.array([0.0, 0.0, 1.0]))

    def gaps(self, x: np.ndarray) -> np.ndarray:
        return self.sign * (np.linalg.norm(x - self.centre, axis=1) - self.radius)


def surface(parameters: Parameters, bounds: np.ndarray) -> Surface:
    """Return the sphere for pictures."""
    angles = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 17)
    profile = parameters.radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return revolved(parameters.name, profile, np.array(parameters.point), np.array([0.0, 0.0, 1.0]))

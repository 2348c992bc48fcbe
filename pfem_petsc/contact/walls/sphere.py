"""A sphere; nodes stay outside or inside."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from ...case.base import PositiveFloat, Vector3
from .base import RoundWall, Surface, WallKeys, revolved


class Parameters(WallKeys):
    """Keys of a spherical wall."""

    point: Vector3
    """Centre [m]."""
    radius: PositiveFloat
    """Radius [m]."""
    side: Literal["outside", "inside"] = "outside"
    """where nodes may be"""


class Wall(RoundWall):
    """The sphere |x - c| = R."""

    def __init__(self, parameters: Parameters) -> None:
        super().__init__(parameters, np.zeros(3), np.array([0.0, 0.0, 1.0]))


def surface(parameters: Parameters, bounds: np.ndarray) -> Surface:
    """Return the sphere for pictures, with three circles across each other, from which one sees that it is round."""
    angles = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 17)
    profile = parameters.radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    made = revolved(parameters.name, profile, np.array(parameters.point), np.array([0.0, 0.0, 1.0]))
    rings = np.arange(len(made.points)).reshape(len(profile), -1)
    middle, quarter = rings[len(profile) // 2], rings.shape[1] // 4
    sides = [np.stack([rings[:-1, k], rings[1:, k]], axis=1) for k in range(0, rings.shape[1], quarter)]
    return replace(made, edge=np.concatenate([np.stack([middle, np.roll(middle, -1)], axis=1), *sides]))

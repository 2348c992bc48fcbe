"""An infinite plane; nodes stay on the side that its normal points to."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from ...case.base import Vector3
from .base import BaseWall, WallKeys, direction


class Parameters(WallKeys):
    """Keys of a plane wall."""

    point: Vector3
    """Any point of the plane [m]."""
    normal: Annotated[Vector3, direction("the direction of the allowed side")]
    """Points to the allowed side, of any nonzero length."""


class Wall(BaseWall):
    """The plane n . x = d."""

    flat = True

    def __init__(self, parameters: Parameters) -> None:
        normal = np.array(parameters.normal)
        self.normal = normal / np.linalg.norm(normal)
        self.centre = np.array(parameters.point, dtype=np.float64)
        self.offset = float(self.normal @ self.centre)

    def planes(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.broadcast_to(self.normal, x.shape), np.full(len(x), self.offset)

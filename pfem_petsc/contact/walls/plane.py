"""An infinite plane; nodes stay on the side that its normal points to."""

from __future__ import annotations

import numpy as np
from pydantic import field_validator

from ...case.base import Vector3, WallParameters

__all__ = ["Parameters", "Wall"]


class Parameters(WallParameters):
    """Keys of a plane wall."""

    point: Vector3
    """Any point of the plane [m]."""
    normal: Vector3
    """Points to the allowed side; of any length but zero."""

    @field_validator("normal")
    @classmethod
    def _has_length(cls, value: tuple[float, float, float]) -> tuple[float, float, float]:
        if not np.linalg.norm(value) > 0.0:
            raise ValueError("has zero length; give the direction of the allowed side")
        return value


class Wall:
    """The plane n . x = d."""

    def __init__(self, parameters: Parameters) -> None:
        normal = np.array(parameters.normal)
        self.normal = normal / np.linalg.norm(normal)
        self.offset = float(self.normal @ np.array(parameters.point))

    def planes(self, x: np.ndarray, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Tangent planes at positions (m, 3) [m]: unit normals (m, 3) and offsets (m,) [m]; allowed is n . x >= d."""
        return np.broadcast_to(self.normal, x.shape), np.full(len(x), self.offset)

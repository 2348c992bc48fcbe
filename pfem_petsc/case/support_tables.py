"""The table [[support]] of a case file (SI units)."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, field_validator, model_validator

from .base import FileName, Name, StrictModel, Vector3, listed
from .rows import Table4

__all__ = ["Direction", "Support", "check_frame"]


def _has_direction(value: tuple[float, float, float]) -> tuple[float, float, float]:
    if not any(value):
        raise ValueError("has zero length; give a direction")
    if not 1e-100 < max(map(abs, value)) < 1e100:
        raise ValueError("has components out of range (1e-100 to 1e100); give a vector of about length 1")
    return value


_PARALLEL = 1e-6  # sine of the angle between two vectors that give no frame

Direction = Annotated[Vector3, AfterValidator(_has_direction)]
"""A vector of any length, which gives a direction."""


def check_frame(frame: tuple[tuple[float, float, float], tuple[float, float, float]]) -> None:
    """Refuse two vectors that give no frame."""
    first, second = (np.array(row) / np.linalg.norm(row) for row in frame)
    if np.linalg.norm(np.cross(first, second)) < _PARALLEL:
        raise ValueError("the two vectors of frame are parallel; the second must point to the side of the y axis")


def _moves_along(normal: tuple, rows: tuple, velocity: tuple | None) -> None:
    """Refuse a motion that is all across the one direction in which a support prescribes it."""
    given = np.array([row[1:] for row in rows] + ([velocity] if velocity is not None else []))
    unit = np.array(normal) / np.linalg.norm(normal)
    if given.any() and np.abs(given @ unit).max() <= _PARALLEL * np.abs(given).max():
        raise ValueError("the motion has no component along normal, so it would have no effect")


class Support(StrictModel):
    """Fixed or prescribed position components of a node set."""

    name: Name | None = None
    """name, by which [[remove]] refers to the support; unique"""
    node_set: str
    """name of a node set"""
    fix: str | None = None
    """the fixed components: any of x, y, z"""
    frame: Annotated[tuple[Direction, Direction], listed] | None = None
    """axes of ``fix`` that are not those of the model: x along the first vector, y in the plane of both, on the side of
    the second"""
    normal: Direction | None = None
    """instead of ``fix``: the one direction along which displacements are prescribed, such as the normal of the plane
    on which a roller moves"""
    motion: Table4 | None = None
    """rows [t, dx, dy, dz]: displacement from the mesh [s, m], at rest before the first and after the last row"""
    velocity: Vector3 | None = None
    """constant velocity of the fixed components [m/s]"""
    acceleration: Table4 | None = None
    """rows [t, ax, ay, az] [s, m/s2]: linear between rows, zero outside; the fixed components start from rest"""
    motion_file: FileName | None = None
    """the rows of ``motion`` from the columns of a CSV or NPZ file: its name, or a table of :class:`TableFile`"""
    acceleration_file: FileName | None = None
    """the rows of ``acceleration`` from a file in the same way"""
    interpolation: Literal["smooth", "linear"] = "smooth"
    """interpolation of ``motion`` between its rows: a cubic spline, or straight lines with velocity jumps at rows"""

    @field_validator("fix")
    @classmethod
    def _components(cls, fix: str | None) -> str | None:
        if fix is None:
            return None
        if not fix or set(fix) - set("xyz") or len(set(fix)) < len(fix):
            raise ValueError('expected any of the components x, y, z, each once, like "xz"')
        return fix

    @model_validator(mode="after")
    def _moves_what_it_fixes(self) -> Support:
        keys = [key for key in ("motion", "velocity", "acceleration") if getattr(self, key) is not None]
        if len(keys) > 1:
            raise ValueError(
                f"expected at most one of the keys motion, velocity, acceleration, acceleration_file; got {keys}"
            )
        if self.interpolation == "linear" and self.motion is None:
            raise ValueError('interpolation = "linear" requires motion; accelerations are always linear between rows')
        if (self.fix is None) == (self.normal is None):
            raise ValueError("expected exactly one of the keys fix, normal")
        if self.frame is not None:
            if self.fix is None:
                raise ValueError("frame defines the axes of fix; expected the key fix")
            check_frame(self.frame)
        if self.normal is not None:
            _moves_along(self.normal, self.motion or self.acceleration or (), self.velocity)
        if self.fix is None or self.frame is not None:
            return self
        for k, axis in enumerate("xyz"):
            rows = self.motion or self.acceleration or ()
            moves = any(row[1 + k] != 0.0 for row in rows) or (self.velocity is not None and self.velocity[k] != 0.0)
            if moves and axis not in self.fix:
                raise ValueError(f'{axis} is given a motion, but fix = "{self.fix}" leaves it free')
        return self

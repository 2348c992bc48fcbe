"""The star-shaped dome of 24 bars: an apex, a hexagon around it, and six feet turned by half a side."""

from __future__ import annotations

import numpy as np

from ...case.base import PositiveFloat, StrictModel
from ..slab import MeshSlab, check_length, slab_of_whole

__all__ = ["Parameters", "generate"]


class Parameters(StrictModel):
    """Keys of ``[mesh]`` with ``generator = "star_dome"``; the defaults are the dome of the literature."""

    apex_height: PositiveFloat = 0.08216
    """Height of the apex over the feet [m]."""
    ring_height: PositiveFloat = 0.06216
    """Height of the hexagon over the feet [m]."""
    ring_radius: PositiveFloat = 0.25
    """Radius of the hexagon [m]."""
    base_radius: PositiveFloat = 0.5
    """Radius of the circle of feet [m]."""


def generate(parameters: Parameters, rank: int, size: int) -> MeshSlab:
    """Node 0 is the apex, 1 to 6 the hexagon from the x axis on, 7 to 12 the feet, turned by 30 degrees.

    Bars: apex to hexagon, the hexagon, hexagon to feet. Node groups ``apex``, ``ring``, ``feet``; bar groups
    ``spokes``, ``ring``, ``legs``.

    Source of geometry: Levy and Spillers, Analysis of Geometrically Nonlinear Structures, section 2.4.2.
    """
    for name in ("apex_height", "ring_height", "ring_radius", "base_radius"):
        check_length(getattr(parameters, name), f"mesh.{name}")

    def circle(radius: float, height: float, turned: float) -> np.ndarray:
        angles = np.radians(60.0 * np.arange(6) + turned)
        points = np.column_stack([radius * np.cos(angles), radius * np.sin(angles), np.full(6, height)])
        points[np.abs(points) < 1e-15 * radius] = 0.0
        return points

    ring = circle(parameters.ring_radius, parameters.ring_height, 0.0)
    feet = circle(parameters.base_radius, 0.0, 30.0)
    k = np.arange(6)
    after = (k + 1) % 6
    bars = [(np.zeros(6), 1 + k), (1 + k, 1 + after), (1 + k, 7 + k), (1 + after, 7 + k)]
    return slab_of_whole(
        np.vstack([[0.0, 0.0, parameters.apex_height], ring, feet]),
        np.vstack([np.column_stack(pair) for pair in bars]).astype(np.int64),
        {"apex": np.zeros(1), "ring": 1 + k, "feet": 7 + k},
        {"spokes": k, "ring": 6 + k, "legs": np.arange(12, 24)},
        "generator star_dome",
        rank,
        size,
    )

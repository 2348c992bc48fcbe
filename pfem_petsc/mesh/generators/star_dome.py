"""The star-shaped dome of 24 bars: an apex, a hexagon around it, and six feet turned by half a side."""

from __future__ import annotations

import numpy as np

from ...case.base import StrictModel
from ..slab import MeshSlab
from .base import Length, circle, dome


class Parameters(StrictModel):
    """Keys of ``[mesh]`` with ``generator = "star_dome"``; the defaults are the dome of the literature."""

    apex_height: Length = 0.08216
    """Height of the apex over the feet [m]."""
    ring_height: Length = 0.06216
    """Height of the hexagon over the feet [m]."""
    ring_radius: Length = 0.25
    """Radius of the hexagon [m]."""
    base_radius: Length = 0.5
    """Radius of the circle of feet [m]."""


def generate(parameters: Parameters, rank: int, size: int) -> MeshSlab:
    """Node 0 is the apex, 1 to 6 the hexagon from the x axis on, 7 to 12 the feet, turned by 30 degrees.

    Bars: apex to hexagon, the hexagon, hexagon to feet. Node groups ``apex``, ``ring``, ``feet``; bar groups
    ``spokes``, ``ring``, ``legs``.

    Source of geometry: Levy and Spillers, Analysis of Geometrically Nonlinear Structures, section 2.4.2.
    """
    angles = 60.0 * np.arange(6)
    ring = circle(parameters.ring_radius, np.radians(angles))
    ring[:, 2] = parameters.ring_height
    feet = circle(parameters.base_radius, np.radians(angles + 30.0))
    points = np.vstack([[0.0, 0.0, parameters.apex_height], ring, feet])
    return dome("star_dome", points, (1, 0), rank, size)

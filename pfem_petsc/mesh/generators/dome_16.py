"""The shallow dome of 16 bars: an apex, a square around it, and four feet on the axes."""

from __future__ import annotations

import numpy as np

from ...case.base import StrictModel
from ..slab import MeshSlab
from .base import Length, dome


class Parameters(StrictModel):
    """Keys of ``[mesh]`` with ``generator = "dome_16"``; the defaults are the dome of Hrinda 2010."""

    apex_height: Length = 0.1016
    """Height of the apex over the feet [m]."""
    ring_height: Length = 0.0508
    """Height of the square over the feet [m]."""
    half_side: Length = 0.127
    """Half a side of the square [m]."""
    base_radius: Length = 0.254
    """Distance of the feet from the axis [m]."""


def generate(parameters: Parameters, rank: int, size: int) -> MeshSlab:
    """Generate this rank's part: node 0 is the apex, 1 to 4 the corners of the square, 5 to 8 the feet, from x on.

    Bars: apex to corners, the square, corners to the two feet next to each. Node groups ``apex``, ``ring``, ``feet``;
    bar groups ``spokes``, ``ring``, ``legs``.

    Source of geometry: Hrinda, Snap-through instability patterns in truss structures, AIAA 2010-2611.
    """
    a, z, base = parameters.half_side, parameters.ring_height, parameters.base_radius
    points = [[0.0, 0.0, parameters.apex_height], [a, a, z], [-a, a, z], [-a, -a, z], [a, -a, z]]
    points += [[base, 0.0, 0.0], [0.0, base, 0.0], [-base, 0.0, 0.0], [0.0, -base, 0.0]]
    return dome("dome_16", np.array(points), (0, 1), rank, size)

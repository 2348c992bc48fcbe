"""Equal bars from feet on a circle to an apex above its centre: the two-bar truss of von Mises, or a pyramid."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from ...case.base import StrictModel
from ..slab import MeshSlab, slab_of_whole
from .base import Length, circle


class Parameters(StrictModel):
    """Keys of ``[mesh]`` with ``generator = "von_mises"``."""

    half_span: Length
    """Radius of the circle of feet [m]."""
    rise: Length
    """Height of the apex over the feet [m]."""
    legs: Annotated[int, Field(ge=2, le=10_000)] = 2
    """Number of bars, at equal angles from the x axis."""


def generate(parameters: Parameters, rank: int, size: int) -> MeshSlab:
    """Generate this rank's part: node 0 is the apex, node 1 + i the foot of bar i, in the plane z = 0.

    Node groups ``apex`` and ``feet``; bar group ``legs`` (all).
    """
    n = parameters.legs
    numbers = np.arange(1, n + 1)
    return slab_of_whole(
        np.vstack([[0.0, 0.0, parameters.rise], circle(parameters.half_span, 2.0 * np.pi * np.arange(n) / n)]),
        np.column_stack([0 * numbers, numbers]),
        {"apex": np.zeros(1), "feet": numbers},
        {"legs": np.arange(n)},
        f"generator von_mises ({n} legs)",
        rank,
        size,
    )

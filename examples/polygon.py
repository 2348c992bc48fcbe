"""A regular polygon of equal bars in the x-y plane, about the origin."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from pfem_petsc.case.base import StrictModel
from pfem_petsc.mesh.generators.base import Length, Part
from pfem_petsc.mesh.slab import MeshSlab


class Parameters(StrictModel):
    """Keys of ``[mesh]`` with ``generator = "polygon"``."""

    radius: Length
    """Distance of the corners from the origin [m]."""
    sides: Annotated[int, Field(ge=3, lt=2**63)]
    """Number of bars."""


def generate(parameters: Parameters, rank: int, size: int) -> MeshSlab:
    """This rank's part: corner i at the angle 2 pi i / sides from the x axis, bar i from corner i to the next.

    Node group ``first``: corner 0; bar group ``sides`` (all).
    """
    n = parameters.sides
    part = Part(n, n, rank, size, "mesh.sides")  # with as many bars as nodes
    angles = 2.0 * np.pi * part.nodes / n
    points = parameters.radius * np.stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))], axis=1)
    ends = part.bars, (part.bars + 1) % n
    return part.slab("polygon", points, ends, {"first": part.nodes == 0}, {"sides": part.bars >= 0})

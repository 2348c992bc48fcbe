"""A circular plane truss: an outer and an inner polygon in the x-y plane, joined by struts and diagonals."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, field_validator

from ...case.base import StrictModel
from ..slab import MeshSlab
from .base import Length, Part


class Parameters(StrictModel):
    """Keys of ``[mesh]`` with ``generator = "ring"``."""

    outer_radius: Length
    """Radius through the outer nodes [m]."""
    inner_radius: Length
    """Radius through the inner nodes [m]."""
    bays: Annotated[int, Field(ge=3)]
    """Number of bays around the ring, 3 or more."""
    bracing: Literal["x", "single"] = "x"
    """``x``: both diagonals in every bay; ``single``: one, from the outer node to the next inner node."""
    orientation: Literal["vertex", "flat"] = "vertex"
    """``vertex``: an outer node at (+outer_radius, 0, 0); ``flat``: an outer chord across the +x axis."""

    @field_validator("inner_radius")
    @classmethod
    def _inside(cls, inner: float, info: Any) -> float:
        outer = info.data.get("outer_radius")
        if outer is not None and inner >= outer:
            raise ValueError(f"must be less than outer_radius = {outer:g}")
        return inner


def generate(parameters: Parameters, rank: int, size: int) -> MeshSlab:
    """Generate this rank's part of the ring.

    Nodes: the outer polygon, anticlockwise, then the inner one. Bars: outer chords, inner chords, radial struts,
    diagonals from outer node i to inner node i + 1 and, with ``bracing = "x"``, from inner node i to outer node i + 1.
    Node groups ``outer``, ``inner``, ``impact`` (the outer nodes farthest towards +x) and ``opposite`` (towards -x);
    bar groups ``outer``, ``inner``, ``radial``, ``diagonal``.
    """
    n = parameters.bays
    part = Part(2 * n, (5 if parameters.bracing == "x" else 4) * n, rank, size, "mesh.bays")
    family, bay = np.divmod(part.bars, n)
    after = (bay + 1) % n
    start = np.choose(family, [bay, n + bay, bay, bay, n + bay])
    end = np.choose(family, [after, n + after, n + bay, n + after, after])
    # the outer nodes farthest towards +x and -x, from their numbers and not from coordinates
    flat = parameters.orientation == "flat"
    half = [n // 2] if (n % 2 == 1) == flat else [n // 2 - flat, n // 2 + (not flat)]
    node_groups = {"outer": part.nodes < n, "inner": part.nodes >= n}
    node_groups["impact"] = np.isin(part.nodes, [0, n - 1] if flat else [0])
    node_groups["opposite"] = np.isin(part.nodes, half)
    bar_groups = {"outer": family == 0, "inner": family == 1, "radial": family == 2, "diagonal": family >= 3}
    source = f"ring ({parameters.bracing}, {n} bays)"
    return part.slab(source, _points(parameters, part.nodes), (start, end), node_groups, bar_groups)


def _points(parameters: Parameters, node: np.ndarray) -> np.ndarray:
    n = parameters.bays
    # Half bays from the +x axis, mapped to (-n, n] so that the ring is symmetric about it to the last digit.
    half_bays = 2 * (node % n) + (parameters.orientation == "flat")
    half_bays = np.where(half_bays > n, half_bays - 2 * n, half_bays)
    angle = np.pi / n * half_bays
    radius = np.where(node < n, parameters.outer_radius, parameters.inner_radius)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(len(node))], axis=1)
    points[half_bays == n, 1] = 0.0
    return points

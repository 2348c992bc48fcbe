"""The tables of a case file with what acts on nodes: masses, springs and dashpots (SI units)."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import ValidationInfo, field_validator, model_validator

from .base import NonNegativeFloat, StrictModel, is_finite_number, listed
from .support_tables import Direction, check_frame

__all__ = ["Dashpot", "NodalMass", "Spring"]


class NodalMass(StrictModel):
    """Mass of each node of a node set, in addition to that of its bars."""

    node_set: str
    """name of a node set"""
    value: NonNegativeFloat
    """mass of each node of the set [kg]"""


Between = Annotated[tuple[str, str], listed]


class _GroundOrNodes(StrictModel):
    """From each node of a node set to the ground, or between the nodes of two node sets."""

    node_set: str | None = None
    """name of a node set, whose nodes are connected with the ground"""
    between: Between | None = None
    """instead: names of two node sets; each node of the second is connected with the nearest of the first"""

    @model_validator(mode="after")
    def _one_of_both(self) -> _GroundOrNodes:
        if (self.node_set is None) == (self.between is None):
            raise ValueError("expected exactly one of the keys node_set, between")
        return self


class Spring(_GroundOrNodes):
    """Spring without force at the positions in the mesh."""

    stiffness: Any
    """stiffness [kx, ky, kz] of each node of the set along the axes, or k along the line between two nodes [N/m]"""
    frame: Annotated[tuple[Direction, Direction], listed] | None = None
    """x axis of the three values, and a vector on the side of their y axis; default: the axes of the model"""

    @field_validator("stiffness")
    @classmethod
    def _as_many_as_directions(cls, value: Any, info: ValidationInfo) -> Any:
        if info.data.get("between") is not None:
            if not is_finite_number(value) or not value > 0.0:
                raise ValueError("expected one number > 0 [N/m] between nodes, along the line from one to the other")
            return float(value)
        if not isinstance(value, list | tuple) or len(value) != 3 or not all(map(is_finite_number, value)):
            raise ValueError("expected three numbers [kx, ky, kz] [N/m] to the ground")
        if min(value) < 0.0:
            raise ValueError("expected values >= 0")
        return tuple(map(float, value))

    @model_validator(mode="after")
    def _frame_of_three_values(self) -> Spring:
        if self.frame is not None:
            if self.between is not None:
                raise ValueError(
                    "frame defines the axes of springs to the ground; springs between nodes act along their line"
                )
            check_frame(self.frame)
        return self


class Dashpot(_GroundOrNodes):
    """Dashpot to the ground, or between nodes."""

    coefficient: NonNegativeFloat
    """force over velocity [N s/m]: of each node of the set, in any direction, or along the line between two nodes"""

    @field_validator("coefficient")
    @classmethod
    def _acts(cls, value: float, info: ValidationInfo) -> float:
        if info.data.get("between") is not None and not value:
            raise ValueError("expected a number > 0 between nodes")
        return value

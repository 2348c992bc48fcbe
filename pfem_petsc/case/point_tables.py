"""The tables of a case file with what acts on single nodes: masses, springs and dashpots (SI units)."""

from __future__ import annotations

from pydantic import field_validator

from .base import NonNegativeFloat, StrictModel, Vector3

__all__ = ["Dashpot", "NodalMass", "Spring"]


class NodalMass(StrictModel):
    """Mass of each node of a node set, besides that of its bars."""

    node_set: str
    """name of a node set"""
    value: NonNegativeFloat
    """mass of each node of the set [kg]"""


class Spring(StrictModel):
    """Spring from each node of a node set to the ground, without force at the position in the mesh."""

    node_set: str
    """name of a node set"""
    stiffness: Vector3
    """stiffness [kx, ky, kz] of each node of the set along the axes [N/m]"""

    @field_validator("stiffness")
    @classmethod
    def _not_negative(cls, value: Vector3) -> Vector3:
        if min(value) < 0.0:
            raise ValueError("expected values >= 0")
        return value


class Dashpot(StrictModel):
    """Dashpot from each node of a node set to the ground."""

    node_set: str
    """name of a node set"""
    coefficient: NonNegativeFloat
    """force over velocity of each node of the set, in any direction [N s/m]"""

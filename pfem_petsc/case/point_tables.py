"""The tables of a case file with what acts on single nodes: masses, springs and dashpots (SI units)."""

from __future__ import annotations

from .base import NonNegativeFloat, StrictModel

__all__ = ["NodalMass"]


class NodalMass(StrictModel):
    """Mass of each node of a node set, besides that of its bars."""

    node_set: str
    """name of a node set"""
    value: NonNegativeFloat
    """mass of each node of the set [kg]"""

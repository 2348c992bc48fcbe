"""Motions of a truss without stiffness: rigid-body motions and mechanisms, with the nodes that move."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..stepping.model import Model

__all__ = ["free_motions"]


def free_motions(model: Model) -> str:
    """Return an addition to the message about a singular stiffness; empty if there are no free motions. Collective."""
    return ""

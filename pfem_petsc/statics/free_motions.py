"""Which motions of a truss meet no stiffness: rigid-body motions and mechanisms, with the nodes that move."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..stepping.model import Model

__all__ = ["free_motions"]


def free_motions(model: Model) -> str:
    """What to add to the message about a stiffness that is singular; empty where nothing is free. Collective."""
    return ""

"""Implicit steps at walls without friction."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from ..integrators.base import Balance, State
    from ..stepping.model import Model
    from .frames import NodalFrames

__all__ = ["NoStepFriction"]


class NoStepFriction:
    """Null object for :class:`~pfem_petsc.contact.implicit_friction.StepFriction` if no wall has friction."""

    def __init__(self, model: Model, state: State, balance: Balance) -> None:
        self.unsettled = np.empty(0, dtype=np.int64)

    def apply(self, frames: NodalFrames, x: np.ndarray) -> None:
        """Do nothing: no node sticks or slips."""

    def check(
        self,
        frames: NodalFrames,
        x: np.ndarray,
        reaction: np.ndarray,
        strengths: np.ndarray,
        noise: float,
        tolerance: float,
    ) -> np.ndarray:
        """Return the normal forces unchanged."""
        return strengths

    def jams(self, nodes: np.ndarray, x: np.ndarray, displacements: np.ndarray) -> list[str]:
        """Return no messages."""
        return []

    def relax(self) -> bool:
        """Return False: there is nothing to simplify."""
        return False

    def add(self, force: np.ndarray, nodes: np.ndarray, x: np.ndarray) -> float:
        """Add no force; return zero energy."""
        return 0.0

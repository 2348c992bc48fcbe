"""Equilibrium as a balance whose load factor is an unknown of the step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..integrators.base import Balance, State
from .scheme import Equilibrium

__all__ = ["PathEquilibrium"]


class PathEquilibrium(Equilibrium):
    """The balance of :class:`~.scheme.Equilibrium` for steps whose displacement and load factor are known in advance.

    ``reached`` is the load factor of the next point.
    The state's memory has ``tangent``: the displacement part of the unit tangent of the path at the state.
    """

    remembers = ("tangent",)

    def __init__(self) -> None:
        super().__init__()
        self.reached = 0.0

    def balance(self, state: State, h: float) -> Balance:
        """Return the balance at the load factor reached; ``h`` is a length, not an increment of the load factor."""
        return replace(super().balance(state, 0.0), time=self.reached, loads=((1.0, self.reached),))

    def start(self, state: State, h: float) -> None:
        state.memory["tangent"] = np.zeros_like(state.v)

    def expected_move(self, state: State, h: float) -> np.ndarray:
        return h * state.memory["tangent"]

    def finish(self, state: State, balance: Balance, u: np.ndarray, h: float) -> None:
        state.position[:] = balance.predictor + u
        state.a = np.zeros_like(u)

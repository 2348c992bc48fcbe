"""Equilibrium in the form of an integrator's balance: no inertia, no damping, the internal force at the unknown."""

from __future__ import annotations

import numpy as np

from ..integrators.base import Balance, NoParameters, Scheme, State

__all__ = ["Equilibrium"]


class Equilibrium(Scheme):
    """The balance f_int(x1) = f_ext(t1) + r, where t is the load factor; the unknown is the displacement increment.

    The state's memory has ``rate``: displacement per load factor in the last increment, which predicts the next one.
    """

    inertial = False
    remembers = ("rate",)
    dissipates = True

    def __init__(self) -> None:
        super().__init__(NoParameters())

    def start(self, state: State, h: float) -> None:
        state.memory["rate"] = np.zeros_like(state.v)

    def expected_move(self, state: State, h: float) -> np.ndarray:
        return h * state.memory["rate"]

    def balance(self, state: State, h: float) -> Balance:
        end = state.time + h
        return Balance(
            alpha=0.0,
            eta=0.0,
            predictor=state.position.copy(),
            v_hat=None,
            a_hat=None,
            time=end,
            loads=((1.0, end),),
            weight=1.0,
        )

    def finish(self, state: State, balance: Balance, u: np.ndarray, h: float) -> None:
        state.position[:] = balance.predictor + u
        state.memory["rate"] = u / h
        state.a = np.zeros_like(u)

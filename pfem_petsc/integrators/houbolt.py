"""Houbolt's method: backward differences over four positions; second order, L-stable.

    a1 = (2 x1 - 5 x0 + 4 x-1 - x-2)/h^2,   v1 = (11 x1 - 18 x0 + 9 x-1 - 2 x-2)/(6h),   balance at t1.

The history is stored as the differences d0 = x0 - x-1 and d1 = x-1 - x-2. With Houbolt's starting procedure (fictitious
x-1, x-2 from v0 and a0) the first step is that of linear acceleration, with x-1 = h^2 a0 + 2 x0 - x1 for the second.
"""

from __future__ import annotations

import numpy as np

from .base import Balance, NoParameters, State
from .base import Scheme as Base

__all__ = ["Parameters", "Scheme"]

Parameters = NoParameters


class Scheme(Base):
    """Houbolt's method (implicit)."""

    remembers = ("d0", "d1")
    force_acts_once = True

    def step_changed(self, state: State) -> None:
        state.memory.pop("d0", None)
        state.memory.pop("d1", None)

    def restart(self, state: State, nodes: np.ndarray | tuple[np.ndarray, np.ndarray], h: float) -> None:
        if "d0" in state.memory:
            v, a = state.v[nodes], state.a[nodes]
            state.memory["d0"][nodes] = h * v - (0.5 * h * h) * a
            state.memory["d1"][nodes] = h * v - (1.5 * h * h) * a

    def balance(self, state: State, h: float) -> Balance:
        common = {"a_hat": None, "time": state.time + h, "loads": ((1.0, state.time + h),), "weight": 1.0}
        if "d0" not in state.memory:
            return Balance(
                alpha=6.0 / (h * h),
                eta=3.0 / h,
                predictor=state.position + h * state.v + (h * h / 3.0) * state.a,
                v_hat=state.v + (0.5 * h) * state.a,
                **common,
            )
        d0, d1 = state.memory["d0"], state.memory["d1"]
        return Balance(
            alpha=2.0 / (h * h),
            eta=11.0 / (6.0 * h),
            predictor=state.position + 1.5 * d0 - 0.5 * d1,
            v_hat=(9.5 * d0 - 3.5 * d1) / (6.0 * h),
            **common,
        )

    def finish(self, state: State, balance: Balance, u: np.ndarray, h: float) -> None:
        if "d0" not in state.memory:
            moved = h * state.v + (h * h / 3.0) * state.a + u
            state.memory["d1"] = moved - (h * h) * state.a
        else:
            moved = 1.5 * state.memory["d0"] - 0.5 * state.memory["d1"] + u
            state.memory["d1"] = state.memory["d0"]
        state.memory["d0"] = moved
        super().finish(state, balance, u, h)

"""Second-order backward differences (BDF2): L-stable, implicit.

    v1 = (3 x1 - 4 x0 + x-1)/(2h),   a1 = (3 v1 - 4 v0 + v-1)/(2h),   balance at t1.

The first step, and the first one with another h, is backward Euler: v1 = (x1 - x0)/h, a1 = (v1 - v0)/h.
"""

from __future__ import annotations

import numpy as np

from pfem_petsc.integrators.base import Balance, NoParameters, State
from pfem_petsc.integrators.base import Scheme as Base

__all__ = ["Parameters", "Scheme"]

Parameters = NoParameters


class Scheme(Base):
    """Second-order backward differences (implicit)."""

    remembers = ("dx", "dv")  # x0 - x-1 and v0 - v-1

    def step_changed(self, state: State) -> None:
        for name in self.remembers:
            state.memory.pop(name, None)

    def restart(self, state: State, nodes: np.ndarray | tuple[np.ndarray, np.ndarray], h: float) -> None:
        if "dx" in state.memory:
            v, a = state.v[nodes], state.a[nodes]
            state.memory["dx"][nodes] = h * v - 0.5 * h * h * a
            state.memory["dv"][nodes] = h * a

    def balance(self, state: State, h: float) -> Balance:
        # with u = x1 - predictor: v1 = v_hat + eta u, a1 = alpha u
        if "dx" not in state.memory:
            eta, v_hat, predictor = 1.0 / h, state.v, state.position + h * state.v
        else:
            dx, dv = state.memory["dx"], state.memory["dv"]
            eta, v_hat = 1.5 / h, state.v + dv / 3.0
            predictor = state.position + dx / 3.0 + (2.0 * h / 3.0) * v_hat
        at_end = {"time": state.time + h, "loads": ((1.0, state.time + h),), "weight": 1.0}
        return Balance(alpha=eta * eta, eta=eta, predictor=predictor, v_hat=v_hat, a_hat=None, **at_end)

    def finish(self, state: State, balance: Balance, u: np.ndarray, h: float) -> None:
        x0, v0 = state.position.copy(), state.v
        state.position[:] = balance.predictor + u
        state.a = balance.alpha * u
        state.v = balance.v_hat + balance.eta * u
        state.memory["dx"], state.memory["dv"] = state.position - x0, state.v - v0

"""Energy-momentum conserving scheme of Simo and Tarnow's type, by the bars' discrete-gradient force.

    M (v1 - v0)/h + C (v0 + v1)/2 + f(x0, x1) = f_ext(t0 + h/2),   x1 - x0 = h (v0 + v1)/2,

with f of :mod:`pfem_petsc.mechanics.elements`. Second order; a free elastic truss conserves energy, linear and
angular momentum exactly (to the tolerance of the solver) at any step. The Hessian is unsymmetric.
"""

from __future__ import annotations

import numpy as np

from .base import Balance, NoParameters, State
from .base import Scheme as Base

__all__ = ["Parameters", "Scheme"]

Parameters = NoParameters


class Scheme(Base):
    """Energy-momentum conserving scheme (implicit)."""

    balance_at_endpoints = False
    force_acts_once = True
    discrete_gradient = True
    symmetric = False
    turns_held = True

    def balance(self, state: State, h: float) -> Balance:
        return Balance(
            alpha=2.0 / (h * h),
            eta=1.0 / h,
            predictor=state.position + h * state.v,
            v_hat=state.v,
            a_hat=None,
            time=state.time + h,
            loads=((1.0, state.time + 0.5 * h),),
            weight=1.0,
            discrete_gradient=self.discrete_gradient,
        )

    def finish(self, state: State, balance: Balance, u: np.ndarray, h: float) -> None:
        state.position[:] = balance.predictor + u
        state.a = balance.alpha * u
        state.v = balance.v_hat + (2.0 / h) * u

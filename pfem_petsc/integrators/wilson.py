"""Wilson's theta method: linear acceleration over theta h; unconditionally stable for theta >= (1 + sqrt 3)/2 = 1.366.

With tau = theta h the unknown is x_tau at t0 + tau:

    a_tau = 6 (x_tau - x0)/tau^2 - 6 v0/tau - 2 a0,   v_tau = 3 (x_tau - x0)/tau - 2 v0 - tau a0/2,
    balance at t0 + tau with f_ext(t0) + theta [f_ext(t1) - f_ext(t0)],
    a1 = a0 + (a_tau - a0)/theta,   v1 = v0 + h (a0 + a1)/2,   x1 = x0 + h v0 + h^2 (2 a0 + a1)/6.

Walls bound x_tau, not x1. A node in contact then moves as at infinite frequency, at theta = 1.4 by a factor of -0.778
per step, so its reaction alternates, the wall releases it, and contact chatters and gains energy. The decay of a node
in contact (0.533 per step at theta = 1.5) does not make contact safe: false releases depend on the phase of the impact
and gain energy below theta = 1.8 at small steps (see the table in docs/contact_tables.md). Plastic strains are stored
from x1, not from x_tau.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from ..case.base import StrictModel
from .base import Balance, State
from .base import Scheme as Base

__all__ = ["Parameters", "Scheme"]


class Parameters(StrictModel):
    """Parameters of Wilson's method."""

    theta: Annotated[float, Field(ge=1.0)] = 1.4
    """factor theta on the step, at whose end the balance holds; 2 with contact"""


class Scheme(Base):
    """Wilson's theta method (implicit)."""

    balance_at_endpoints = False
    solves_end = False

    def limit(self, damping_ratio: float = 0.0, viscous_ratio: float = 0.0) -> float:
        """Return infinity for theta >= (1 + sqrt 3)/2; below, the eigenvalue -1 appears at Omega^2 =
        12 (2 theta - 1)/(6 theta^2 - 4 theta^3 - 1) (undamped)."""
        theta = self.parameters.theta
        if theta >= 0.5 * (1.0 + np.sqrt(3.0)):
            return np.inf
        return np.sqrt(12.0 * (2.0 * theta - 1.0) / (6.0 * theta**2 - 4.0 * theta**3 - 1.0))

    def balance(self, state: State, h: float) -> Balance:
        theta = self.parameters.theta
        tau = theta * h
        return Balance(
            alpha=6.0 / (tau * tau),
            eta=3.0 / tau,
            predictor=state.position + tau * state.v + (tau * tau / 3.0) * state.a,
            v_hat=state.v + (0.5 * tau) * state.a,
            a_hat=None,
            time=state.time + tau,
            loads=((1.0 - theta, state.time), (theta, state.time + h)),
            weight=1.0,
        )

    def finish(self, state: State, balance: Balance, u: np.ndarray, h: float) -> None:
        a1 = state.a + (balance.alpha * u - state.a) / self.parameters.theta
        state.position[:] += h * state.v + (h * h / 6.0) * (2.0 * state.a + a1)
        state.v = state.v + (0.5 * h) * (state.a + a1)
        state.a = a1

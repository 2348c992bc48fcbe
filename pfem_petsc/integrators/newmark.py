"""Newmark's method; the default beta = 1, gamma = 3/2 is Hu's (1997) for impact: L-stable, first order.

    x1 = x0 + h v0 + h^2 [(1/2 - beta) a0 + beta a1],   v1 = v0 + h [(1 - gamma) a0 + gamma a1],
    balance at t1.

beta = 1/4, gamma = 1/2 is the trapezoidal rule. With Hu's parameters the velocity and acceleration of a node whose
position is fixed vanish after two steps; the numerical damping ratio is omega h / 2, and rotations are slowed down.
"""

from __future__ import annotations

import numpy as np

from ..case.base import NonNegativeFloat, PositiveFloat, StrictModel
from .base import Balance, State
from .base import Scheme as Base

__all__ = ["Parameters", "Scheme"]


class Parameters(StrictModel):
    """Parameters of the Newmark family."""

    beta: PositiveFloat = 1.0
    """parameter beta; 1/4 with gamma = 1/2: trapezoidal rule"""
    gamma: NonNegativeFloat = 1.5
    """parameter gamma; above 1/2: of first order, with damping"""


class Scheme(Base):
    """Newmark's method (implicit)."""

    force_acts_once = True

    def limit(self, damping_ratio: float = 0.0, viscous_ratio: float = 0.0) -> float:
        """Return infinity for 2 beta >= gamma >= 1/2; else Omega with Omega^2 (gamma/2 - beta) = 1 (undamped)."""
        beta, gamma = self.parameters.beta, self.parameters.gamma
        if gamma < 0.5:
            return 0.0
        return np.inf if 2.0 * beta >= gamma else 1.0 / np.sqrt(0.5 * gamma - beta)

    def balance(self, state: State, h: float) -> Balance:
        beta, gamma = self.parameters.beta, self.parameters.gamma
        return Balance(
            alpha=1.0 / (beta * h * h),
            eta=gamma / (beta * h),
            predictor=state.position + h * state.v + (h * h * (0.5 - beta)) * state.a,
            v_hat=state.v + (h * (1.0 - gamma)) * state.a,
            a_hat=None,
            time=state.time + h,
            loads=((1.0, state.time + h),),
            weight=1.0,
        )

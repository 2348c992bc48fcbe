"""Implicit generalised-alpha of Chung and Hulbert (1993), with the spectral radius rho_inf at infinite frequency.

    (1 - a_m) M a1 + a_m M a0 + C [(1 - a_f) v1 + a_f v0] + (1 - a_f) f_int(x1) + a_f f_int(x0)
        = (1 - a_f) f_ext(t1) + a_f f_ext(t0),   x1, v1 by Newmark's formulas,
    a_m = (2 rho - 1)/(rho + 1),  a_f = rho/(rho + 1),  gamma = 1/2 - a_m + a_f,  beta = (1 - a_m + a_f)^2/4.

Second order, unconditionally stable (linear); rho_inf = 1 conserves energy, 0 removes the highest frequency in one
step.
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
    """Parameters of the implicit generalised-alpha method."""

    rho_inf: Annotated[float, Field(ge=0.0, le=1.0)] = 0.8
    """spectral radius at infinite frequency; 1: no damping"""


class Scheme(Base):
    """Generalised-alpha (implicit, Chung and Hulbert)."""

    balance_at_endpoints = False

    def set_coefficients(self) -> None:
        """Set alpha_m, alpha_f, beta, gamma from the parameters."""
        rho = self.parameters.rho_inf
        self.alpha_m = (2.0 * rho - 1.0) / (rho + 1.0)
        self.alpha_f = rho / (rho + 1.0)
        self.gamma = 0.5 - self.alpha_m + self.alpha_f
        self.beta = 0.25 * (1.0 - self.alpha_m + self.alpha_f) ** 2

    def balance(self, state: State, h: float) -> Balance:
        kept = 1.0 - self.alpha_f
        return Balance(
            alpha=(1.0 - self.alpha_m) / (self.beta * h * h),
            eta=kept * self.gamma / (self.beta * h),
            predictor=state.position + h * state.v + (h * h * (0.5 - self.beta)) * state.a,
            v_hat=state.v + (kept * h * (1.0 - self.gamma)) * state.a,
            a_hat=self.alpha_m * state.a if self.alpha_m else None,
            time=state.time + h,
            loads=((kept, state.time + h), (self.alpha_f, state.time)),
            weight=kept,
        )

    def finish(self, state: State, balance: Balance, u: np.ndarray, h: float) -> None:
        state.position[:] = balance.predictor + u
        a1 = u / (self.beta * h * h)
        state.v = state.v + (h * (1.0 - self.gamma)) * state.a + (h * self.gamma) * a1
        state.a = a1

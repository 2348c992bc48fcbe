"""Explicit generalised-alpha of Hulbert and Chung (1996), with the spectral radius rho_b at the bifurcation.

    (1 - a_m) M a1 + a_m M a0 + C v0 + f_int(x0) = f_ext(t0),   x1, v1 by Newmark's formulas,
    a_m = (2 rho_b - 1)/(1 + rho_b),  beta = (5 - 3 rho_b)/[(1 + rho_b)^2 (2 - rho_b)],  gamma = 3/2 - a_m.

Second order; stable to Omega^2 = 2 (1 - 2 a_m)/(2 beta - gamma) (undamped): 1.549 at rho_b = 0, 2 at rho_b = 1.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from ..case.base import StrictModel
from .base import Balance, ExplicitScheme, State, lagged_limit
from .generalized_alpha import Scheme as GeneralisedAlpha

__all__ = ["Parameters", "Scheme"]


class Parameters(StrictModel):
    """Parameters of the explicit generalised-alpha method."""

    rho_b: Annotated[float, Field(ge=0.0, le=1.0)] = 0.8
    """spectral radius rho_b at the bifurcation frequency; smaller values damp high frequencies more"""


class Scheme(ExplicitScheme):
    """Explicit generalised-alpha (Hulbert and Chung)."""

    balance_at_endpoints = False

    def set_coefficients(self) -> None:
        """Set alpha_m, beta, gamma from the parameters."""
        rho = self.parameters.rho_b
        self.alpha_m = (2.0 * rho - 1.0) / (1.0 + rho)
        self.beta = (5.0 - 3.0 * rho) / ((1.0 + rho) ** 2 * (2.0 - rho))
        self.gamma = 1.5 - self.alpha_m

    def limit(self, damping_ratio: float = 0.0, viscous_ratio: float = 0.0) -> float:
        return lagged_limit(self.alpha_m, self.beta, self.gamma, damping_ratio + viscous_ratio)

    def balance(self, state: State, h: float) -> Balance:
        predictor = state.position + h * state.v + (h * h * (0.5 - self.beta)) * state.a
        return Balance(
            alpha=(1.0 - self.alpha_m) / (self.beta * h * h),
            eta=0.0,
            predictor=predictor,
            v_hat=state.v,
            a_hat=self.alpha_m * state.a if self.alpha_m else None,
            time=state.time + h,
            loads=((1.0, state.time),),
            weight=0.0,
        )

    finish = GeneralisedAlpha.finish  # by the same formulas of Newmark

"""Method of Hilber, Hughes and Taylor (1977), with a parameter -1/3 <= alpha <= 0 for numerical damping.

    M a1 + (1 + alpha) [C v1 + f_int(x1) - f_ext(t1)] - alpha [C v0 + f_int(x0) - f_ext(t0)] = 0,
    x1, v1 by Newmark's formulas,   beta = (1 - alpha)^2/4,   gamma = 1/2 - alpha.

Second order, unconditionally stable (linear); the spectral radius at infinite frequency is (1 + alpha)/(1 - alpha):
alpha = 0 is the trapezoidal rule, -1/3 halves the highest frequency in each step. It is the generalised-alpha family
with a_m = 0 and a_f = -alpha.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from ..case.base import StrictModel
from .generalized_alpha import Scheme as GeneralizedAlpha

__all__ = ["Parameters", "Scheme"]


class Parameters(StrictModel):
    """Parameters of the method of Hilber, Hughes and Taylor."""

    alpha: Annotated[float, Field(ge=-1.0 / 3.0, le=0.0)] = -0.05
    """parameter alpha; 0: no damping, -1/3: most damping of high frequencies"""


class Scheme(GeneralizedAlpha):
    """HHT-alpha (implicit, Hilber, Hughes and Taylor)."""

    def set_coefficients(self) -> None:
        """Set alpha_m, alpha_f, beta, gamma from the parameter."""
        alpha = self.parameters.alpha
        self.alpha_m, self.alpha_f = 0.0, -alpha
        self.gamma, self.beta = 0.5 - alpha, 0.25 * (1.0 - alpha) ** 2

"""Explicit method of Chung and Lee (1994), with a free parameter 1 <= beta <= 28/27 for numerical damping.

    M a1 + C v0 + f_int(x0) = f_ext(t0),
    x1 = x0 + h v0 + h^2 [(1/2 - beta) a0 + beta a1],   v1 = v0 + h [(1 - gamma) a0 + gamma a1],   gamma = 3/2.

beta = 1 has the positions of central differences; beta = 28/27 halves the amplitude at the bifurcation in each step.
Second order, stable up to Omega = 2/sqrt(4 beta - 3) (undamped). It is the explicit generalised-alpha family with
a_m = 0.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from ..case.base import StrictModel
from .hulbert_chung import Scheme as ExplicitGeneralisedAlpha

__all__ = ["Parameters", "Scheme"]


class Parameters(StrictModel):
    """Parameters of the method of Chung and Lee."""

    beta: Annotated[float, Field(ge=1.0, le=28.0 / 27.0)] = 28.0 / 27.0
    """factor beta of the acceleration; 1: no damping, 28/27: most damping of high frequencies"""


class Scheme(ExplicitGeneralisedAlpha):
    """Method of Chung and Lee (explicit)."""

    def set_coefficients(self) -> None:
        """Set alpha_m, beta, gamma from the parameters."""
        self.alpha_m = 0.0
        self.beta = self.parameters.beta
        self.gamma = 1.5

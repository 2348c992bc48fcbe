"""Stand-in for the explicit method of Souza and Moura, whose source has not been found.

Only the description in the paper is known: explicit, with smaller velocity oscillations at impact than the methods of
Newmark and of Chung and Lee, but slower decay. Explicit generalised-alpha with rho_b = 0.3 behaves in this way. It is
not the method of Souza and Moura.
"""

from __future__ import annotations

from .base import NoParameters
from .hulbert_chung import Parameters as ExplicitGeneralisedAlphaParameters
from .hulbert_chung import Scheme as ExplicitGeneralisedAlpha

__all__ = ["Parameters", "Scheme"]

Parameters = NoParameters


class Scheme(ExplicitGeneralisedAlpha):
    """Stand-in for Souza and Moura: hulbert_chung with rho_b = 0.3 (their scheme is not available)."""

    notice = (
        "souza_moura is a stand-in: the source of Souza and Moura's scheme has not been found, so hulbert_chung with "
        "rho_b = 0.3 runs, chosen by the behaviour that the paper describes"
    )

    def __init__(self, parameters: NoParameters) -> None:
        super().__init__(ExplicitGeneralisedAlphaParameters(rho_b=0.3))

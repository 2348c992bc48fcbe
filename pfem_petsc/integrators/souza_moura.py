"""Stand-in for the explicit method of Souza and Moura, whose source has not been found.

What is known is how the paper describes it: explicit, with lower velocity oscillations at impact than Newmark's and
Chung and Lee's methods, which take longer to die out. Explicit generalised-alpha with rho_b = 0.3 behaves so. It is not
the method of Souza and Moura.
"""

from __future__ import annotations

from .base import NoParameters
from .hulbert_chung import Parameters as ExplicitGeneralisedAlphaParameters
from .hulbert_chung import Scheme as ExplicitGeneralisedAlpha

__all__ = ["Parameters", "Scheme"]

Parameters = NoParameters


class Scheme(ExplicitGeneralisedAlpha):
    """Stand-in for Souza and Moura: hulbert_chung with rho_b = 0.3 (their own scheme is not known to us)."""

    notice = (
        "souza_moura is a stand-in: the source of Souza and Moura's scheme has not been found, so hulbert_chung with "
        "rho_b = 0.3 runs, chosen by the behaviour that the paper describes"
    )

    def __init__(self, parameters: NoParameters) -> None:
        super().__init__(ExplicitGeneralisedAlphaParameters(rho_b=0.3))

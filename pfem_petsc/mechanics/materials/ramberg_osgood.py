"""Bar with the curve of Ramberg and Osgood, e = s/E + e_p (s/s_p)^n; it unloads elastically and hardens isotropically.

W. Ramberg and W. R. Osgood, Description of stress-strain curves by three parameters, NACA TN 902, 1943, in the form
with the proof stress s_p at the plastic strain e_p (0.2 %). The yield stress R(a) = s_p (a/e_p)^(1/n) starts from zero:
the bar flows from the first load on. After a reversal it yields at the largest stress so far (isotropic hardening). The
plastic work is heat.
"""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import Field

from ...case.base import PositiveFloat
from ..compiled import inlined
from ._plastic import isotropic_law
from .base import MaterialKeys, yield_texts

__all__ = ["LAW", "Parameters", "curve", "scale"]


class Parameters(MaterialKeys):
    """Keys of a material of Ramberg-Osgood."""

    proof_stress: PositiveFloat
    """stress s_p at the plastic strain ``proof_strain`` [Pa]"""
    exponent: Annotated[float, Field(ge=1.0, le=1000.0, allow_inf_nan=False)]
    """exponent n of the stress, 1 to 1000 [-]"""
    proof_strain: PositiveFloat = 0.002
    """plastic strain e_p at the proof stress [-]"""

    def pack(self) -> tuple[float, ...]:
        """Return (E, 0, s_p [Pa], e_p, 1/n)."""
        return self.young_modulus, 0.0, self.proof_stress, self.proof_strain, 1.0 / self.exponent

    def suspicions(self, key: str, hint: str) -> list[str]:
        """Return a message about an unrealistic strain at the proof stress."""
        return yield_texts(key, hint, "proof_stress", self.proof_stress, self.young_modulus)


@inlined
def curve(accumulated, p):
    """Return R, dR/da, and the densities int(R) and zero; p = (E, 0, s_p, e_p, 1/n)."""
    if not (accumulated > 0.0):
        return 0.0, math.inf, 0.0, 0.0
    strength = p[2] * (accumulated / p[3]) ** p[4]
    return strength, p[4] * strength / accumulated, strength * accumulated / (1.0 + p[4]), 0.0


@inlined
def scale(p, modulus, strength):
    """Return the parameters at a temperature."""
    return modulus * p[0], p[1], strength * p[2], p[3], p[4]


LAW = isotropic_law(curve, scale)

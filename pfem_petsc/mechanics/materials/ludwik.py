"""Plastic bar with isotropic hardening by a power law: R(a) = s_Y + K a^n (Ludwik).

P. Ludwik, Elemente der technologischen Mechanik, Springer, Berlin 1909. The slope of R is infinite at a = 0 for n < 1:
the tangent modulus at the onset of yielding is E.
"""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import Field

from ...case.base import PositiveFloat
from ..compiled import inlined
from ._plastic import PlasticKeys, isotropic_law

__all__ = ["LAW", "Parameters", "curve", "scale"]


class Parameters(PlasticKeys):
    """Keys of a material with hardening by a power law."""

    strength_coefficient: PositiveFloat
    """increase K of the yield stress at an accumulated plastic strain of 1 [Pa]"""
    hardening_exponent: Annotated[float, Field(gt=0.0, le=1.0, allow_inf_nan=False)]
    """exponent n of the accumulated plastic strain, at most 1 [-]"""

    def pack(self) -> tuple[float, ...]:
        """Return (E, H, s_Y, K [Pa], n)."""
        first = self.young_modulus, self.kinematic_hardening, self.yield_stress
        return *first, self.strength_coefficient, self.hardening_exponent


@inlined
def curve(accumulated, p):
    """Return R, dR/da, and the densities s_Y a and int(R - s_Y); p = (E, H, s_Y, K, n)."""
    strength, coefficient, exponent = p[2], p[3], p[4]
    risen = coefficient * accumulated**exponent if accumulated > 0.0 else 0.0
    slope = exponent * risen / accumulated if accumulated > 0.0 else math.inf
    return strength + risen, slope, strength * accumulated, risen * accumulated / (1.0 + exponent)


@inlined
def scale(p, modulus, strength):
    """Return the parameters at a temperature."""
    return modulus * p[0], strength * p[1], strength * p[2], strength * p[3], p[4]


LAW = isotropic_law(curve, scale)

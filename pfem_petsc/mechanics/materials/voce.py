"""Plastic bar whose isotropic hardening saturates: R(a) = s_Y + K a + Q (1 - exp(-b a)) (Voce).

E. Voce, The relationship between stress and strain for homogeneous deformations, J. Inst. Metals 74 (1948) 537-562.
With Q = 0 it is the elastoplastic law.
"""

from __future__ import annotations

import math

from ...case.base import NonNegativeFloat
from ..compiled import inlined
from ._isotropic import PlasticKeys, isotropic_law

__all__ = ["LAW", "Parameters", "curve", "scale"]


class Parameters(PlasticKeys):
    """Keys of a material with saturating hardening."""

    saturation_stress: NonNegativeFloat
    """increase Q of the yield stress at saturation [Pa]"""
    saturation_rate: NonNegativeFloat
    """rate b of saturation over the accumulated plastic strain [-]"""
    isotropic_hardening: NonNegativeFloat = 0.0
    """isotropic hardening modulus K beside the saturation [Pa]"""

    def pack(self) -> tuple[float, ...]:
        """Return (E, H, s_Y, K, Q [Pa], b)."""
        young, kinematic, first = self.young_modulus, self.kinematic_hardening, self.yield_stress
        return young, kinematic, first, self.isotropic_hardening, self.saturation_stress, self.saturation_rate


@inlined
def curve(accumulated, p):
    """Return R, dR/da, and the densities s_Y a and int(R - s_Y); p = (E, H, s_Y, K, Q, b, ...)."""
    strength, linear, saturation, rate = p[2], p[3], p[4], p[5]
    x = rate * accumulated
    risen = -math.expm1(-x)
    # int(1 - exp(-b a)) = a - (1 - exp(-b a))/b, by its series where the two terms cancel
    part = accumulated * x * (0.5 - x * (1.0 / 6.0 - x / 24.0)) if x < 1e-4 else accumulated - risen / rate
    stored = 0.5 * linear * accumulated * accumulated + saturation * part
    slope = linear + saturation * rate * (1.0 - risen)
    return strength + linear * accumulated + saturation * risen, slope, strength * accumulated, stored


@inlined
def scale(p, modulus, strength):
    """Return the parameters at a temperature."""
    return modulus * p[0], strength * p[1], strength * p[2], strength * p[3], strength * p[4], p[5]


LAW = isotropic_law(curve, scale)

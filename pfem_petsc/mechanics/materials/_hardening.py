"""Keys and energy of isotropic hardening, linear and saturating, of rate-dependent laws."""

from __future__ import annotations

from ...case.base import NonNegativeFloat
from ..compiled import inlined
from ._isotropic import PlasticKeys
from .voce import curve

__all__ = ["HardeningKeys", "scale", "stored"]


class HardeningKeys(PlasticKeys):
    """Keys of the yield stress at the rate zero: R(a) = s_Y + K a + Q (1 - exp(-b a))."""

    isotropic_hardening: NonNegativeFloat = 0.0
    """isotropic hardening modulus K [Pa]"""
    saturation_stress: NonNegativeFloat = 0.0
    """increase Q of the yield stress at saturation, as in the law voce [Pa]"""
    saturation_rate: NonNegativeFloat = 0.0
    """rate b of saturation over the accumulated plastic strain [-]"""

    def static(self) -> tuple[float, ...]:
        """Return (E, H, s_Y, K, Q [Pa], b)."""
        young, kinematic, first = self.young_modulus, self.kinematic_hardening, self.yield_stress
        return young, kinematic, first, self.isotropic_hardening, self.saturation_stress, self.saturation_rate


@inlined
def stored(before, after, p, work):
    """Return the energy that isotropic hardening stores between two accumulated plastic strains [J/m3]."""
    return curve(after, p)[3] - curve(before, p)[3]


@inlined
def scale(p, modulus, strength):
    """Return the parameters at a temperature."""
    return modulus * p[0], strength * p[1], strength * p[2], strength * p[3], strength * p[4], p[5], p[6], p[7]

"""Plastic bar whose isotropic hardening saturates: R(a) = s_Y + K a + Q (1 - exp(-b a)) (Voce).

E. Voce, The relationship between stress and strain for homogeneous deformations, J. Inst. Metals 74 (1948) 537-562.
With Q = 0 it is the elastoplastic law.
"""

from __future__ import annotations

from ...case.base import NonNegativeFloat
from ..compiled import inlined
from ._plastic import PlasticKeys, curve, isotropic_law

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
def scale(p, modulus, strength):
    """Return the parameters at a temperature."""
    return modulus * p[0], strength * p[1], strength * p[2], strength * p[3], strength * p[4], p[5]


LAW = isotropic_law(curve, scale)

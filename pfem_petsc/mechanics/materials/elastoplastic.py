"""Elastoplastic bar with mixed linear hardening, isotropic (K) and kinematic (H).

Yield function f = |s - H e_p| - (s_Y + K a) with the accumulated plastic strain a. The return mapping of a linear law
is closed: da = f_trial / (E + H + K). On the yield surface s = sign (s_Y + K a) + H e_p, so the plastic work is the
function of state s_Y a + K a^2/2 + H e_p^2/2: its first term is heat, the rest is stored by the hardening.
"""

from __future__ import annotations

from numba.extending import register_jitable

__all__ = ["REMEMBERS", "pack", "response"]

REMEMBERS = True


def pack(material) -> tuple[float, ...]:
    """Parameters as the response reads them: (E, s_Y, K, H) [Pa] and 1/(E + H + K) [1/Pa]."""
    young, isotropic, kinematic = material.young_modulus, material.isotropic_hardening, material.kinematic_hardening
    inverse = 1.0 / (young + kinematic + isotropic)
    return float(young), float(material.yield_stress), float(isotropic), float(kinematic), float(inverse)


@register_jitable
def response(strain, p, plastic, accumulated):
    """Stress [Pa], tangent modulus [Pa], the new plastic and accumulated plastic strain, and energy densities [J/m3]:
    elastic, heat, hardening."""
    young, yield_stress, isotropic, kinematic, inverse = p
    stress = young * (strain - plastic)
    tangent = young
    relative = stress - kinematic * plastic
    excess = abs(relative) - (yield_stress + isotropic * accumulated)
    if excess > 0.0:
        step = excess * inverse
        accumulated += step
        if relative < 0.0:
            step = -step
        plastic += step
        stress -= young * step
        tangent = young * (isotropic + kinematic) * inverse
    hardening = 0.5 * (isotropic * accumulated * accumulated + kinematic * plastic * plastic)
    elastic = 0.5 * stress * (strain - plastic)
    return stress, tangent, plastic, accumulated, elastic, yield_stress * accumulated, hardening

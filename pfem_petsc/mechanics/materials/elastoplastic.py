"""Elastoplastic bar with mixed linear hardening, isotropic (K) and kinematic (H).

Yield function f = |s - H e_p| - (s_Y + K a) with the accumulated plastic strain a. The return mapping of a linear law is
closed: da = f_trial / (E + H + K). On the yield surface s = sign (s_Y + K a) + H e_p, so the plastic work is the function
of state s_Y a + K a^2/2 + H e_p^2/2: its first term is heat, the rest is stored by the hardening.
"""

from __future__ import annotations

import numpy as np
from numba.extending import register_jitable

__all__ = ["HISTORY", "pack", "response"]

HISTORY = 2  # columns of the history array: plastic strain, accumulated plastic strain


def pack(material) -> np.ndarray:
    """Parameters as the response reads them: (E, s_Y, K, H) [Pa]."""
    return np.array(
        [material.young_modulus, material.yield_stress, material.isotropic_hardening, material.kinematic_hardening],
        dtype=np.float64,
    )


@register_jitable
def response(strain, p, history, k, commit):
    """Stress [Pa], tangent modulus [Pa] and energy densities [J/m3]: elastic, plastic heat, hardening."""
    plastic = history[k, 0]
    accumulated = history[k, 1]
    young, yield_stress, isotropic, kinematic = p[0], p[1], p[2], p[3]
    stress = young * (strain - plastic)
    tangent = young
    relative = stress - kinematic * plastic
    excess = abs(relative) - (yield_stress + isotropic * accumulated)
    if excess > 0.0:
        step = excess / (young + isotropic + kinematic)
        accumulated += step
        if relative < 0.0:
            step = -step
        plastic += step
        stress -= young * step
        tangent = young * (isotropic + kinematic) / (young + isotropic + kinematic)
        if commit:
            history[k, 0] = plastic
            history[k, 1] = accumulated
    hardening = 0.5 * (isotropic * accumulated * accumulated + kinematic * plastic * plastic)
    return stress, tangent, 0.5 * stress * (strain - plastic), yield_stress * accumulated, hardening

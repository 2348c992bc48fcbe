"""Linear elastic bar: s = E e."""

from __future__ import annotations

import numpy as np
from numba.extending import register_jitable

__all__ = ["HISTORY", "pack", "response"]

HISTORY = 0


def pack(material) -> np.ndarray:
    """Parameters as the response reads them: (E,) [Pa]."""
    return np.array([material.young_modulus], dtype=np.float64)


@register_jitable
def response(strain, p, history, k, commit):
    """Stress [Pa], tangent modulus [Pa] and energy densities [J/m3]: elastic, plastic heat, hardening."""
    stress = p[0] * strain
    return stress, p[0], 0.5 * stress * strain, 0.0, 0.0

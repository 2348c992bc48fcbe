"""Strain measures of a bar as functions of its stretch: strain, and its first two derivatives by length.

The work-conjugate stress acts on the reference volume A l0, so the axial force is N = A l0 s de/dl and
dN/dl = A l0 (E_t (de/dl)^2 + s d2e/dl2).
"""

from __future__ import annotations

import math

from numba.extending import register_jitable

__all__ = ["MEASURES", "strain_of"]

MEASURES = {"engineering": 0, "green": 1, "logarithmic": 2}


@register_jitable
def strain_of(measure: int, stretch: float) -> tuple[float, float, float]:
    """Strain, l0 de/dl and l0^2 d2e/dl2 at a stretch l/l0 (all dimensionless)."""
    if measure == 0:
        return stretch - 1.0, 1.0, 0.0
    if measure == 1:
        return 0.5 * (stretch * stretch - 1.0), stretch, 1.0
    return math.log(stretch), 1.0 / stretch, -1.0 / (stretch * stretch)

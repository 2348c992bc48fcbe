"""Strain measures of a bar as functions of its stretch: strain, and its first two derivatives with respect to length.

The work-conjugate stress acts on the reference volume A l0, so the axial force is N = A l0 s de/dl and
dN/dl = A l0 (E_t (de/dl)^2 + s d2e/dl2). Each measure returns strain, l0 de/dl and l0^2 d2e/dl2 at a stretch l/l0; all
are dimensionless. The loops over bars are compiled for each measure.
"""

from __future__ import annotations

import math

from numba.extending import register_jitable

__all__ = ["MEASURES", "engineering", "green", "logarithmic"]


@register_jitable
def engineering(stretch: float) -> tuple[float, float, float]:
    """Return the engineering strain l/l0 - 1 and its derivatives."""
    return stretch - 1.0, 1.0, 0.0


@register_jitable
def green(stretch: float) -> tuple[float, float, float]:
    """Return Green's strain ((l/l0)^2 - 1)/2 and its derivatives."""
    return 0.5 * (stretch * stretch - 1.0), stretch, 1.0


@register_jitable
def logarithmic(stretch: float) -> tuple[float, float, float]:
    """Return the logarithmic strain ln(l/l0) and its derivatives."""
    return math.log(stretch), 1.0 / stretch, -1.0 / (stretch * stretch)


MEASURES = {"engineering": engineering, "green": green, "logarithmic": logarithmic}

"""Plastic bars whose yield stress R is any function of the accumulated plastic strain a, made by compiled code."""

from __future__ import annotations

import math
from collections.abc import Callable

from ...case.base import NonNegativeFloat, PositiveFloat
from ..compiled import inlined
from .base import Law, MaterialKeys, Softening, mean_of_work, yield_texts

NOISE = 4.0 * 2.0**-52
"""Residual relative to its terms below which it is rounding."""

_MOST = 200  # iterations; some six are usual, and bisections alone would take a hundred


def make_solver(residual: Callable) -> Callable:
    """Return a compiled function ``solve(start, high, noise, data)``.

    ``residual(x, data)`` returns a value and its derivative; the value is positive at 0 and not at ``high``. ``solve``
    returns the root of (0, high], from ``start``, as soon as the residual is no larger than ``noise``, after a last
    step of Newton's method. Flow stresses may have any slope, and an infinite one at 0. Where a step of Newton's
    method leaves the bracket, the unknown decreases by powers that are squared each time until the residual is
    positive, and is then the geometric mean of the bounds, so that roots of any magnitude are found in a few steps.
    """

    @inlined
    def solve(start, high, noise, data):
        low, x, shrink = 0.0, start, 0.0625
        for _ in range(_MOST):
            value, slope = residual(x, data)
            if value > 0.0:
                low = x
            else:
                high = x
            new = x - value / slope if slope < 0.0 else -1.0
            if abs(value) <= noise:
                return new if low <= new <= high else x
            if not (low < new < high):
                if low == 0.0:
                    new = high * shrink
                    shrink *= shrink
                elif high > 4.0 * low:
                    new = math.sqrt(low) * math.sqrt(high)
                else:
                    new = 0.5 * (low + high)
            if new == x or new == 0.0:
                return new
            x = new
        return x

    return solve


VARIABLES = (("plastic_strain", ""), ("accumulated_plastic_strain", ""))
ENERGIES = ("elastic_energy", "plastic_heat", "hardening_energy")


class PlasticKeys(MaterialKeys):
    """Keys of materials with an initial yield stress and hardening."""

    yield_stress: PositiveFloat
    """initial yield stress s_Y [Pa]"""
    kinematic_hardening: NonNegativeFloat = 0.0
    """kinematic hardening modulus H [Pa]"""

    def suspicions(self, key: str, hint: str) -> list[str]:
        """Return a message about an unrealistic strain at yield."""
        return yield_texts(key, hint, "yield_stress", self.yield_stress, self.young_modulus)


def isotropic_law(curve: Callable, scale: Callable, find: Callable | None = None) -> Law:
    """Make a rate-independent law.

    Parameters
    ----------
    curve : compiled function of (a, p) that returns R [Pa], dR/da [Pa], and the densities of heat and of energy stored
        by isotropic hardening [J/m3], whose sum is the integral of R from 0 to a. p[0] = E, p[1] = H [Pa]
    scale : compiled function of (p, factor of modulus, factor of yield stress) that returns p at a temperature
    find : compiled function of (|s_trial - H e_p|, excess over R(a), E + H, a, p) that returns the plastic strain x of
        a step; None: by Newton's method, with a curve whose slope does not increase
    """

    @inlined
    def residual(x, data):
        size, stiffness, accumulated, p = data
        strength, slope, _, _ = curve(accumulated + x, p)
        return size - stiffness * x - strength, -stiffness - slope

    solve = make_solver(residual)

    @inlined
    def by_newton(size, excess, stiffness, accumulated, p):
        limit = excess / stiffness
        return solve(limit, limit, NOISE * size, (size, stiffness, accumulated, p))

    flow_of = by_newton if find is None else find

    @inlined
    def response(strain, rate, step, temperature, p, q):
        """See :class:`~pfem_petsc.mechanics.materials.base.Law`; q = (plastic strain, accumulated plastic strain)."""
        young, kinematic = p[0], p[1]
        plastic, accumulated = q
        stress = young * (strain - plastic)
        tangent = young
        relative = stress - kinematic * plastic
        strength, slope, heat, stored = curve(accumulated, p)
        size = abs(relative)
        excess = size - strength
        if excess > 0.0:
            stiffness = young + kinematic
            flow = flow_of(size, excess, stiffness, accumulated, p)
            accumulated += flow
            strength, slope, heat, stored = curve(accumulated, p)
            tangent = young * (1.0 - young / (stiffness + slope))
            if relative < 0.0:
                flow = -flow
            plastic += flow
            stress -= young * flow
        elastic = 0.5 * stress * (strain - plastic)
        return stress, tangent, (plastic, accumulated), (elastic, heat, stored + 0.5 * kinematic * plastic * plastic)

    @inlined
    def dissipated(p, q):
        """Return the densities of heat and hardening energy [J/m3]."""
        _, _, heat, stored = curve(q[1], p)
        return heat, stored + 0.5 * p[1] * q[0] * q[0]

    return Law(
        response,
        internal=VARIABLES,
        energies=ENERGIES,
        mean_stress=mean_of_work(response),
        mean_of_work=True,
        softening=Softening(scale, dissipated),
    )

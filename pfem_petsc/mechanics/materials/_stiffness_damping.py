"""Stiffness-proportional damping of a law: a viscous stress E beta times the rate of strain, along the bar.

It is Rayleigh's C = beta K0 with the stiffness K0 of the unstressed bars in their present directions, so that rigid
motions are not damped. A mode of angular frequency w has the damping ratio beta w/2.

The rate is that of the balance, by the velocities of the scheme: a factor times the mean rate over the step, (e1 -
e0)/step, plus a known rate, which is an internal variable. In implicit steps v = v_hat + eta u, hence the rate is that
of v_hat at the predictor plus eta (e - e_predictor), with the factor eta step. Where the balance holds at a known
position, its velocity is known too, and the factor is zero (``Bars.set_rates``). Central differences know velocities at
half steps: the rate at their position is extrapolated from the mean rates of the last two steps, with the factor 3/2,
and the known rate is -1/2 of the mean rate of the step before. The mean rate alone is half a step late, which is an
error of first order.

The dissipation E beta (mean rate)^2 step of each step accumulates, as that of damping by mass; it is never negative.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, Any

from ..compiled import inlined

if TYPE_CHECKING:
    from .base import Law

__all__ = ["EXTRAPOLATED", "VARIABLES", "damped"]

VARIABLES = (("viscous_dissipation_density", "J/m³"), ("viscous_stress", "Pa"), ("known_rate", "1/s"))
"""Internal variables that follow those of the law."""

EXTRAPOLATED = 1.5
"""Factor of the mean rate over a step in the rate at its end, extrapolated from the last two steps."""


@cache
def damped(law: Law) -> Law:
    """Return the law with p = (p of the law, E beta [Pa s], factor of the mean rate, data of the bar)."""
    response, mean_stress, n, has_data = law.response, law.mean_stress, len(law.internal), bool(law.bar_data)

    @inlined
    def own(p):
        return p[0] + p[3:] if has_data else p[0]

    @inlined
    def with_damping(strain, rate, step, temperature, p, q):
        stress, tangent, after, densities = response(strain, rate, step, temperature, own(p), q[:n])
        lost, viscous, known = q[n], 0.0, q[n + 2]
        if step < math.inf:  # it is infinite in static analyses
            viscous = p[1] * (p[2] * rate + known)
            lost += p[1] * rate * rate * step
        if step > 0.0:
            tangent += p[1] * p[2] / step
            known = (1.0 - p[2]) * rate
        return stress + viscous, tangent, after + (lost, viscous, known), densities + (lost,)

    @inlined
    def mean_with_damping(stress0, strain0, strain, rate, step, temperature, p, q):
        elastic = stress0 - q[n + 1]
        mean, modulus = mean_stress(elastic, strain0, strain, rate, step, temperature, own(p), q[:n])
        if step > 0.0:
            modulus += p[1] / step
        return mean + p[1] * rate, modulus

    return replace(
        law,
        response=with_damping,
        internal=(*law.internal, *VARIABLES),
        energies=(*law.energies, "viscous_dissipation"),
        rate=True,
        mean_stress=None if mean_stress is None else mean_with_damping,
        mean_correction=_of_own(law.mean_correction),
        # energies are functions of strain and internal variables, unless the law itself depends on the rate
        mean_of_work=law.mean_of_work or (not law.rate and law.modulus is None),
        modulus=_of_own(law.modulus),
        static_limit=law.static_limit or not law.rate,
        known_rate=n + 2,
    )


def _of_own(function: Callable[..., Any] | None) -> Callable[..., Any] | None:
    """Return a function of the parameters of the law as one of those of the damped law."""
    return None if function is None else lambda p, *arguments: function(p[0], *arguments)

"""Stiffness-proportional damping of a law: a viscous stress E beta times the rate of strain, along the bar.

It is Rayleigh's C = beta K0 with the stiffness K0 of the unstressed bars in their present directions, so that rigid
motions are not damped. A mode of angular frequency w has the damping ratio beta w/2. The rate is that over the step;
the dissipation E beta rate^2 step of each step accumulates.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, Any

from ..compiled import inlined

if TYPE_CHECKING:
    from .base import Law

__all__ = ["VARIABLES", "damped"]

VARIABLES = (("viscous_dissipation_density", "J/m³"), ("viscous_stress", "Pa"))
"""Internal variables that follow those of the law."""


@cache
def damped(law: Law) -> Law:
    """Return the law with p = (p of the law, E beta [Pa s], data of the bar)."""
    response, mean_stress, n, has_data = law.response, law.mean_stress, len(law.internal), bool(law.bar_data)

    @inlined
    def own(p):
        return p[0] + p[2:] if has_data else p[0]

    @inlined
    def with_damping(strain, rate, step, temperature, p, q):
        stress, tangent, after, densities = response(strain, rate, step, temperature, own(p), q[:n])
        viscous = p[1] * rate
        lost = q[n]
        if viscous != 0.0:  # the step is infinite in static analyses
            lost += viscous * rate * step
        if step > 0.0:
            tangent += p[1] / step
        return stress + viscous, tangent, after + (lost, viscous), densities + (lost,)

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
    )


def _of_own(function: Callable[..., Any] | None) -> Callable[..., Any] | None:
    """Return a function of the parameters of the law as one of those of the damped law."""
    return None if function is None else lambda p, *arguments: function(p[0], *arguments)

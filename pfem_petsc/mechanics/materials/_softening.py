"""Softening of a law by temperature: factors of its modulus and yield stress from a table.

The modulus E of the elastic strain depends on the temperature. Over a step from E0 to E1 the elastic energy changes by
the work (s0 + s1)/2 (change of elastic strain), and by s0 s1 (1/E0 - 1/E1)/2, which is thermal work: the identity is
exact. Heat and hardening energy are no longer functions of state; they accumulate at the temperature of each step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from ..compiled import inlined

if TYPE_CHECKING:
    from .base import Law

__all__ = ["Softening", "softened"]


@dataclass(frozen=True)
class Softening:
    """How a law softens.

    Attributes
    ----------
    scale : compiled function of (p, factor of modulus, factor of yield stress) that returns p at a temperature; p[0] is
        the modulus of the elastic strain
    dissipated : compiled function of (p, q): the densities [J/m3] of all energies of the law except the elastic one, in
        their order, if they are functions of state; None if there are none or if the law accumulates them itself
    """

    scale: Callable
    dissipated: Callable | None = None


@inlined
def factors(temperature, table):
    """Return the factors of modulus and yield stress at a temperature: linear between rows, constant outside.

    ``table`` (rows, 3): temperature above reference [K] and both factors.
    """
    last = len(table) - 1
    if not (temperature > table[0, 0]):  # NaN takes the first row
        return table[0, 1], table[0, 2]
    for k in range(last):
        if temperature < table[k + 1, 0]:
            share = (temperature - table[k, 0]) / (table[k + 1, 0] - table[k, 0])
            modulus = table[k, 1] + share * (table[k + 1, 1] - table[k, 1])
            return modulus, table[k, 2] + share * (table[k + 1, 2] - table[k, 2])
    return table[last, 1], table[last, 2]


@cache
def softened(law: Law) -> Law:
    """Return the law with p = (p of the law, table of factors); see :func:`factors`."""
    response, mean_stress, interpolate = law.response, law.mean_stress, factors
    scale, dissipated, n = law.softening.scale, law.softening.dissipated, len(law.internal)

    @inlined
    def at_temperature(strain, rate, step, temperature, p, q):
        modulus, strength = interpolate(temperature, p[1])
        return response(strain, rate, step, temperature, scale(p[0], modulus, strength), q)

    @inlined
    def accumulated(strain, rate, step, temperature, p, q):
        modulus, strength = interpolate(temperature, p[1])
        scaled = scale(p[0], modulus, strength)
        before, kept = q[:n], q[n:]
        stress, tangent, after, densities = response(strain, rate, step, temperature, scaled, before)
        if after != before:
            old, new = dissipated(scaled, before), dissipated(scaled, after)
            kept = (kept[0] + (new[0] - old[0]), kept[1] + (new[1] - old[1]))
        return stress, tangent, after + kept, (densities[0],) + kept

    @inlined
    def mean_at_temperature(stress0, strain0, strain, rate, step, temperature, p, q):
        modulus, strength = interpolate(temperature, p[1])
        return mean_stress(stress0, strain0, strain, rate, step, temperature, scale(p[0], modulus, strength), q)

    def modulus(p: tuple, temperatures: np.ndarray) -> np.ndarray:
        base, table = p
        return base[0] * np.interp(temperatures, table[:, 0], table[:, 1])

    elastic = not law.internal
    return replace(
        law,
        response=at_temperature if dissipated is None else accumulated,
        internal=law.internal if dissipated is None else (*law.internal, *DENSITIES),
        smooth=False,
        mean_stress=mean_at_temperature if elastic else None,
        mean_correction=None,
        mean_of_work=False,  # a change of the modulus changes energies too
        no_mean_stress="" if elastic else _REASON,
        modulus=modulus,
    )


DENSITIES = (("plastic_heat_density", "J/m³"), ("hardening_energy_density", "J/m³"))
"""Internal variables of laws that accumulate their dissipation."""

_REASON = (
    "its stress yields at a temperature that changes within the step (softening), so its mean over a step, which this "
    "scheme needs, has no closed form"
)

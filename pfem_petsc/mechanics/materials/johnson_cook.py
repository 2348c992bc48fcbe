"""Plastic bar of Johnson and Cook: Y = (A + B a^n) (1 + C ln(da/dt/e_0)) (1 - T*^m), optionally with adiabatic heating.

G. R. Johnson and W. H. Cook, A constitutive model and data for metals subjected to large strains, high strain rates and
high temperatures, 7th International Symposium on Ballistics, The Hague 1983, 541-547. T* = (T + r)/T_melt, between 0
and 1, with the temperature T of the bar and its adiabatic rise r, both above reference. The logarithm is zero below the
reference rate e_0.

Of the plastic work the fraction b (Taylor and Quinney, Proc. R. Soc. A 143 (1934) 307-326) is heat, the rest is stored.
With a specific heat c the heat stays in the bar, r = b (plastic work)/(rho c). The rise softens the bar; its thermal
expansion is neglected.
"""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import Field

from ...case.base import NonNegativeFloat, PositiveFloat
from ..compiled import inlined
from ._plastic import viscous_law
from .base import MaterialKeys, yield_texts

__all__ = ["LAW", "Parameters", "flow_stress", "heating", "stored"]


class Parameters(MaterialKeys):
    """Keys of a material of Johnson and Cook."""

    yield_stress: PositiveFloat
    """initial yield stress A [Pa]"""
    strength_coefficient: NonNegativeFloat
    """increase B of the yield stress at an accumulated plastic strain of 1 [Pa]"""
    hardening_exponent: Annotated[float, Field(gt=0.0, le=1.0, allow_inf_nan=False)]
    """exponent n of the accumulated plastic strain, at most 1 [-]"""
    rate_coefficient: NonNegativeFloat
    """factor C of the logarithm of the rate [-]"""
    rate_reference: PositiveFloat = 1.0
    """plastic strain rate e_0 up to which the flow stress is the static one [1/s]"""
    melting_temperature: PositiveFloat | None = None
    """temperature T_melt above reference at which the flow stress is zero [K]; default: no thermal softening"""
    thermal_exponent: PositiveFloat = 1.0
    """exponent m of the temperature [-]"""
    specific_heat: PositiveFloat | None = None
    """specific heat c [J/(kg K)], for adiabatic heating; default: plastic work does not heat the bar"""
    taylor_quinney: Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)] = 0.9
    """fraction b of plastic work that is heat [-]"""

    def pack(self) -> tuple[float, ...]:
        """Return (E, 0, A, B, n, C, e_0, 1/T_melt, m, b, rise of temperature over plastic work [K m3/J])."""
        melting = 0.0 if self.melting_temperature is None else 1.0 / self.melting_temperature
        warming = 0.0 if self.specific_heat is None else self.taylor_quinney / (self.density * self.specific_heat)
        hardening = self.yield_stress, self.strength_coefficient, self.hardening_exponent
        rate = self.rate_coefficient, self.rate_reference
        return self.young_modulus, 0.0, *hardening, *rate, melting, self.thermal_exponent, self.taylor_quinney, warming

    def suspicions(self, key: str, hint: str) -> list[str]:
        """Return messages about an unrealistic strain at yield, and about heat that has no effect."""
        texts = yield_texts(key, hint, "yield_stress", self.yield_stress, self.young_modulus)
        if self.specific_heat is not None and self.melting_temperature is None:
            texts.append(f"{key}.specific_heat heats the bars, but does not soften them without melting_temperature")
        return texts


@inlined
def flow_stress(accumulated, rate, temperature, p):
    """See :func:`~pfem_petsc.mechanics.materials._plastic.viscous_law`."""
    coefficient, exponent, by_log, reference = p[3], p[4], p[5], p[6]
    risen = coefficient * accumulated**exponent if accumulated > 0.0 else 0.0
    slope = 0.0
    if coefficient > 0.0:
        slope = exponent * risen / accumulated if accumulated > 0.0 else math.inf
    static = p[2] + risen
    fast = rate > reference
    factor = 1.0 + by_log * math.log(rate / reference) if fast else 1.0
    relative = temperature * p[7]
    left, by_warmth = 1.0, 0.0
    if relative > 0.0:
        if relative >= 1.0:
            left = 0.0
        else:
            power = relative ** p[8]
            left = 1.0 - power
            by_warmth = -static * factor * p[8] * power / temperature
    return static * factor * left, slope * factor * left, by_log * static * left if fast else 0.0, by_warmth


@inlined
def stored(before, after, p, work):
    """Return the part of plastic work that is no heat."""
    return (1.0 - p[9]) * work


@inlined
def heating(p):
    """Return the rise of temperature over plastic work [K m3/J]."""
    return p[10]


LAW = viscous_law(flow_stress, stored, None, heating)

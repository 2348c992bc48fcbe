"""Bars that break or are removed: a material law of which a share is left.

Any law is turned into one whose bars can leave the model. Internal variables are added to those of the law: the state
r, from 0 (intact) to 1 (broken) or to -1 (removed), and for each energy of the law the density w_r at which it was
released. With the share that is left, s = 1 - |r|, a bar has

    stress s sigma,   tangent s E_t,   stored energy s w,   rupture dissipation w_r,

where sigma, E_t and w are those of the law. In the loop that evaluates the end of a step, r rises by 1/n (n: ``steps``
of the limits) if a limit is reached or r > 0 already. The force of this evaluation is still that with the old r, so the
step is made with the bar and the next one without. w_r rises by w times the decrease of s, so the sum of stored and
released energy does not change when a bar breaks. Energies that the law has dissipated stay dissipated, s w + w_r.

A bar of which nothing is left is not evaluated: its length may be zero, and the variables of its law do not change.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numba.extending import register_jitable

from ..columns import STORED
from .compiled import inlined
from .materials.base import Law

if TYPE_CHECKING:
    from ..case.tables import Rupture


LIMITS = ("stress", "strain", "compressive_stress", "compressive_strain", "plastic_strain", "damage")
"""Keys of the limits, in the order of their values."""

WHOLE = 1.0 - 1e-9
"""States beyond this are 1: the shares of several steps do not add up to it exactly."""

_OF_LAW = len(LIMITS) + 1  # parameters from here on are those of the law

_PLASTIC = ("accumulated_plastic_strain", "plastic_strain")


@register_jitable
def is_beyond(stress: float, strain: float, limits: tuple[float, ...]) -> bool:
    """Return whether a limit of stress [Pa] or strain is reached."""
    beyond = (stress >= limits[0]) | (strain >= limits[1])
    return beyond | (-stress >= limits[2]) | (-strain >= limits[3])


def limit_values(rupture: Rupture | None) -> tuple[float, ...]:
    """Return the values of :data:`LIMITS`, infinite for those not given, and the share released per step."""
    if rupture is None:
        return (*(math.inf for _ in LIMITS), 1.0)
    given = (getattr(rupture, key) for key in LIMITS)
    return (*(math.inf if value is None else float(value) for value in given), 1.0 / rupture.steps)


def intact(law: Law, parameters: tuple[Any, ...]) -> tuple[Law, tuple[Any, ...]]:
    """Return the law of intact bars and its parameters; the same for a law that is not breakable."""
    return (law, parameters) if law.whole is None else (law.whole, parameters[_OF_LAW:])


def variable_of(law: Law, limit: str) -> int:
    """Return the place of the internal variable that a limit compares, -1 if the law has none."""
    names = [name for name, _ in law.internal]
    wanted = _PLASTIC if limit == "plastic_strain" else (limit,)
    return next((names.index(name) for name in wanted if name in names), -1)


@cache
def breakable(law: Law) -> Law:
    """Return the law for bars that can break; its parameters are those of :func:`limit_values` and of the law."""
    count = len(law.internal)
    stored = tuple(name in STORED for name in law.energies)
    limited = variable_of(law, "plastic_strain"), variable_of(law, "damage")
    kept = tuple((f"{name}_at_rupture", "J/m³") for name in law.energies)
    return dataclasses.replace(
        law,
        response=_response(law.response, is_beyond, count, *limited, stored),
        internal=(*law.internal, ("rupture", ""), *kept),
        energies=(*law.energies, "rupture_dissipation"),
        smooth=False,
        mean_stress=None if law.mean_stress is None else _mean_stress(law.mean_stress, count),
        modulus=None if law.modulus is None else _modulus(law.modulus),
        rupture=count,
        whole=law,
    )


@inlined
def _choose(one, other, condition):
    """Return a number if a condition holds, else another."""
    return one if condition else other


@inlined
def _add(one, other, factor):
    return one + factor * other


@inlined
def _unless(value, stored, none):
    return none if stored else value


def _each(combine: Callable[..., Any], count: int) -> Callable[..., Any]:
    """Make a function that combines two tuples of ``count`` numbers, each pair of them with a third number."""
    if count == 0:

        @inlined
        def nothing(one, other, number):
            return ()

        return nothing
    before, k = _each(combine, count - 1), count - 1

    @inlined
    def combined(one, other, number):
        return before(one, other, number) + (combine(one[k], other[k], number),)  # noqa: RUF005 - tuples of Numba

    return combined


def _total(stored: tuple[bool, ...]) -> Callable[..., Any]:
    """Make a function that adds up the numbers of a tuple that are ``stored``."""
    if not stored:

        @inlined
        def nothing(values):
            return 0.0

        return nothing
    before, k, last = _total(stored[:-1]), len(stored) - 1, stored[-1]

    @inlined
    def total(values):
        return before(values) + values[k] if last else before(values)

    return total


def _response(
    law: Callable[..., Any],
    beyond: Callable[..., Any],
    count: int,
    plastic: int,
    damage: int,
    stored: tuple[bool, ...],
) -> Callable[..., Any]:
    """Make the response of the breakable form of a law with ``count`` internal variables of its own.

    ``plastic``, ``damage``: places of the variables with a limit, or -1; ``stored``: which energies bars store.
    """
    first, of_law = count + 1, _OF_LAW
    n_energies = len(stored)
    released, unless, choose = _total(stored), _each(_unless, n_energies), _each(_choose, n_energies)
    choose_new, add, none = _each(_choose, count), _each(_add, n_energies), (0.0,) * n_energies
    by_plastic, by_damage = plastic >= 0, damage >= 0
    plastic, damage = max(plastic, 0), max(damage, 0)

    @inlined
    def response(strain, rate, step, temperature, p, q):
        state = q[count]
        left = 1.0 - abs(state)
        there = left > 0.0
        stress, tangent, new, densities = law(strain, rate, step, temperature, p[of_law:], q[:count])
        over = beyond(stress, strain, p[:4])
        if by_plastic:
            over = over | (abs(new[plastic]) >= p[4])
        if by_damage:
            over = over | (new[damage] >= p[5])
        breaks = there & (state >= 0.0) & (over | (state > 0.0))
        after = state + p[6] if breaks else state
        after = 1.0 if after > WHOLE else after
        remaining = 1.0 - abs(after)
        densities = choose(densities, none, there)
        kept = add(q[first:], densities, left - remaining)
        shown = add(unless(kept, stored, 0.0), densities, remaining)
        stress = left * stress if there else 0.0
        tangent = left * tangent if there else 0.0
        new = choose_new(new, q[:count], there)
        return stress, tangent, new + (after,) + kept, shown + (released(kept),)  # noqa: RUF005 - tuples of Numba

    return response


def _mean_stress(law: Callable[..., Any], count: int) -> Callable[..., Any]:
    of_law = _OF_LAW

    @inlined
    def mean_stress(stress0, strain0, strain, step, temperature, p, q):
        left = 1.0 - abs(q[count])
        if left <= 0.0:
            return 0.0, 0.0
        mean, modulus = law(stress0 / left, strain0, strain, step, temperature, p[of_law:], q[:count])
        return left * mean, left * modulus

    return mean_stress


def _modulus(law: Callable[..., np.ndarray]) -> Callable[..., np.ndarray]:
    return lambda p, temperatures: law(p[_OF_LAW:], temperatures)

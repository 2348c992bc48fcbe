"""The law of bars that touch bars or walls: a spring, a damper, and a spring across the normal, which slips.

Numbers may be complex, with derivatives as imaginary parts.
"""

from __future__ import annotations

from math import acosh, asin, exp, pi, sqrt, tan
from typing import NamedTuple

import numpy as np

from ..mechanics.compiled import inlined
from .rotations import along, dot, minus, times

CRITICAL = exp(-2.0)
"""Restitution of a damper with which nothing swings back; walls with less get it."""


class PairLaw(NamedTuple):
    """Coulomb's coefficient of friction; damping ratio; the step [s]; the way of the nodes so far, and that from which
    they have come to where pairs may sleep [m], the same unless forces are only tried; how many steps later than the
    mean velocity of the step that of the damper is."""

    friction: float
    damping: float
    step: float
    way: float
    base: float
    lead: float = 0.5


def restitution_of(damping: float) -> float:
    """Return the ratio of velocities after and before an impact on a spring and a damper that never pull.

    Source: Schwager and Pöschel, Granular Matter 9 (2007), 465, in terms of the damping ratio.
    """
    if damping < 1.0:
        angle = asin(damping)
        return exp(-tan(angle) * (pi - 2.0 * angle))
    if damping == 1.0:
        return exp(-2.0)
    return exp(-2.0 * damping / sqrt(damping * damping - 1.0) * acosh(damping))


def damping_of(restitution: float) -> float:
    """Return the damping ratio for :func:`restitution_of`, by bisection."""
    low, high = 0.0, 1e3
    for _ in range(100):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if restitution_of(middle) > restitution else (low, middle)
    return 0.5 * (low + high) if restitution < 1.0 else 0.0


@inlined
def damp(push, k, closing, mobility, law, most):
    """Return the normal force of spring and damper, which pulls never [N]; ``closing`` is the change of the distance in
    the step. The velocity is that at the end of an explicit step, half a step later, by the force itself."""
    if law.damping <= 0.0 or law.step <= 0.0 or mobility.real <= 0.0:
        return push
    drag = 2.0 * law.damping * np.sqrt(k / mobility)
    if drag.real > most:
        drag = most
    total = (push - drag * closing / law.step) / (1.0 + law.lead * drag * law.step * mobility)
    return total if total.real > 0.0 else 0.0


@inlined
def slide(spring, k, most, way, normal):
    """Return the elastic slip of a pair, at ``most`` as given [m], after a ``way`` of its points; the energy stored,
    and that dissipated."""
    flat = along(spring, -dot(spring, normal), normal)
    left = dot(flat, flat)  # turned into the plane across the normal
    start = times(np.sqrt(dot(spring, spring) / left) if left.real > 0.0 else 0.0, flat)
    trial = along(along(start, 1.0, way), -dot(way, normal), normal)
    square = dot(trial, trial)
    end = times(most / np.sqrt(square) if square.real > (most * most).real else 1.0, trial)
    return end, 0.5 * k * dot(end, end), 0.5 * k * dot(along(start, 1.0, end), minus(trial, end))

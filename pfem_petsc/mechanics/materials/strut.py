"""Strut that buckles: an elastic column with a plastic hinge at midspan, after Nonaka."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
from numba.extending import register_jitable

from ...case.base import NonNegativeFloat, PositiveFloat
from ..compiled import kernel
from .base import BarShapes, Law, MaterialKeys, UnsuitableBarError, mean_of_work, yield_texts

_QUARTER = 0.5 * math.pi
_MOST = 100  # iterations of a root that is bracketed; about 6 are needed
_POINTS = 200  # at which the slope of a branch is looked at, and bisections of a change of its sign
_BISECTIONS = 60


class Parameters(MaterialKeys):
    """Keys of struts."""

    describes_buckling: ClassVar[bool] = True
    largest_shortening: ClassVar[float] = 0.2

    yield_stress: PositiveFloat
    """yield stress [Pa]"""
    imperfection: NonNegativeFloat = 0.0
    """initial deflection at midspan over the effective length"""

    def pack(self) -> tuple[float, ...]:
        """Return E, s_Y [Pa] and the initial angle at midspan, of two straight halves."""
        return float(self.young_modulus), float(self.yield_stress), 4.0 * float(self.imperfection)

    def pack_bars(self, bars: BarShapes) -> tuple[np.ndarray, ...]:
        """Return r, b, u, and the angles z between which equilibrium is not stable."""
        bad = np.flatnonzero(bars.second_moment == 0.0)
        if len(bad):
            raise UnsuitableBarError(
                bad[0], 'a strut buckles: give the section a shape ("round", "tube") or second_moment'
            )
        young, yields = self.young_modulus, self.yield_stress
        ratio = bars.second_moment / (bars.area * bars.effective_length**2)
        bending = 2.0 * young * bars.second_moment / (bars.effective_length * yields * bars.plastic_modulus)
        shortening = bars.plastic_modulus / (bars.area * bars.effective_length)
        return (ratio, bending, shortening, *folds(ratio, bending, shortening, young / yields))

    def suspicions(self, key: str, hint: str) -> list[str]:
        """Return messages about unrealistic yield strains and imperfections."""
        texts = yield_texts(key, hint, "yield_stress", self.yield_stress, self.young_modulus)
        if self.imperfection > 0.1:
            texts.append(f"{key}.imperfection = {self.imperfection:g} of the length is an arch, not a strut")
        return texts


@register_jitable
def _shape(z):
    """Return S = sin(2z)/(2z) and its derivative over z."""
    if z < 1e-2:
        v = z * z
        return 1.0 - v * (2.0 / 3.0 - v * (2.0 / 15.0)), -4.0 / 3.0 + v * (8.0 / 15.0)
    s = math.sin(2.0 * z) / (2.0 * z)
    return s, (math.cos(2.0 * z) - s) / (z * z)


@register_jitable
def _pull(y):
    """Return sech^2 y, tanh(y)/y and the derivative of their sum over y."""
    sech = 1.0 / math.cosh(min(y, 300.0))
    sech *= sech
    if y < 1e-2:
        v = y * y
        return sech, 1.0 - v * (1.0 / 3.0 - v * (2.0 / 15.0)), -8.0 / 3.0 + v * (16.0 / 5.0)
    t = math.tanh(y) / y
    return sech, t, (-2.0 * sech * math.tanh(y) + (sech - t) / y) / y


@register_jitable
def _bowed(short, angle, r):
    """Return z, s and dz^2/d(shortening) of an elastic column with a hinge angle, at a shortening of at least
    angle^2/8."""
    if angle == 0.0:
        if short <= 4.0 * r * _QUARTER * _QUARTER:
            return math.sqrt(short / (4.0 * r)), 0.0, 0.25 / r
        return _QUARTER, 2.0 * math.sqrt(short - 4.0 * r * _QUARTER * _QUARTER), 0.0
    low, high = 0.5 * angle, max(2.0 * math.sqrt(short), 0.5 * angle)
    beyond = short - 4.0 * r * _QUARTER * _QUARTER
    s = 2.0 * math.sqrt(beyond) if beyond > 0.0 else low / math.cos(math.sqrt(short / (4.0 * r)))
    s = min(max(s, low), high)
    z, rise, slope = 0.0, 0.0, 1.0
    for _ in range(_MOST):
        c = min(0.5 * angle / s, 1.0)
        z = math.acos(c)
        shape, bend = _shape(z)
        rise = c / s if z < 1e-8 else c * z / (s * math.sin(z))  # z dz/ds
        value = 4.0 * r * z * z + 0.25 * s * s * (1.0 + shape) - short
        slope = rise * (8.0 * r + 0.25 * s * s * bend) + 0.5 * s * (1.0 + shape)
        if value > 0.0:
            high = s
        else:
            low = s
        new = s - value / slope
        if not low < new < high:
            new = 0.5 * (low + high)
        if abs(new - s) <= 2e-16 * s or high - low <= 4e-16 * high:
            break
        s = new
    return z, s, 2.0 * rise / slope


@register_jitable
def _pulled(long, angle, r):
    """Return y and d(y^2)/d(strain) of an elastic bar with a hinge angle; ``long`` is the strain in excess of that
    without stress."""
    share = angle * angle / 16.0
    v = max(0.0, (long - 2.0 * share) / (4.0 * r))
    slope = 4.0 * r
    for _ in range(_MOST):
        y = math.sqrt(v)
        sech, t, fall = _pull(y)
        slope = 4.0 * r - 0.5 * share * fall
        change = (long - 4.0 * r * v - share * (2.0 - sech - t)) / slope
        v = max(v + change, 0.0)
        if abs(change) <= 2e-16 * v:
            break
    return math.sqrt(v), 1.0 / slope


@register_jitable
def _hinged(z, r, b, c, u):
    """Return B, dB/dz, s and the hinge angle on the branch of an opening hinge."""
    sine, cosine = math.sin(z), math.cos(z)
    shape, bend = _shape(z)
    s = (1.0 - c * z * z) / (b * z * sine)
    ds = (-2.0 * c * z - b * s * (sine + z * cosine)) / (b * z * sine)
    angle = 2.0 * s * cosine
    value = -u * angle - 4.0 * r * z * z - 0.25 * s * s * (1.0 + shape)
    slope = -2.0 * u * (ds * cosine - s * sine) - 8.0 * r * z - 0.5 * s * ds * (1.0 + shape) - 0.25 * s * s * bend * z
    return value, slope, s, angle


@register_jitable
def _closing(y, r, b, c, u):
    """Return the same as :func:`_hinged` without s, in tension, where the hinge closes."""
    t, (sech, over, fall) = math.tanh(y), _pull(y)
    angle = 2.0 * (1.0 - c * y * y) / (b * y * t)
    turn = 2.0 * (-2.0 * c * y * y * t - (1.0 - c * y * y) * (t + y * sech)) / (b * y * y * t * t)
    value = -u * angle + 4.0 * r * y * y - angle * angle * (sech + over) / 16.0
    slope = -u * turn + 8.0 * r * y - angle * turn * (sech + over) / 8.0 - angle * angle * fall * y / 16.0
    return value, slope, angle


@kernel
def _find_folds(numbers, inverse_yield, found):
    """Write to ``found`` (2, b) the largest and smallest angle z between which the strain decreases with z, for bars
    with the numbers r, b and u (3, b); both stay zero without."""
    for k in range(found.shape[1]):
        r, b, u = numbers[0, k], numbers[1, k], numbers[2, k]
        c = 4.0 * inverse_yield * r
        part = min(_QUARTER, 1.0 / math.sqrt(c)) / _POINTS
        first = last = 0
        for j in range(1, _POINTS + 1):
            if _hinged(j * part, r, b, c, u)[1] < 0.0:
                first, last = first or j, j
        if not first:
            continue
        for end, inside, outside in ((0, last, min(last + 1, _POINTS)), (1, first, max(first - 1, 1))):
            low, high = inside * part, outside * part
            for _ in range(_BISECTIONS):
                middle = 0.5 * (low + high)
                within = _hinged(middle, r, b, c, u)[1] < 0.0
                low, high = (middle, high) if within else (low, middle)
            found[end, k] = low


def folds(
    ratio: np.ndarray, bending: np.ndarray, shortening: np.ndarray, inverse_yield: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest and smallest angle z (b,) between which the strain decreases with z; both zero without.

    Parameters
    ----------
    ratio, bending, shortening : (b,) r, b and u of :mod:`~pfem_petsc.mechanics.materials.strut`
    inverse_yield : Young's modulus over yield stress
    """
    # digits that differ by rounding must not make other bars of equal ones, or lattices would take long
    numbers = np.stack([ratio, bending, shortening])
    scale = 10.0 ** np.floor(np.log10(np.maximum(numbers, 1e-300)))
    kinds, which = np.unique(np.round(numbers / scale, 9) * scale, axis=1, return_inverse=True)
    found = np.zeros((2, kinds.shape[1]))
    _find_folds(np.ascontiguousarray(kinds), inverse_yield, found)
    return tuple(found[:, np.ravel(which)])


@register_jitable
def _root(target, low, high, compressed, of_angle, bar):
    """Return z in (low, high], where the branch is monotone, at which its strain B (or its angle) is the target;
    ``bar``: r, b, c and u."""
    z = high
    for _ in range(_MOST):
        if compressed:
            value, slope, _, angle = _hinged(z, *bar)
        else:
            value, slope, angle = _closing(z, *bar)
        value = target - angle if of_angle else value - target
        low, high = (z, high) if value < 0.0 else (low, z)
        new = low if of_angle else z - value / slope
        if not low < new < high:
            new = 0.5 * (low + high)
        if abs(new - z) <= 2e-16 * z or high - low <= 4e-16 * high:
            break
        z = new
    return z


@register_jitable
def _energy(z, s, young, r):
    """Return the elastic energy density in compression [J/m3]."""
    return young * r * z * z * (8.0 * r * z * z + s * s * (1.0 - _shape(z)[0]))


@register_jitable
def _opened(target, angle, young, yields, bar, upper, lower):
    """Return z on the branch of an opening hinge at a strain, and the energy density that a snap has set free."""
    r, _, c, u = bar
    most = min(_QUARTER, 1.0 / math.sqrt(c))
    if upper <= lower:
        return _root(target, 0.0, most, True, False, bar), 0.0
    _, _, _, first = _hinged(upper, *bar)
    _, _, _, last = _hinged(lower, *bar)
    if angle >= last:
        return _root(target, 0.0, lower, True, False, bar), 0.0
    start = upper if angle <= first else _root(angle, lower, upper, True, True, bar)
    strain, _, slope, turned = _hinged(start, *bar)
    if target >= strain and angle <= first:
        return _root(target, upper, most, True, False, bar), 0.0
    landed = _root(strain, 0.0, lower, True, False, bar)
    _, _, bowed, after = _hinged(landed, *bar)
    free = _energy(start, slope, young, r) - _energy(landed, bowed, young, r) - yields * u * (after - turned)
    return _root(target, 0.0, lower, True, False, bar), max(free, 0.0)


@register_jitable
def response(strain, rate, step, temperature, p, q):
    """See :class:`~pfem_petsc.mechanics.materials.base.Law`; q = (plastic strain, accumulated plastic strain, hinge
    angle beyond the initial one, energy density set free by snaps)."""
    young, yields, initial, r, b, u, upper, lower = p
    plastic, accumulated, turned, released = q
    c = 4.0 * young * r / yields
    angle = max(initial + turned, 0.0)
    base = initial * initial / 8.0
    short = plastic + base - strain
    flow = 0.0
    if short > angle * angle / 8.0:
        z, s, rise = _bowed(short, angle, r)
        stiffness = 4.0 * young * r * rise
        if b * z * s * math.sin(z) + c * z * z > 1.0:
            target = strain - plastic - base - u * angle
            z, free = _opened(target, angle, young, yields, (r, b, c, u), upper, lower)
            _, slope, s, after = _hinged(z, r, b, c, u)
            flow = max(after - angle, 0.0)
            turned, plastic, accumulated = turned + flow, plastic - u * flow, accumulated + u * flow
            released += free
            stiffness = -8.0 * young * r * z / slope
        stress = -4.0 * young * r * z * z
        elastic = _energy(z, s, young, r)
    else:
        y, rise = _pulled(angle * angle / 8.0 - short, angle, r)
        stiffness = 4.0 * young * r * rise
        if 0.5 * b * y * angle * math.tanh(y) + c * y * y > 1.0:
            end = 1.0 / math.sqrt(c)
            target = strain - plastic - base - u * angle
            if target >= 4.0 * r / c:
                y, stiffness, after = end, 0.0, 0.0
                new = strain - base - yields / young
            else:
                y = _root(target, 0.0, end, False, False, (r, b, c, u))
                _, slope, after = _closing(y, r, b, c, u)
                after = min(after, angle)
                new = plastic + u * (angle - after)
                stiffness = 8.0 * young * r * y / slope
            accumulated += max(new - plastic, 0.0)
            plastic, turned, angle = new, after - initial, after
        stress = 4.0 * young * r * y * y
        sech, t, _ = _pull(y)
        elastic = young * r * y * y * (8.0 * r * y * y + 0.25 * angle * angle * (t - sech))
    return stress, stiffness, (plastic, accumulated, turned, released), (elastic, yields * accumulated + released)


LAW = Law(
    response,
    internal=(
        ("plastic_strain", ""),
        ("accumulated_plastic_strain", ""),
        ("hinge_rotation", ""),
        ("snap_energy_density", "J/m³"),
    ),
    energies=("elastic_energy", "plastic_heat"),
    bar_data=("slenderness", "bending", "shortening", "unstable_from", "unstable_to"),
    mean_stress=mean_of_work(response),
    mean_of_work=True,
)

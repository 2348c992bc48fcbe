"""The discrete-gradient force of bars between two positions, of Simo-Tarnow type, which conserves energy; strain
measures.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from types import SimpleNamespace

from numba.extending import register_jitable

from .bar_loops import COLLAPSED_STRETCH, last_row, no_bar_data, no_variables
from .compiled import inlined, kernel
from .materials.base import Law
from .rows import bar_value, extend, take


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


@register_jitable
def _engineering_ratio(s0: float, s1: float) -> tuple[float, float]:
    total = s0 + s1
    return 2.0 / total, -2.0 / (total * total)


@register_jitable
def _green_ratio(s0: float, s1: float) -> tuple[float, float]:
    return 1.0, 0.0


@register_jitable
def _logarithmic_ratio(s0: float, s1: float) -> tuple[float, float]:
    q = s1 / s0 - 1.0
    if abs(q) < 1e-4:
        # ln(1+q)/(q (1 + q/2)) = 1 - q + 5/6 q^2 - 2/3 q^3 + ...
        value = 1.0 - q * (1.0 - q * (5.0 / 6.0 - q * (2.0 / 3.0)))
        slope = -1.0 + q * (5.0 / 3.0 - 2.0 * q)
    else:
        bottom = q * (1.0 + 0.5 * q)
        value = math.log1p(q) / bottom
        slope = (1.0 / (1.0 + q) - value * (1.0 + q)) / bottom
    return value / (s0 * s0), slope / (s0 * s0 * s0)


# L^2 R and L^2 dR/ds1 for the stretches s0 = l0/L, s1 = l1/L
_RATIOS = {engineering: _engineering_ratio, green: _green_ratio, logarithmic: _logarithmic_ratio}


@cache
def make_conserving_kernels(law: Law, measure: Callable) -> SimpleNamespace:
    """Make the kernels ``forces`` and ``tangents`` of a material law; arguments as in
    :mod:`~pfem_petsc.mechanics.bar_loops`, with positions, thermal strains and temperatures at the start (``x0``,
    ``cold``) and end (``x``, ``heat``) of the step; ``rest0`` (b,): rest lengths at the start, (0,) if constant."""
    response, mean_stress, like, by_rate, last = (
        law.response,
        law.mean_stress,
        no_variables(law),
        law.rate,
        last_row(law),
    )
    ratio, of_bar, n_rows = _RATIOS[measure], no_bar_data(law), len(law.rows)
    can_break, gone = law.rupture >= 0, max(law.rupture, 0)

    @inlined
    def pair(ox, oy, oz, dx, dy, dz, rest0, rest1, shift0, shift, warmth0, warmth, p, area, step, kept, q):
        """Return the coefficient c = A l0 S R [N/m], dc/dl1 [N/m2] and 1/l1; c is NaN for a collapsed bar."""
        if can_break:  # noqa: SIM102 - not compiled otherwise
            if abs(q[gone]) >= 1.0:
                return 0.0, 0.0, 0.0
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        length0 = math.sqrt(ox * ox + oy * oy + oz * oz)
        rest = 0.5 * (rest0 + rest1)
        s0 = length0 / rest
        s1 = length / rest
        if not (s1 > COLLAPSED_STRETCH):
            return math.nan, 0.0, 0.0
        e0, _, _ = measure(s0)
        e1, slope, _ = measure(s1)
        if rest0 != rest1:
            e0, _, _ = measure(length0 / rest0)
            e1, slope, _ = measure(length / rest1)
            slope *= rest / rest1
        rate = 0.0
        if by_rate:
            stress0 = kept * (1.0 - abs(q[gone])) if can_break else kept
            if step > 0.0:
                rate = ((e1 - shift) - (e0 - shift0)) / step
        else:
            stress0, _, _, _ = response(e0 - shift0, 0.0, 0.0, warmth0, p, q)
        mean, modulus = mean_stress(stress0, e0 - shift0, e1 - shift, rate, step, warmth, p, q)
        r, dr = ratio(s0, s1)
        c = area * mean * r / rest
        dc = area * (modulus * slope * r + mean * dr) / (rest * rest)
        return c, dc, 1.0 / length

    @kernel
    def forces(x0, cold, rest0, x, bars, rest, heat, p, area, step, history, start, stop, f):
        """Add the step's internal forces to ``f``."""
        has_thermal = heat.shape[1] > 0
        changes = len(rest0) > 0
        for k in range(start, stop):
            a = bars[k, 0]
            b = bars[k, 1]
            shift0 = cold[0, k] if has_thermal else 0.0
            shift = heat[0, k] if has_thermal else 0.0
            warmth0 = cold[1, k] if has_thermal else 0.0
            warmth = heat[1, k] if has_thermal else 0.0
            q = take(history, k - start, like)
            kept = history[last + 1, k - start] if by_rate else 0.0
            given = extend(p, history, n_rows, k - start, of_bar)
            ox = x0[b, 0] - x0[a, 0]
            oy = x0[b, 1] - x0[a, 1]
            oz = x0[b, 2] - x0[a, 2]
            dx = x[b, 0] - x[a, 0]
            dy = x[b, 1] - x[a, 1]
            dz = x[b, 2] - x[a, 2]
            first = rest0[k] if changes else rest[k]
            section = bar_value(area, k - start)
            c, _, _ = pair(
                ox, oy, oz, dx, dy, dz, first, rest[k], shift0, shift, warmth0, warmth, given, section, step, kept, q
            )
            dx, dy, dz = 0.5 * (ox + dx), 0.5 * (oy + dy), 0.5 * (oz + dz)
            f[a, 0] -= c * dx
            f[a, 1] -= c * dy
            f[a, 2] -= c * dz
            f[b, 0] += c * dx
            f[b, 1] += c * dy
            f[b, 2] += c * dz

    @kernel
    def tangents(
        x0,
        cold,
        rest0,
        x,
        bars,
        rest,
        heat,
        p,
        area,
        step,
        history,
        start,
        stop,
        inertia,
        lengths,
        weight,
        ptr,
        slots,
        values,
    ):
        """Add ``weight`` df/dx1 = c/2 I + dc/dl1 d n1^T (not symmetric) and the consistent inertia."""
        has_thermal = heat.shape[1] > 0
        changes = len(rest0) > 0
        for k in range(start, stop):
            a = bars[k, 0]
            b = bars[k, 1]
            shift0 = cold[0, k] if has_thermal else 0.0
            shift = heat[0, k] if has_thermal else 0.0
            warmth0 = cold[1, k] if has_thermal else 0.0
            warmth = heat[1, k] if has_thermal else 0.0
            q = take(history, k - start, like)
            kept = history[last + 1, k - start] if by_rate else 0.0
            given = extend(p, history, n_rows, k - start, of_bar)
            ox = x0[b, 0] - x0[a, 0]
            oy = x0[b, 1] - x0[a, 1]
            oz = x0[b, 2] - x0[a, 2]
            dx = x[b, 0] - x[a, 0]
            dy = x[b, 1] - x[a, 1]
            dz = x[b, 2] - x[a, 2]
            first = rest0[k] if changes else rest[k]
            section = bar_value(area, k - start)
            c, dc, inverse = pair(
                ox, oy, oz, dx, dy, dz, first, rest[k], shift0, shift, warmth0, warmth, given, section, step, kept, q
            )
            d = (0.5 * (ox + dx), 0.5 * (oy + dy), 0.5 * (oz + dz))
            n = (dx * inverse, dy * inverse, dz * inverse)
            mass = bar_value(inertia, k - start) * lengths[k]
            for side in range(4):
                slot = slots[k, side]
                if slot < 0:
                    continue
                row = a if side < 2 else b
                sign = weight if side % 2 == 0 else -weight
                m = 2.0 * mass if side % 2 == 0 else mass
                at = 6 * ptr[row] + 3 * slot
                wide = 3 * (ptr[row + 1] - ptr[row])
                for i in range(3):
                    for j in range(3):
                        values[at + i * wide + j] += sign * dc * d[i] * n[j]
                    values[at + i * wide + i] += sign * 0.5 * c + m

    return SimpleNamespace(forces=forces, tangents=tangents)

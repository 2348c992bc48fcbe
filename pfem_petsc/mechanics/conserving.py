"""Bars between two positions: the discrete-gradient force of Simo-Tarnow type, which conserves energy and momenta.

Between d0 and d1 (end differences of a bar at the start and end of a step) with d = (d0 + d1)/2, the force on the ends
is -+ A l0 S R d, with R = (e1 - e0)/((l1^2 - l0^2)/2) and the stress S, the mean over a path on which the strain goes
from e0 to e1 in one direction. Its work over the step is exactly A l0 S (e1 - e0); it is along d, so that both momenta
are kept. For engineering strain R = 2/(L (l0 + l1)), for Green's 1/L^2, for the logarithmic
ln(l1/l0)/((l1^2 - l0^2)/2).

For an elastic bar S = (s0 + s1)/2, and the work is the change of its energy. A bar that yields at the part q of the
strain's change before the end follows the line of modulus E to its yield stress and that of modulus Et from there:

    S = (s0 + s1)/2 + E de_p (1 - q)/2,   q = E de_p/((E - Et)(e1 - e0)),   dS/de1 = (Et + (E - Et)(1 - q)^2)/2,

with the plastic strain de_p of the step. The law's energies are functions of state on that path, so that the work is
the change of elastic energy and the plastic dissipation, which is not negative. (s0 + s1)/2 would work less than is
dissipated: such a step gains energy. Where temperature changes, e is the strain less the thermal strain.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from types import SimpleNamespace

import numpy as np
from numba.extending import register_jitable

from .compiled import kernel
from .kernels import COLLAPSED_STRETCH
from .strain import engineering, green, logarithmic

__all__ = ["make_conserving_kernels", "mean_stress_of_flow"]


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
def make_conserving_kernels(response: Callable, remembers: bool, measure: Callable) -> SimpleNamespace:
    """Kernels ``forces`` and ``tangents`` of a material law; arguments as in :mod:`~pfem_petsc.mechanics.kernels`, with
    positions and thermal strains at the start (``x0``, ``cold``) and end (``x``, ``thermal``) of the step."""

    ratio = _RATIOS[measure]

    @register_jitable
    def pair(ox, oy, oz, dx, dy, dz, rest, shift0, shift, p, area, plastic, accumulated):
        """Coefficient c = A l0 S R [N/m], dc/dl1 [N/m2] and 1/l1; c is NaN for a collapsed bar."""
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        s0 = math.sqrt(ox * ox + oy * oy + oz * oz) / rest
        s1 = length / rest
        if not (s1 > COLLAPSED_STRETCH):
            return math.nan, 0.0, 0.0
        e0, _, _ = measure(s0)
        e1, slope, _ = measure(s1)
        stress0, _, _, _, _, _, _ = response(e0 - shift0, p, plastic, accumulated)
        stress1, modulus, flowed, _, _, _, _ = response(e1 - shift, p, plastic, accumulated)
        mean = 0.5 * (stress0 + stress1)
        if remembers and flowed != plastic:
            young, change = p[0], (e1 - shift) - (e0 - shift0)
            lost = young - modulus
            q = young * (flowed - plastic) / (lost * change) if change != 0.0 else 1.0
            q = min(max(q, 0.0), 1.0)  # beyond by rounding only: the start is not outside of the yield surface
            mean += 0.5 * young * (flowed - plastic) * (1.0 - q)
            modulus += lost * (1.0 - q) * (1.0 - q)
        r, dr = ratio(s0, s1)
        c = area * mean * r / rest
        dc = area * (0.5 * modulus * slope * r + mean * dr) / (rest * rest)
        return c, dc, 1.0 / length

    @kernel
    def forces(x0, cold, x, bars, rest, thermal, p, area, history, start, stop, f):
        """Add the step's internal forces to ``f``."""
        warm = len(thermal) > 0
        for k in range(start, stop):
            a = bars[k, 0]
            b = bars[k, 1]
            shift0 = cold[k] if warm else 0.0
            shift = thermal[k] if warm else 0.0
            plastic = history[0, k - start] if remembers else 0.0
            accumulated = history[1, k - start] if remembers else 0.0
            ox = x0[b, 0] - x0[a, 0]
            oy = x0[b, 1] - x0[a, 1]
            oz = x0[b, 2] - x0[a, 2]
            dx = x[b, 0] - x[a, 0]
            dy = x[b, 1] - x[a, 1]
            dz = x[b, 2] - x[a, 2]
            c, _, _ = pair(ox, oy, oz, dx, dy, dz, rest[k], shift0, shift, p, area, plastic, accumulated)
            dx, dy, dz = 0.5 * (ox + dx), 0.5 * (oy + dy), 0.5 * (oz + dz)
            f[a, 0] -= c * dx
            f[a, 1] -= c * dy
            f[a, 2] -= c * dz
            f[b, 0] += c * dx
            f[b, 1] += c * dy
            f[b, 2] += c * dz

    @kernel
    def tangents(x0, cold, x, bars, rest, thermal, p, area, history, start, stop, inertia, weight, ptr, slots, values):
        """Add ``weight`` df/dx1 = c/2 I + dc/dl1 d n1^T (not symmetric) and the consistent inertia."""
        warm = len(thermal) > 0
        for k in range(start, stop):
            a = bars[k, 0]
            b = bars[k, 1]
            shift0 = cold[k] if warm else 0.0
            shift = thermal[k] if warm else 0.0
            plastic = history[0, k - start] if remembers else 0.0
            accumulated = history[1, k - start] if remembers else 0.0
            ox = x0[b, 0] - x0[a, 0]
            oy = x0[b, 1] - x0[a, 1]
            oz = x0[b, 2] - x0[a, 2]
            dx = x[b, 0] - x[a, 0]
            dy = x[b, 1] - x[a, 1]
            dz = x[b, 2] - x[a, 2]
            c, dc, inverse = pair(ox, oy, oz, dx, dy, dz, rest[k], shift0, shift, p, area, plastic, accumulated)
            d = (0.5 * (ox + dx), 0.5 * (oy + dy), 0.5 * (oz + dz))
            n = (dx * inverse, dy * inverse, dz * inverse)
            mass = inertia * rest[k]
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


def mean_stress_of_flow(parameters: tuple[float, ...], stress: np.ndarray, flow: np.ndarray) -> np.ndarray:
    """What yielding adds to the mean stress (s0 + s1)/2 of a step: E de_p (1 - q)/2 [Pa].

    ``parameters`` of the elastoplastic law; ``stress`` s1 - s0 [Pa] and ``flow`` de_p of each bar.
    """
    young, *_, inverse = parameters
    change = stress / young + flow
    with np.errstate(divide="ignore", invalid="ignore"):
        q = np.where(flow != 0.0, flow / (young * inverse * change), 1.0)
    return 0.5 * young * flow * (1.0 - np.clip(np.nan_to_num(q, nan=1.0, posinf=1.0, neginf=1.0), 0.0, 1.0))

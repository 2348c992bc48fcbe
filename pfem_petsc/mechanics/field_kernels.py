"""Compiled loops over bars: fields of the results, and strain rates."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from .compiled import kernel
from .law_rows import last_row, no_bar_data, no_variables
from .materials.base import Law
from .rows import bar_value, extend, take

__all__ = ["make_field_kernels"]


def make_field_kernels(law: Law, measure: Callable) -> dict[str, Any]:
    """Make ``fields``, ``densities`` and ``rates``.

    Arguments: see :func:`~pfem_petsc.mechanics.kernels.make_kernels`.
    """
    response, like, by_rate, last, n_rows = law.response, no_variables(law), law.rate, last_row(law), len(law.rows)
    of_bar = no_bar_data(law)
    can_break, gone, known = law.rupture >= 0, max(law.rupture, 0), max(law.known_rate, 0)

    @kernel
    def fields(x, bars, rest, heat, p, area, step, history, start, stop, strain_out, stress_out, force_out):
        """Write total strain, stress [Pa] and axial force [N] of each bar at the end of the last step."""
        has_thermal = heat.shape[1] > 0
        for k in range(start, stop):
            a = bars[k, 0]
            b = bars[k, 1]
            dx = x[b, 0] - x[a, 0]
            dy = x[b, 1] - x[a, 1]
            dz = x[b, 2] - x[a, 2]
            strain, slope, _ = measure(math.sqrt(dx * dx + dy * dy + dz * dz) / rest[k])
            shift = heat[0, k] if has_thermal else 0.0
            warmth = heat[1, k] if has_thermal else 0.0
            q = take(history, k - start, like)
            if by_rate:
                stress = history[last + 1, k - start]
                if can_break:
                    stress *= 1.0 - abs(q[gone])
            else:
                given = extend(p, history, n_rows, k - start, of_bar)
                stress, _, _, _ = response(strain - shift, 0.0, 0.0, warmth, given, q)
            strain_out[k] = strain
            stress_out[k] = stress
            force_out[k] = bar_value(area, k - start) * stress * slope

    @kernel
    def densities(x, bars, rest, heat, p, area, step, history, start, stop, out):
        """Write stored and dissipated energy per rest volume [J/m3] of each bar, for laws without rate."""
        has_thermal = heat.shape[1] > 0
        for k in range(start, stop):
            a = bars[k, 0]
            b = bars[k, 1]
            dx = x[b, 0] - x[a, 0]
            dy = x[b, 1] - x[a, 1]
            dz = x[b, 2] - x[a, 2]
            strain, _, _ = measure(math.sqrt(dx * dx + dy * dy + dz * dz) / rest[k])
            shift = heat[0, k] if has_thermal else 0.0
            warmth = heat[1, k] if has_thermal else 0.0
            q = take(history, k - start, like)
            given = extend(p, history, n_rows, k - start, of_bar)
            _, _, _, found = response(strain - shift, 0.0, 0.0, warmth, given, q)
            for density in found:
                out[k] += density

    @kernel
    def rates(x0, x, v, bars, rest, heat, eta, step, history, start, stop):
        """Write the known part of the strain rate of each bar of a law with one, that of the balance less ``eta``
        ``step`` times the mean rate over the step; ``v`` at the positions ``x``, the step begins at ``x0``."""
        has_thermal = heat.shape[1] > 0
        for k in range(start, stop):
            a = bars[k, 0]
            b = bars[k, 1]
            dx = x[b, 0] - x[a, 0]
            dy = x[b, 1] - x[a, 1]
            dz = x[b, 2] - x[a, 2]
            length = math.sqrt(dx * dx + dy * dy + dz * dz)
            strain, slope, _ = measure(length / rest[k])
            along = dx * (v[b, 0] - v[a, 0]) + dy * (v[b, 1] - v[a, 1]) + dz * (v[b, 2] - v[a, 2])
            rate = slope * along / (length * rest[k]) if length > 0.0 else 0.0
            if step > 0.0:
                shift = heat[0, k] if has_thermal else 0.0
                before = history[last, k - start]
                dx = x0[b, 0] - x0[a, 0]
                dy = x0[b, 1] - x0[a, 1]
                dz = x0[b, 2] - x0[a, 2]
                begun, _, _ = measure(math.sqrt(dx * dx + dy * dy + dz * dz) / rest[k])
                # what temperatures and rest lengths change the strain by in the step, and the strain at x
                rate += (begun - shift - before) / step + eta * (before - (strain - shift))
            history[known, k - start] = rate

    return {"fields": fields, "densities": densities, "rates": rates}

"""Compiled loops over bars: stiffness, assembled and as products."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from .compiled import inlined, kernel
from .law_rows import last_row, no_bar_data, no_variables
from .materials.base import Law
from .rows import CHUNK, bar_value, extend, take
from .strips import differences

__all__ = ["make_tangent_kernels"]


def make_tangent_kernels(law: Law, measure: Callable) -> dict[str, Any]:
    """Make ``tangents``, ``product``, ``linearise`` and ``stiffnesses``.

    Arguments: see :func:`~pfem_petsc.mechanics.kernels.make_kernels`.
    """
    response, like, by_rate, last, n_rows = law.response, no_variables(law), law.rate, last_row(law), len(law.rows)
    of_bar = no_bar_data(law)
    can_break, gone = law.rupture >= 0, max(law.rupture, 0)

    @inlined
    def stiffness(dx, dy, dz, rest, shift, warmth, p, area, step, before, q):
        """Return dN/dl [N/m], N/l [N/m] and 1/l of one bar."""
        if can_break:  # noqa: SIM102 - not compiled otherwise
            if abs(q[gone]) >= 1.0:
                return 0.0, 0.0, 0.0
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        strain, slope, curvature = measure(length / rest)
        rate = 0.0
        if by_rate and step > 0.0:
            rate = (strain - shift - before) / step
        stress, modulus, _, _ = response(strain - shift, rate, step, warmth, p, q)
        axial = area * (modulus * slope * slope + stress * curvature) / rest
        return axial, area * stress * slope / length, 1.0 / length

    @kernel
    def tangents(
        x, bars, rest, heat, p, area, step, history, start, stop, inertia, lengths, weight, ptr, slots, values
    ):
        """Add ``weight`` K_t, and ``inertia`` times ``lengths`` (b,) in the mesh (2 on the diagonal, 1 off it), to the
        block rows of owned nodes.

        ``slots`` (b, 4): index among all blocks of (a, a), (a, b), (b, b), (b, a), -1 if the row is not owned;
        ``ptr`` (owned + 1,) first block of each row; ``values``: the matrix in scalar compressed rows.
        """
        has_thermal = heat.shape[1] > 0
        for k in range(start, stop):
            a = bars[k, 0]
            b = bars[k, 1]
            shift = heat[0, k] if has_thermal else 0.0
            warmth = heat[1, k] if has_thermal else 0.0
            nx = x[b, 0] - x[a, 0]
            ny = x[b, 1] - x[a, 1]
            nz = x[b, 2] - x[a, 2]
            q = take(history, k - start, like)
            before = history[last, k - start] if by_rate else 0.0
            given = extend(p, history, n_rows, k - start, of_bar)
            section = bar_value(area, k - start)
            axial, geometric, inverse = stiffness(nx, ny, nz, rest[k], shift, warmth, given, section, step, before, q)
            nx *= inverse
            ny *= inverse
            nz *= inverse
            axial = weight * (axial - geometric)
            geometric = weight * geometric
            mass = bar_value(inertia, k - start) * lengths[k]
            for side in range(4):
                slot = slots[k, side]
                if slot < 0:
                    continue
                row = a if side < 2 else b
                sign = 1.0 if side % 2 == 0 else -1.0
                m = 2.0 * mass if side % 2 == 0 else mass
                at = 6 * ptr[row] + 3 * slot
                wide = 3 * (ptr[row + 1] - ptr[row])
                c = sign * axial
                d = sign * geometric + m
                values[at] += c * nx * nx + d
                values[at + 1] += c * nx * ny
                values[at + 2] += c * nx * nz
                at += wide
                values[at] += c * ny * nx
                values[at + 1] += c * ny * ny + d
                values[at + 2] += c * ny * nz
                at += wide
                values[at] += c * nz * nx
                values[at + 1] += c * nz * ny
                values[at + 2] += c * nz * nz + d

    @kernel
    def product(x, bars, rest, heat, p, area, step, history, start, stop, u, out):
        """Add K_t u to ``out``; both (local nodes, 3), ``u`` with ghosts."""
        has_thermal = heat.shape[1] > 0
        for k in range(start, stop):
            a = bars[k, 0]
            b = bars[k, 1]
            shift = heat[0, k] if has_thermal else 0.0
            warmth = heat[1, k] if has_thermal else 0.0
            nx = x[b, 0] - x[a, 0]
            ny = x[b, 1] - x[a, 1]
            nz = x[b, 2] - x[a, 2]
            q = take(history, k - start, like)
            before = history[last, k - start] if by_rate else 0.0
            given = extend(p, history, n_rows, k - start, of_bar)
            section = bar_value(area, k - start)
            axial, geometric, inverse = stiffness(nx, ny, nz, rest[k], shift, warmth, given, section, step, before, q)
            nx *= inverse
            ny *= inverse
            nz *= inverse
            dx = u[b, 0] - u[a, 0]
            dy = u[b, 1] - u[a, 1]
            dz = u[b, 2] - u[a, 2]
            along = (axial - geometric) * (nx * dx + ny * dy + nz * dz)
            fx = along * nx + geometric * dx
            fy = along * ny + geometric * dy
            fz = along * nz + geometric * dz
            out[a, 0] -= fx
            out[a, 1] -= fy
            out[a, 2] -= fz
            out[b, 0] += fx
            out[b, 1] += fy
            out[b, 2] += fz

    @kernel
    def linearise(x, bars, rest, heat, p, area, step, history, start, stop, weight, stored):
        """Write the data of each bar for products with ``weight`` K_t, n, dN/dl - N/l and N/l, to ``stored`` (5, b)."""
        has_thermal = heat.shape[1] > 0
        for k in range(start, stop):
            a = bars[k, 0]
            b = bars[k, 1]
            shift = heat[0, k] if has_thermal else 0.0
            warmth = heat[1, k] if has_thermal else 0.0
            dx = x[b, 0] - x[a, 0]
            dy = x[b, 1] - x[a, 1]
            dz = x[b, 2] - x[a, 2]
            q = take(history, k - start, like)
            before = history[last, k - start] if by_rate else 0.0
            given = extend(p, history, n_rows, k - start, of_bar)
            section = bar_value(area, k - start)
            axial, geometric, inverse = stiffness(dx, dy, dz, rest[k], shift, warmth, given, section, step, before, q)
            stored[0, k] = dx * inverse
            stored[1, k] = dy * inverse
            stored[2, k] = dz * inverse
            stored[3, k] = weight * (axial - geometric)
            stored[4, k] = weight * geometric

    @kernel
    def stiffnesses(x, sweep, far, rest, heat, p, area, step, history, weight, stored):
        """Write (dN/dl - N/l)/l^2 and N/l of each bar [N/m3], [N/m] times ``weight`` to ``stored`` (2, b).

        ``sweep``, ``far``: see :func:`~pfem_petsc.mechanics.force_kernels.make_force_kernels`.
        """
        has_thermal = heat.shape[1] > 0
        heads, fars, starts, chunks = sweep.heads, sweep.fars, sweep.starts, sweep.chunks
        work = np.empty(3 * CHUNK)
        xs, ys, zs = work[:CHUNK], work[CHUNK : 2 * CHUNK], work[2 * CHUNK :]
        origin = starts[0]
        for chunk in range(len(sweep.diagonal)):
            first = starts[chunks[chunk]]
            stop = starts[chunks[chunk + 1]]
            n = stop - first
            for run in range(chunks[chunk], chunks[chunk + 1]):
                at = starts[run]
                if sweep.diagonal[chunk]:
                    differences(x, heads[run], fars[run], starts[run + 1] - at, xs, ys, zs, at - first)
                    continue
                a = heads[run]
                for k in range(at, starts[run + 1]):
                    b = far[k]
                    xs[k - first] = x[b, 0] - x[a, 0]
                    ys[k - first] = x[b, 1] - x[a, 1]
                    zs[k - first] = x[b, 2] - x[a, 2]
            rests, displacements, warmths = rest[first:stop], heat[0][first:stop], heat[1][first:stop]
            along, across = stored[0, first:stop], stored[1, first:stop]
            begin = first - origin  # column of the history
            for i in range(n):
                shift = 0.0
                warmth = 0.0
                if has_thermal:
                    shift = displacements[i]
                    warmth = warmths[i]
                q = take(history, begin + i, like)
                before = history[last, begin + i] if by_rate else 0.0
                given = extend(p, history, n_rows, begin + i, of_bar)
                section = bar_value(area, begin + i)
                axial, geometric, inverse = stiffness(
                    xs[i], ys[i], zs[i], rests[i], shift, warmth, given, section, step, before, q
                )
                along[i] = weight * ((axial - geometric) * inverse * inverse)
                across[i] = weight * geometric

    return {"tangents": tangents, "product": product, "linearise": linearise, "stiffnesses": stiffnesses}

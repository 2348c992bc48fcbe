"""Compiled loops over bars, made once for each material law.

Bar from node a to node b with d = x_b - x_a, l = |d|, n = d/l (Greco & Coda's positional bar; design equations):
internal force on a is -N n, on b is +N n; the Hessian block is (dN/dl) n n^T + (N/l)(I - n n^T), added to the diagonal
blocks of both ends and subtracted from the two blocks between them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from types import SimpleNamespace

import numpy as np

from ..energies import BAR_ENERGIES
from .compiled import inlined, kernel
from .materials.base import Law
from .rows import CHUNK, accumulate, bar_value, differ, extend, put, take
from .strips import add_strips, differences

__all__ = ["COLLAPSED_STRETCH", "SHORTENED_STRETCH", "last_row", "make_kernels", "no_bar_data", "no_variables"]

COLLAPSED_STRETCH = 1e-3  # below this fraction of its rest length a bar is crushed, and no truss model applies
_2, _3, _4 = 2 * CHUNK, 3 * CHUNK, 4 * CHUNK
SHORTENED_STRETCH = math.sqrt(0.8)  # only bars shorter than this are checked for passing through zero length


def no_variables(law: Law) -> tuple[float, ...]:
    """Return a tuple of zeros, one for each internal variable of a law."""
    return (0.0,) * len(law.internal)


def no_bar_data(law: Law) -> tuple[float, ...]:
    """Return a tuple of zeros, one for each number that a law reads of a bar."""
    return (0.0,) * len(law.bar_data)


def last_row(law: Law) -> int:
    """Return the row of the history with the strain at the end of the last step; the stress is in the next row."""
    return len(law.internal)


@cache
def make_kernels(law: Law, measure: Callable) -> SimpleNamespace:
    """Make the kernels of a law and strain measure: ``forces``, ``tangents``, ``product``, ``linearise``, ``fields``,
    ``densities``.

    Common arguments: ``x`` (local nodes, 3) [m]; ``bars`` (b, 2) local ends; ``rest`` (b,) rest lengths [m]; ``heat``
    (2, b) thermal strains and temperatures [K], or (2, 0) for none; ``p`` the law's parameters; ``area`` [m2], a number
    or (n,); ``step`` from the start of the step to ``x`` [s]; ``history`` (rows, n) of the bars of this block:
    ``law.rows`` of bar ``k`` in column ``k - start``, and after them its ``law.bar_data``, which no loop writes. No
    array is passed to an inner function: reference counting would cost more than the bar.
    """
    response, like, by_rate, last, n_rows = law.response, no_variables(law), law.rate, last_row(law), len(law.rows)
    of_bar = no_bar_data(law)
    places = tuple(BAR_ENERGIES.index(name) for name in law.energies)
    n_energies = len(places)
    first_new = 4 + n_energies
    can_break, gone = law.rupture >= 0, max(law.rupture, 0)

    @inlined
    def sweep_part(x, sweep, begun, ended, far, rest, heat, p, area, step, history, commit, f, work):
        """Add the internal forces of the chunks [begun, ended) of a sweep to ``f``; arguments and results as those of
        :func:`forces`.

        ``work`` ((4 + energies + rows) CHUNK,): end differences, force over length, sums of the energies, new history.
        One sum is kept per position in a chunk, so vector instructions need no reordering.
        """
        failed = -1
        shortened = False
        broke = 0
        has_thermal = heat.shape[1] > 0
        heads, fars, starts, chunks = sweep.heads, sweep.fars, sweep.starts, sweep.chunks
        origin = starts[0]
        xs, ys, zs, cs = work[:CHUNK], work[CHUNK:_2], work[_2:_3], work[_3:_4]
        lasts = work[(first_new + last) * CHUNK : (first_new + last + 1) * CHUNK]
        stresses = work[(first_new + last + 1) * CHUNK : (first_new + last + 2) * CHUNK]
        for chunk in range(begun, ended):
            first = starts[chunks[chunk]]
            stop = starts[chunks[chunk + 1]]
            n = stop - first
            if sweep.diagonal[chunk]:
                for run in range(chunks[chunk], chunks[chunk + 1]):
                    at = starts[run]
                    differences(x, heads[run], fars[run], starts[run + 1] - at, xs, ys, zs, at - first)
            else:
                for run in range(chunks[chunk], chunks[chunk + 1]):
                    a = heads[run]
                    ax = x[a, 0]
                    ay = x[a, 1]
                    az = x[a, 2]
                    for k in range(starts[run], starts[run + 1]):
                        b = far[k]
                        i = k - first
                        xs[i] = x[b, 0] - ax
                        ys[i] = x[b, 1] - ay
                        zs[i] = x[b, 2] - az
            rests = rest[first:stop]
            displacements = heat[0][first:stop]
            warmths = heat[1][first:stop]
            begin = first - origin  # column of the history
            short = 0
            changed = 0
            for i in range(n):
                length = math.sqrt(xs[i] * xs[i] + ys[i] * ys[i] + zs[i] * zs[i])
                stretch = length / rests[i]
                short += 0 if stretch >= SHORTENED_STRETCH else 1  # NaN counts
                strain, slope, _ = measure(stretch)
                warmth = 0.0
                if has_thermal:
                    strain -= displacements[i]
                    warmth = warmths[i]
                q = take(history, begin + i, like)
                rate = 0.0
                if by_rate and step > 0.0:
                    rate = (strain - history[last, begin + i]) / step
                given = extend(p, history, n_rows, begin + i, of_bar)
                stress, _, new, densities = response(strain, rate, step, warmth, given, q)
                section = bar_value(area, begin + i)
                accumulate(work, 4, i, section * rests[i], densities)
                if n_rows > 0:
                    put(work, first_new, i, new)
                    changed += 1 if by_rate or differ(new, q) else 0
                    if can_break:
                        broke += 1 if new[gone] != q[gone] else 0
                if by_rate:
                    lasts[i] = strain
                    kept = stress
                    if can_break:  # the stress of what is left of the bar
                        left = 1.0 - abs(q[gone])
                        kept = stress / left if left > 0.0 else 0.0
                    stresses[i] = kept
                cs[i] = section * stress * slope / length
            if n_rows > 0 and commit and changed > 0:
                for j in range(n_rows):
                    row = work[(first_new + j) * CHUNK : (first_new + j + 1) * CHUNK]
                    kept = history[j]
                    for i in range(n):
                        kept[begin + i] = row[i]
            if short > 0:
                for i in range(n):
                    length = math.sqrt(xs[i] ** 2 + ys[i] ** 2 + zs[i] ** 2)
                    stretch = length / rests[i]
                    if can_break:  # noqa: SIM102 - not compiled otherwise
                        if abs(history[gone, begin + i]) >= 1.0:
                            # it may have no length; one that breaks in this step has its force still
                            if not (stretch > COLLAPSED_STRETCH):
                                cs[i] = 0.0
                            continue
                    if stretch < SHORTENED_STRETCH:
                        shortened = True
                    if not (stretch > COLLAPSED_STRETCH):  # NaN fails this test too
                        if failed < 0:
                            failed = np.int64(first + i)  # signed, like -1
                        # the norms of the solver must detect an inadmissible trial position
                        cs[i] = 0.0 if commit else math.nan
            if sweep.diagonal[chunk]:
                for run in range(chunks[chunk], chunks[chunk + 1]):
                    at = starts[run]
                    add_strips(f, heads[run], fars[run], starts[run + 1] - at, xs, ys, zs, cs, at - first)
            else:
                for run in range(chunks[chunk], chunks[chunk + 1]):
                    fx = 0.0
                    fy = 0.0
                    fz = 0.0
                    for k in range(starts[run], starts[run + 1]):
                        b = far[k]
                        i = k - first
                        c = cs[i]
                        gx = c * xs[i]
                        gy = c * ys[i]
                        gz = c * zs[i]
                        fx += gx
                        fy += gy
                        fz += gz
                        f[b, 0] += gx
                        f[b, 1] += gy
                        f[b, 2] += gz
                    a = heads[run]
                    f[a, 0] -= fx
                    f[a, 1] -= fy
                    f[a, 2] -= fz
        return failed, shortened, broke

    @inlined
    def sum_energies(work, energies):
        """Add the sums of ``work`` to ``energies``, see :data:`~pfem_petsc.energies.BAR_ENERGIES` [J]."""
        for j in range(n_energies):
            s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = 0.0  # additions that do not wait for each other
            for i in range((4 + j) * CHUNK, (5 + j) * CHUNK, 8):
                s0 += work[i]
                s1 += work[i + 1]
                s2 += work[i + 2]
                s3 += work[i + 3]
                s4 += work[i + 4]
                s5 += work[i + 5]
                s6 += work[i + 6]
                s7 += work[i + 7]
            energies[places[j]] += ((s0 + s1) + (s2 + s3)) + ((s4 + s5) + (s6 + s7))

    @inlined
    def clear_energies(work):
        """Set the sums of ``work`` to zero."""
        work[_4 : _4 + n_energies * CHUNK] = 0.0

    @kernel
    def forces(x, sweep, far, rest, heat, p, area, step, history, commit, f, energies):
        """Add internal forces to ``f``, and sums over counted bars to ``energies``, see
        :data:`~pfem_petsc.energies.BAR_ENERGIES` [J]; return the first failed bar or -1, whether any bar is so short
        that it may be inverted, and how many bars have changed their state of rupture.

        ``sweep``: a :class:`~pfem_petsc.mechanics.sweep.Sweep`; ``far`` (b,) the upper end of each bar.
        """
        work = np.empty((4 + n_energies + n_rows) * CHUNK)
        clear_energies(work)
        failed = -1
        shortened = False
        broke = 0
        limits = (0, sweep.counted, len(sweep.diagonal))
        for side in range(2):
            at, short, more = sweep_part(
                x, sweep, limits[side], limits[side + 1], far, rest, heat, p, area, step, history, commit, f, work
            )
            if side == 0:  # the remaining bars are counted on other ranks
                sum_energies(work, energies)
            failed = at if failed < 0 else failed
            shortened = shortened or short
            broke += more
        return failed, shortened, broke

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

    return SimpleNamespace(
        forces=forces,
        sweep_part=sweep_part,
        sum_energies=sum_energies,
        clear_energies=clear_energies,
        work_rows=4 + n_energies + n_rows,
        tangents=tangents,
        product=product,
        linearise=linearise,
        fields=fields,
        densities=densities,
    )

"""Compiled loops over bars, made once for each material law: forces, energies, tangents, fields."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np

from ..columns import BAR_ENERGIES
from .columns import add_rows, address, copy_run, difference_of_ends, number_at, subtract_rows
from .compiled import borrowing, inlined, kernel
from .materials.base import Law
from .rows import CHUNK, accumulate, bar_value, differ, extend, put, put_apart, take
from .strips import add_strips, differences


def no_variables(law: Law) -> tuple[float, ...]:
    """Return a tuple of zeros, one for each internal variable of a law."""
    return (0.0,) * len(law.internal)


def no_bar_data(law: Law) -> tuple[float, ...]:
    """Return a tuple of zeros, one for each number that a law reads of a bar."""
    return (0.0,) * len(law.bar_data)


def last_row(law: Law) -> int:
    """Return the row of the history with the strain at the end of the last step; the stress is in the next row."""
    return len(law.internal)


COLLAPSED_STRETCH = 1e-3  # below this fraction of its rest length a bar is crushed, and no truss model applies
SHORTENED_STRETCH = math.sqrt(0.8)  # only bars shorter than this are checked for passing through zero length
_2, _3, _4 = 2 * CHUNK, 3 * CHUNK, 4 * CHUNK


def make_force_kernels(law: Law, measure: Callable) -> dict[str, Any]:
    """Make ``forces``, and its parts for the fused loop: ``sweep_part``, ``clear_energies``, ``sum_energies``, and the
    number ``work_rows`` of rows of CHUNK numbers in their workspace.

    Arguments: see :func:`~pfem_petsc.mechanics.kernels.make_kernels`.
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
        """Add the sums of ``work`` to ``energies``, see :data:`~pfem_petsc.columns.BAR_ENERGIES` [J]."""
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
        sums = work[_4:]
        for i in range(n_energies * CHUNK):  # much faster than an assignment to a slice
            sums[i] = 0.0

    @kernel
    def forces(x, sweep, far, rest, heat, p, area, step, history, commit, f, energies):
        """Add internal forces to ``f``, and sums over counted bars to ``energies``, see
        :data:`~pfem_petsc.columns.BAR_ENERGIES` [J]; return the first failed bar or -1, whether any bar is so short
        that it may be inverted, and how many bars have changed their state of rupture.

        ``sweep``: a :class:`~pfem_petsc.mechanics.sweep.Sweep`; ``far`` (b,) the upper end of each bar.
        """
        work = np.empty((4 + n_energies + n_rows) * CHUNK)
        failed = -1
        shortened = False
        broke = 0
        limits = (sweep.counted, len(sweep.diagonal), 0, sweep.counted)
        for side in range(0, 4, 2):  # first the bars that are counted on other ranks
            clear_energies(work)
            at, short, more = sweep_part(
                x, sweep, limits[side], limits[side + 1], far, rest, heat, p, area, step, history, commit, f, work
            )
            failed = at if failed < 0 else failed
            shortened = shortened or short
            broke += more
        sum_energies(work, energies)
        return failed, shortened, broke

    return {
        "forces": forces,
        "sweep_part": sweep_part,
        "clear_energies": clear_energies,
        "sum_energies": sum_energies,
        "work_rows": 4 + n_energies + n_rows,
    }


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


def make_column_kernels(law: Law, measure: Callable) -> dict[str, Any]:
    """Make ``pull_columns``, which adds internal forces, and the number ``column_rows`` of rows of CHUNK numbers in its
    workspace.

    Laws of bars that can break have no such loop, since a step in which a bar breaks needs the energies: it is replaced
    by a function that does nothing.
    """
    response, like, of_bar, by_rate = law.response, no_variables(law), no_bar_data(law), law.rate
    n_rows, last = len(law.rows), last_row(law)
    keeps = n_rows + len(law.bar_data) > 0

    @borrowing
    def pull_none(x, planes, sums, base, sweep, columns, begun, ended, p, step, work):
        """Replace :func:`pull_columns` where it does not apply."""
        return -1, False

    @borrowing
    def pull_columns(x, planes, sums, base, sweep, columns, begun, ended, p, step, work):
        """Add the internal forces of the groups [begun, ended) of ``columns`` to ``sums`` (3 stride,), and update the
        history in ``columns.kept``; return the first failed bar, or -1, and whether any bar is so short that it may be
        inverted.

        ``x`` (n, 3) positions, which are also in ``planes`` (3 stride,) from node ``base`` on; ``sweep``: of the bars;
        ``work`` (``column_rows`` CHUNK,): forces of a group by components, and its new history; see
        :func:`~pfem_petsc.mechanics.kernels.make_kernels`.
        """
        failed = -1
        shortened = False
        stride = len(planes) // 3
        heads, fars, starts, runs = columns.heads, columns.fars, columns.starts, columns.runs
        kept, wide = columns.kept, len(columns.rest)
        flat = kept.reshape(-1)
        for group in range(begun, ended):
            first = starts[group]
            n = starts[group + 1] - first
            head, tail = heads[group] - base, fars[group] - base
            low, high, lengths = address(planes, head), address(planes, tail), address(columns.rest, first)
            short = 0
            changed = 0
            for i in range(n):
                rest = number_at(lengths, i)
                real = rest > 0.0
                dx, dy, dz = difference_of_ends(low, high, stride, i)
                squared = dx * dx + dy * dy + dz * dz
                length = math.sqrt(squared if real else 1.0)
                stretch = length / (rest if real else 1.0)
                short += 0 if stretch >= SHORTENED_STRETCH else 1  # NaN counts
                strain, slope, _ = measure(stretch)
                q = take(kept, first + i, like)
                rate = 0.0
                if by_rate and step > 0.0:
                    rate = (strain - kept[last, first + i]) / step
                given = extend(p, kept, n_rows, first + i, of_bar)
                stress, _, new, _ = response(strain, rate, step, 0.0, given, q)
                section = bar_value(columns.area, first + i) if real else 0.0
                pull = section * stress * slope / length
                if keeps:
                    pull = pull if real else 0.0  # what a column without a bar keeps may be anything
                put_apart(work, 0, i, pull, (dx, dy, dz))
                if n_rows > 0:
                    put_apart(work, 3, i, 1.0, new)
                    changed += 1 if real and (by_rate or differ(new, q)) else 0
                if by_rate:
                    put_apart(work, 3 + last, i, 1.0, (strain, stress))
            if n_rows > 0 and changed > 0:
                for j in range(n_rows):
                    copy_run(work, (3 + j) * CHUNK, flat, j * wide + first, n)
            if short > 0:
                for run in range(runs[group], runs[group + 1]):
                    ahead = sweep.heads[run] - heads[group]
                    for k in range(sweep.starts[run + 1] - sweep.starts[run]):
                        i = ahead + k
                        a, b = heads[group] + i, fars[group] + i
                        dx, dy, dz = x[b, 0] - x[a, 0], x[b, 1] - x[a, 1], x[b, 2] - x[a, 2]
                        stretch = math.sqrt(dx * dx + dy * dy + dz * dz) / columns.rest[first + i]
                        if stretch < SHORTENED_STRETCH:
                            shortened = True
                        if not (stretch > COLLAPSED_STRETCH):  # NaN fails this test too
                            if failed < 0:
                                failed = np.int64(sweep.starts[run] + k)  # signed, like -1
                            for c in range(3):
                                work[c * CHUNK + i] = 0.0
            if columns.close[group]:
                for run in range(runs[group], runs[group + 1]):
                    at, count = sweep.heads[run] - heads[group], sweep.starts[run + 1] - sweep.starts[run]
                    subtract_rows(sums, stride, head + at, count, work, at)
                    add_rows(sums, stride, tail + at, count, work, at)
            else:
                add_rows(sums, stride, tail, n, work, 0)
                subtract_rows(sums, stride, head, n, work, 0)
        return failed, shortened

    return {"pull_columns": pull_columns if law.rupture < 0 else pull_none, "column_rows": 3 + n_rows}


@cache
def make_kernels(law: Law, measure: Callable) -> SimpleNamespace:
    """Make the kernels of a law and strain measure: ``forces``, ``tangents``, ``product``, ``linearise``, ``fields``,
    ``densities``, ``rates``.

    Common arguments: ``x`` (local nodes, 3) [m]; ``bars`` (b, 2) local ends; ``rest`` (b,) rest lengths [m]; ``heat``
    (2, b) thermal strains and temperatures [K], or (2, 0) for none; ``p`` the law's parameters; ``area`` [m2], a number
    or (n,); ``step`` from the start of the step to ``x`` [s]; ``history`` (rows, n) of the bars of this block:
    ``law.rows`` of bar ``k`` in column ``k - start``, and after them its ``law.bar_data``, which no loop writes. No
    array is passed to an inner function: reference counting would cost more than the bar.
    """
    return SimpleNamespace(
        **make_force_kernels(law, measure),
        **make_column_kernels(law, measure),
        **make_tangent_kernels(law, measure),
        **make_field_kernels(law, measure),
    )


def fused_parts(kernels: SimpleNamespace) -> tuple:
    """Return the kernels of which :func:`~pfem_petsc.stepping.fused_loop.make_fused_loop` makes its loop."""
    return (
        kernels.sweep_part,
        kernels.sum_energies,
        kernels.clear_energies,
        kernels.work_rows,
        kernels.pull_columns,
        kernels.column_rows,
    )


@kernel
def bar_lengths(points, bars, lengths):
    """Write the lengths (b,) of bars (b, 2) between points (n, 3)."""
    for k in range(len(bars)):
        a = bars[k, 0]
        b = bars[k, 1]
        dx = points[b, 0] - points[a, 0]
        dy = points[b, 1] - points[a, 1]
        dz = points[b, 2] - points[a, 2]
        lengths[k] = (dx * dx + dy * dy + dz * dz) ** 0.5


@kernel
def first_inverted(x, before, bars, rest):
    """Return the first shortened bar whose direction has reversed, or -1; those with zero ``rest`` are not checked."""
    for k in range(len(bars)):
        a = bars[k, 0]
        b = bars[k, 1]
        dx = x[b, 0] - x[a, 0]
        dy = x[b, 1] - x[a, 1]
        dz = x[b, 2] - x[a, 2]
        if dx * dx + dy * dy + dz * dz < 0.8 * rest[k] * rest[k]:
            back = dx * (before[b, 0] - before[a, 0])
            back += dy * (before[b, 1] - before[a, 1])
            back += dz * (before[b, 2] - before[a, 2])
            if back < 0.0:
                return k
    return -1

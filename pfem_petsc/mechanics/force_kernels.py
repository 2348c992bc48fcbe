"""Compiled loops over bars: internal forces, energies, and the history of laws that have one."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from ..energies import BAR_ENERGIES
from .compiled import inlined, kernel
from .law_rows import last_row, no_bar_data, no_variables
from .materials.base import Law
from .rows import CHUNK, accumulate, bar_value, differ, extend, put, take
from .strips import add_strips, differences

__all__ = ["COLLAPSED_STRETCH", "SHORTENED_STRETCH", "make_force_kernels"]

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
        sums = work[_4:]
        for i in range(n_energies * CHUNK):  # much faster than an assignment to a slice
            sums[i] = 0.0

    @kernel
    def forces(x, sweep, far, rest, heat, p, area, step, history, commit, f, energies):
        """Add internal forces to ``f``, and sums over counted bars to ``energies``, see
        :data:`~pfem_petsc.energies.BAR_ENERGIES` [J]; return the first failed bar or -1, whether any bar is so short
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

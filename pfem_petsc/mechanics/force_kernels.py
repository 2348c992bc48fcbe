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
from .planes import (
    add_numbers,
    add_to_planes,
    address,
    difference_of_ends,
    differences_of_planes,
    join_planes,
    number_at,
    split_planes,
)
from .rows import CHUNK, bar_value, differ, extend, new_rows, put, put_scaled, take

__all__ = ["COLLAPSED_STRETCH", "SHORTENED_STRETCH", "make_force_kernels"]

COLLAPSED_STRETCH = 1e-3  # below this fraction of its rest length a bar is crushed, and no truss model applies
SHORTENED_STRETCH = math.sqrt(0.8)  # only bars shorter than this are checked for passing through zero length
_2, _3 = 2 * CHUNK, 3 * CHUNK


def make_force_kernels(law: Law, measure: Callable) -> dict[str, Any]:
    """Make ``forces``, and its parts for the fused loop: ``sweep_part``, ``clear_energies``, ``sum_energies``, and
    ``new_work``.

    Arguments: see :func:`~pfem_petsc.mechanics.kernels.make_kernels`.
    """
    response, like, by_rate, last, n_rows = law.response, no_variables(law), law.rate, last_row(law), len(law.rows)
    of_bar = no_bar_data(law)
    places = tuple(BAR_ENERGIES.index(name) for name in law.energies)
    n_energies = len(places)
    own, first_new = 3 + n_energies, 3 + 2 * n_energies  # rows of the energies of a chunk, and of its new history
    first_gap = first_new + n_rows  # rows of end differences, and of zeros
    can_break, gone = law.rupture >= 0, max(law.rupture, 0)

    @inlined
    def sweep_part(
        x, planes, sums, base, sweep, begun, ended, far, rest, heat, p, area, step, history, commit, tally, f, work
    ):
        """Add the internal forces of the chunks [begun, ended) of a sweep: of diagonal runs to ``sums``, of stars to
        ``f``; arguments and results as those of :func:`forces`. The planes begin at node ``base``. Energies
        are summed if ``tally``.

        ``work``: forces of a chunk; sums of the energies; energies and new history of a chunk; end differences, if its
        bars are not one diagonal run; zeros. One sum is kept per place of a bar in a chunk, so vector instructions need
        no reordering. Columns of a :class:`~pfem_petsc.mechanics.padding.Padding` can take the place of bars, except in
        ``far``.
        """
        failed = -1
        shortened = False
        broke = 0
        has_thermal = heat.shape[1] > 0
        heads, fars, starts, chunks = sweep.heads, sweep.fars, sweep.starts, sweep.chunks
        stride = len(planes) // 3
        origin = starts[0]
        gaps = work[first_gap * CHUNK :]
        gathered, zeros = address(work, first_gap * CHUNK), address(work, (first_gap + 3) * CHUNK)
        xs, ys, zs = work[:CHUNK], work[CHUNK:_2], work[_2:_3]
        lasts = work[(first_new + last) * CHUNK : (first_new + last + 1) * CHUNK]
        stresses = work[(first_new + last + 1) * CHUNK : (first_new + last + 2) * CHUNK]
        for chunk in range(begun, ended):
            first = starts[chunks[chunk]]
            stop = starts[chunks[chunk + 1]]
            n = stop - first
            bar = sweep.bars[chunk] - first  # of column 0
            run = chunks[chunk]
            low, apart, high, wide = zeros, np.int64(0), gathered, np.int64(CHUNK)
            if sweep.diagonal[chunk] and chunks[chunk + 1] - run == 1:
                low, high = address(planes, heads[run] - base), address(planes, fars[run] - base)
                apart = wide = stride
            elif sweep.diagonal[chunk]:
                for run in range(chunks[chunk], chunks[chunk + 1]):
                    at = starts[run]
                    differences_of_planes(
                        planes, stride, heads[run] - base, fars[run] - base, starts[run + 1] - at, gaps, at - first
                    )
            else:
                for run in range(chunks[chunk], chunks[chunk + 1]):
                    a = heads[run]
                    ax = x[a, 0]
                    ay = x[a, 1]
                    az = x[a, 2]
                    for k in range(starts[run], starts[run + 1]):
                        b = far[bar + k]
                        i = k - first
                        gaps[i] = x[b, 0] - ax
                        gaps[CHUNK + i] = x[b, 1] - ay
                        gaps[_2 + i] = x[b, 2] - az
            begin = first - origin  # column of the history
            lengths, expansions, warmths = address(rest, first), zeros, zeros
            if has_thermal:
                expansions, warmths = address(heat, first), address(heat, heat.shape[1] + first)
            short = 0
            changed = 0
            for i in range(n):
                length_at_rest = number_at(lengths, i)
                real = length_at_rest > 0.0
                dx, dy, dz = difference_of_ends(low, apart, high, wide, i)
                squared = dx * dx + dy * dy + dz * dz
                length = math.sqrt(squared if real else 1.0)
                stretch = length / (length_at_rest if real else 1.0)
                short += 0 if stretch >= SHORTENED_STRETCH else 1  # NaN counts
                strain, slope, _ = measure(stretch)
                strain -= number_at(expansions, i)
                warmth = number_at(warmths, i)
                q = take(history, begin + i, like)
                rate = 0.0
                if by_rate and step > 0.0:
                    rate = (strain - history[last, begin + i]) / step
                given = extend(p, history, n_rows, begin + i, of_bar)
                stress, _, new, densities = response(strain, rate, step, warmth, given, q)
                section = bar_value(area, begin + i) if real else 0.0
                put_scaled(work, own, i, section * length_at_rest, densities)
                if n_rows > 0:
                    put(work, first_new, i, new)
                    changed += 1 if by_rate or differ(new, q) else 0
                    if can_break:
                        broke += 1 if real and new[gone] != q[gone] else 0
                if by_rate:
                    lasts[i] = strain
                    kept = stress
                    if can_break:  # the stress of what is left of the bar
                        left = 1.0 - abs(q[gone])
                        kept = stress / left if left > 0.0 else 0.0
                    stresses[i] = kept
                put_scaled(work, 0, i, section * stress * slope / length, (dx, dy, dz))
            if n_rows > 0 and commit and changed > 0:
                for j in range(n_rows):
                    row = work[(first_new + j) * CHUNK : (first_new + j + 1) * CHUNK]
                    kept = history[j]
                    for i in range(n):
                        kept[begin + i] = row[i]
            if short > 0:
                for run in range(chunks[chunk], chunks[chunk + 1]):
                    for k in range(starts[run], starts[run + 1]):
                        i = k - first
                        if not rest[first + i] > 0.0:
                            continue
                        ahead = k - starts[run] if sweep.diagonal[chunk] else k - k
                        a = heads[run] + ahead
                        b = fars[run] + ahead if sweep.diagonal[chunk] else far[bar + k]
                        dx, dy, dz = x[b, 0] - x[a, 0], x[b, 1] - x[a, 1], x[b, 2] - x[a, 2]
                        length = math.sqrt(dx * dx + dy * dy + dz * dz)
                        stretch = length / rest[first + i]
                        if can_break:  # noqa: SIM102 - not compiled otherwise
                            if abs(history[gone, begin + i]) >= 1.0:
                                # it may have no length; one that breaks in this step has its force still
                                if not (stretch > COLLAPSED_STRETCH):
                                    xs[i] = ys[i] = zs[i] = 0.0
                                continue
                        if stretch < SHORTENED_STRETCH:
                            shortened = True
                        if not (stretch > COLLAPSED_STRETCH):  # NaN fails this test too
                            if failed < 0:
                                failed = np.int64(k)  # signed, like -1
                            # the norms of the solver must detect an inadmissible trial position
                            xs[i] = ys[i] = zs[i] = 0.0 if commit else math.nan
            if sweep.diagonal[chunk]:
                for j in range(n_energies if tally else 0):
                    for run in range(chunks[chunk], chunks[chunk + 1]):
                        at = starts[run]
                        add_numbers(work, 3 + j, sweep.lanes[run], own + j, at - first, starts[run + 1] - at)
                add_to_planes(sums, stride, base, heads, fars, starts, chunks[chunk], chunks[chunk + 1], work)
            else:
                for j in range(n_energies if tally else 0):
                    add_numbers(work, 3 + j, 0, own + j, 0, n)
                for run in range(chunks[chunk], chunks[chunk + 1]):
                    fx = 0.0
                    fy = 0.0
                    fz = 0.0
                    for k in range(starts[run], starts[run + 1]):
                        b = far[bar + k]
                        i = k - first
                        fx += xs[i]
                        fy += ys[i]
                        fz += zs[i]
                        f[b, 0] += xs[i]
                        f[b, 1] += ys[i]
                        f[b, 2] += zs[i]
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
            for i in range((3 + j) * CHUNK, (4 + j) * CHUNK, 8):
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
        sums = work[_3:]
        for i in range(n_energies * CHUNK):  # much faster than an assignment to a slice
            sums[i] = 0.0

    @inlined
    def new_work():
        """Return the workspace of :func:`sweep_part`."""
        work = new_rows(first_gap + 4)
        zeros = work[(first_gap + 3) * CHUNK :]
        for i in range(CHUNK):
            zeros[i] = 0.0
        return work

    @kernel
    def forces(x, planes, sums, sweep, far, rest, heat, p, area, step, history, commit, f, energies):
        """Add internal forces to ``f``, and sums over counted bars to ``energies``, see
        :data:`~pfem_petsc.energies.BAR_ENERGIES` [J]; return the first failed bar or -1, whether any bar is so short
        that it may be inverted, and how many bars have changed their state of rupture.

        ``planes``, ``sums`` (3 nodes,): workspace for positions and forces by components, or (0,) if no chunk is
        diagonal; ``sweep``: a :class:`~pfem_petsc.mechanics.sweep.Sweep`; ``far`` (b,) the upper end of each bar.
        """
        work = new_work()
        failed = -1
        shortened = False
        broke = 0
        stride = len(planes) // 3
        nodes = len(x) if stride > 0 else 0
        split_planes(x, 0, nodes, planes, stride, 0)
        for i in range(len(sums)):
            sums[i] = 0.0
        limits = (sweep.counted, len(sweep.diagonal), 0, sweep.counted)
        for side in range(0, 4, 2):  # first the bars that are counted on other ranks
            clear_energies(work)
            at, short, more = sweep_part(
                x,
                planes,
                sums,
                0,
                sweep,
                limits[side],
                limits[side + 1],
                far,
                rest,
                heat,
                p,
                area,
                step,
                history,
                commit,
                True,
                f,
                work,
            )
            failed = at if failed < 0 else failed
            shortened = shortened or short
            broke += more
        join_planes(sums, stride, 0, 0, nodes, f)
        sum_energies(work, energies)
        return failed, shortened, broke

    return {
        "forces": forces,
        "sweep_part": sweep_part,
        "clear_energies": clear_energies,
        "sum_energies": sum_energies,
        "new_work": new_work,
    }

"""Internal forces, stiffness and stresses of all bars of a rank, by whole arrays: the bars of a group are read into a
workspace, their law is called for all of them, and what it gives is added to the nodes.

Positions and forces lie by components, (3, stride); see :func:`~pfem_petsc.mechanics.layout.new_components`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from .chunk_laws import (
    DX,
    DY,
    DZ,
    FACTOR,
    HISTORY,
    MODULUS,
    PULL,
    ROW,
    STRAIN,
    STRAIN0,
    STRESS,
    STRETCH,
    TEMPERATURE,
    TEMPERATURE0,
)
from .compiled import add_freely, inlined, kernel, record
from .elements import (
    COLLAPSED_STRETCH,
    ENGINEERING,
    GREEN,
    LOGARITHMIC,
    SHORTENED_STRETCH,
    engineering,
    mean_ratio,
    measured,
)
from .layout import DIFFERENCES, BarLayout, aligned, group_of, run_column

# Functions that are called for each group take whole arrays and where to begin: a part of an array, or a record of
# arrays as an argument, counts references, which takes as long as several bars. Indices without a sign need no
# treatment of negative ones.
_DX, _DY, _DZ, _STRETCH, _FACTOR, _PULL = (np.uint64(row * ROW) for row in (DX, DY, DZ, STRETCH, FACTOR, PULL))
_STRAIN, _TEMPERATURE, _STRESS, _MODULUS = (np.uint64(row * ROW) for row in (STRAIN, TEMPERATURE, STRESS, MODULUS))
_STRAIN0, _TEMPERATURE0 = (np.uint64(row * ROW) for row in (STRAIN0, TEMPERATURE0))


@record
class BarArrays(NamedTuple):
    """What compiled loops read of the bars of a rank, and their history.

    Attributes
    ----------
    layout : of the bars
    rest : (columns,) rest lengths [m], NO_BAR where there is no bar
    heat : (2, b) thermal strains and temperatures [K], or (2, 0)
    area : (s,) areas of sections [m2], NaN where they differ from bar to bar
    areas : (columns,) these, or (0,)
    measures : (s,) strain measures, see :data:`~pfem_petsc.mechanics.elements.MEASURES`
    parameters : (s, width) numbers of the laws
    history : of all sections, by rows of the columns of a section: those of the law, and the data of bars
    places : (s,) where the history of a section begins
    kept, rows : (s,) number of rows that the law writes, and of all rows
    last, gone : (s,) rows of the strain at the end of the last step, and of the state of rupture, or -1
    energies : (s, k) indices in :data:`~pfem_petsc.columns.BAR_ENERGIES`, or -1
    work : (rows ROW,) workspace of :mod:`~pfem_petsc.mechanics.chunk_laws`, for the law with the most rows
    """

    layout: BarLayout
    rest: np.ndarray
    heat: np.ndarray
    area: np.ndarray
    areas: np.ndarray
    measures: np.ndarray
    parameters: np.ndarray
    history: np.ndarray
    places: np.ndarray
    kept: np.ndarray
    rows: np.ndarray
    last: np.ndarray
    gone: np.ndarray
    energies: np.ndarray
    work: np.ndarray


@inlined
def _differences_of_runs(g, x, rest, work):
    """Write end differences, stretches and inverse lengths of the columns of a group of runs; return how many bars are
    short. Columns without a bar have the stretch 1 and no force."""
    short = 0
    for k in range(g.n):
        i = np.uint64(k)
        a, b, column = np.uint64(g.head + k), np.uint64(g.far + k), np.uint64(g.first + k)
        real = rest[column] > 0.0
        length0 = rest[column] if real else 1.0
        dx, dy, dz = x[0, b] - x[0, a], x[1, b] - x[1, a], x[2, b] - x[2, a]
        squared = dx * dx + dy * dy + dz * dz if real else 1.0
        # by one root and one division, which take longest; the stretch of a bar at rest is exactly 1
        length = math.sqrt(squared)
        inverse = 1.0 / (length * length0)
        stretch = 1.0 + (length - length0) * (length * inverse)
        short += 0 if stretch >= SHORTENED_STRETCH else 1  # NaN counts
        work[_DX + i], work[_DY + i], work[_DZ + i], work[_STRETCH + i] = dx, dy, dz, stretch
        work[_FACTOR + i] = length0 * inverse if real else 0.0
    return short


@inlined
def _differences_of_stars(g, nodes, bars, far, x, rest, work):
    """Write the same for the columns of a group of stars."""
    begin = np.int64(bars[g.run])
    for run in range(g.run, g.end):
        a = np.uint64(nodes[run])
        ax, ay, az = x[0, a], x[1, a], x[2, a]
        for k in range(np.int64(bars[run]), np.int64(bars[run + 1])):
            b, i = np.uint64(far[k]), np.uint64(k - begin)
            work[_DX + i], work[_DY + i], work[_DZ + i] = x[0, b] - ax, x[1, b] - ay, x[2, b] - az
    short = 0
    for k in range(g.n):
        i = np.uint64(k)
        dx, dy, dz, length0 = work[_DX + i], work[_DY + i], work[_DZ + i], rest[np.uint64(g.first + k)]
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        inverse = 1.0 / (length * length0)
        stretch = 1.0 + (length - length0) * (length * inverse)
        short += 0 if stretch >= SHORTENED_STRETCH else 1
        work[_STRETCH + i], work[_FACTOR + i] = stretch, length0 * inverse
    return short


@inlined
def _measure(n, measure, work):
    """Write the strains of n columns, and their derivative by the stretch over the length."""
    if measure == ENGINEERING:
        for k in range(n):
            i = np.uint64(k)
            work[_STRAIN + i] = engineering(work[_STRETCH + i])[0]
    else:
        for k in range(n):
            i = np.uint64(k)
            work[_STRAIN + i], slope, _ = measured(measure, work[_STRETCH + i])
            work[_FACTOR + i] *= slope


@inlined
def _read_heat(g, nodes, bars, heat, work):
    """Subtract thermal strains, and write temperatures."""
    for run in range(g.run, g.end):
        bar = np.int64(bars[run])
        column = run_column(g, run, nodes, bars)
        for k in range(bar, np.int64(bars[run + 1])):
            i = np.uint64(column + k - bar)
            work[_STRAIN + i] -= heat[0, k]
            work[_TEMPERATURE + i] = heat[1, k]


@inlined
def _copy(n, values, at, out, to):
    """Write n numbers from a place on to another array."""
    for k in range(n):
        out[np.uint64(to + k)] = values[np.uint64(at + k)]


@inlined
def _read_bars(g, measure, runs, x, rest, heat, work):
    """Read the bars of a group into the workspace; return how many are short. ``runs``: nodes, bars and far ends of the
    layout."""
    nodes, bars, far = runs
    if g.star:
        short = _differences_of_stars(g, nodes, bars, far, x, rest, work)
    else:
        short = _differences_of_runs(g, x, rest, work)
    _measure(g.n, measure, work)
    if heat.shape[1] > 0:
        _read_heat(g, nodes, bars, heat, work)
    return short


@inlined
def _read_history(g, rows, history, work):
    for j in range(rows):
        _copy(g.n, history, g.at + j * g.stride, work, (HISTORY + j) * ROW)


@inlined
def _pull(n, area, areas, first, work):
    """Write N/l of n columns [N/m]; ``areas`` are theirs if the one area is NaN."""
    if math.isnan(area):
        for k in range(n):
            i = np.uint64(k)
            work[_PULL + i] = areas[np.uint64(first + k)] * work[_STRESS + i] * work[_FACTOR + i]
    else:
        for k in range(n):
            i = np.uint64(k)
            work[_PULL + i] = area * work[_STRESS + i] * work[_FACTOR + i]


@inlined
def _sum_energy(n, row, first, rest, area, areas, work):
    """Return the energy of n columns, whose density is in a row of the workspace."""
    total = 0.0
    if math.isnan(area):
        for k in range(n):
            column = np.uint64(first + k)
            volume = areas[column] * rest[column] if rest[column] > 0.0 else 0.0
            total = add_freely(total, work[np.uint64(row * ROW + k)] * volume)
    else:
        for k in range(n):
            length = rest[np.uint64(first + k)]
            total = add_freely(total, work[np.uint64(row * ROW + k)] * (area * length if length > 0.0 else 0.0))
    return total


@inlined
def _subtract(n, head, f, work):
    """Write the forces of n columns, and subtract them from their lower ends."""
    for k in range(n):
        i, a = np.uint64(k), np.uint64(head + k)
        pull = work[_PULL + i]
        px, py, pz = pull * work[_DX + i], pull * work[_DY + i], pull * work[_DZ + i]
        f[0, a] -= px
        f[1, a] -= py
        f[2, a] -= pz
        work[_DX + i], work[_DY + i], work[_DZ + i] = px, py, pz


@inlined
def _add(n, far, f, c, work):
    """Add a component of the forces of n columns to their upper ends."""
    for k in range(n):
        f[c, np.uint64(far + k)] += work[np.uint64(c * ROW + k)]


@inlined
def _add_to_stars(g, nodes, bars, far, f, work):
    """Add the forces of a group of stars."""
    begin = np.int64(bars[g.run])
    for k in range(g.n):
        i = np.uint64(k)
        pull = work[_PULL + i]
        work[_DX + i] *= pull
        work[_DY + i] *= pull
        work[_DZ + i] *= pull
    for run in range(g.run, g.end):
        fx = 0.0
        fy = 0.0
        fz = 0.0
        for k in range(np.int64(bars[run]), np.int64(bars[run + 1])):
            b, i = np.uint64(far[k]), np.uint64(k - begin)
            px, py, pz = work[_DX + i], work[_DY + i], work[_DZ + i]
            fx += px
            fy += py
            fz += pz
            f[0, b] += px
            f[1, b] += py
            f[2, b] += pz
        a = np.uint64(nodes[run])
        f[0, a] -= fx
        f[1, a] -= fy
        f[2, a] -= fz


@inlined
def _bar_of(g, column, bars, column_of):
    """Return the bar in a column of a group, counted from its first one; -1 for none."""
    for k in range(np.int64(bars[g.run]), np.int64(bars[g.end])):
        if np.int64(column_of[k]) - g.first == column:
            return k
    return np.int64(-1)


@inlined
def _check_short(n, first, rest, broken, history, commit, work):
    """Take the forces of collapsed bars away, or make them NaN; return the first such column, or -1, and whether any
    bar may be inverted. ``broken``: where ``history`` has the state of rupture before the evaluation, or -1."""
    failed = -1
    shortened = False
    for k in range(n):
        i = np.uint64(k)
        stretch = work[_STRETCH + i]
        if broken >= 0:  # noqa: SIM102
            if abs(history[broken + k]) >= 1.0:
                # it may have no length; one that breaks in this step has its force still
                if not stretch > COLLAPSED_STRETCH:
                    work[_PULL + i] = 0.0
                continue
        if rest[first + k] > 0.0 and stretch < SHORTENED_STRETCH:
            shortened = True
        if not stretch > COLLAPSED_STRETCH:  # NaN fails this test too
            failed = k if failed < 0 else failed
            # the norms of the solver must detect an inadmissible trial position
            work[_PULL + i] = 0.0 if commit else math.nan
    return failed, shortened


@inlined
def _count_broken(n, first, rest, before, history, after, work):
    count = 0
    for k in range(n):
        changed = history[np.uint64(before + k)] != work[np.uint64(after + k)]
        count += 1 if rest[np.uint64(first + k)] > 0.0 and changed else 0
    return count


def new_workspace(rows: int) -> np.ndarray:
    """Return the workspace of loops over bars, for laws with up to so many rows."""
    return aligned(rows * ROW, DIFFERENCES)


@kernel
def internal_forces(x, f, bars, laws, step, commit, energies):
    """Add the internal forces at positions ``x`` to ``f``, and the energies of counted bars to ``energies``, see
    :data:`~pfem_petsc.columns.BAR_ENERGIES` [J], unless this array is empty; the history is updated if ``commit``.

    ``laws``: those of each section, ``full`` if energies are needed; ``step``: from its start to the positions [s]. It
    returns the first collapsed bar or -1, whether any is so short that it may be inverted, and how many have changed
    their state of rupture.
    """
    failed, shortened, broke = np.int64(-1), False, 0
    layout, history, work, rest, areas = bars.layout, bars.history, bars.work, bars.rest, bars.areas
    nodes, ends, far = layout.nodes, layout.bars, layout.far
    for s in range(len(bars.area)):
        law, p, area, gone = laws[s], bars.parameters[s], bars.area[s], bars.gone[s]
        for group in range(layout.sections[s], layout.sections[s + 1]):
            g = group_of(layout, s, group, bars.places[s])
            short = _read_bars(g, bars.measures[s], (nodes, ends, far), x, rest, bars.heat, work)
            _read_history(g, bars.rows[s], history, work)
            law(p, step, work, g.n)
            _pull(g.n, area, areas, g.first, work)
            for j in range(bars.energies.shape[1] if len(energies) > 0 and group < layout.counted[s] else 0):
                if bars.energies[s, j] >= 0:
                    row = HISTORY + bars.rows[s] + j
                    energies[bars.energies[s, j]] += _sum_energy(g.n, row, g.first, rest, area, areas, work)
            broken = g.at + gone * g.stride if gone >= 0 else np.int64(-1)
            if short > 0:
                column, inverted = _check_short(g.n, g.first, rest, broken, history, commit, work)
                shortened = shortened or inverted
                if column >= 0 and failed < 0:
                    failed = _bar_of(g, column, ends, layout.column_of)
            if gone >= 0:
                broke += _count_broken(g.n, g.first, rest, broken, history, (HISTORY + gone) * ROW, work)
            for j in range(bars.kept[s] if commit else 0):
                _copy(g.n, work, (HISTORY + j) * ROW, history, g.at + j * g.stride)
            if g.star:
                _add_to_stars(g, nodes, ends, far, f, work)
            else:
                _subtract(g.n, g.head, f, work)
                for c in range(3):
                    _add(g.n, g.far, f, c, work)
    return failed, shortened, broke


@inlined
def _area(bars, s, column):
    """Return the area of a bar [m2]."""
    return bars.areas[column] if math.isnan(bars.area[s]) else bars.area[s]


@inlined
def _stiffness_of_group(n, measure, area, areas, first, rest, work):
    """Write c and g of n columns, see :func:`stiffnesses`, in the place of the first two end differences."""
    each, is_green, is_logarithmic = math.isnan(area), measure == GREEN, measure == LOGARITHMIC
    for k in range(n):
        i, column = np.uint64(k), np.uint64(first + k)
        length0 = rest[column] if rest[column] > 0.0 else 1.0
        stretch, factor, stress = work[_STRETCH + i], work[_FACTOR + i], work[_STRESS + i]
        length = stretch * length0
        slope, curvature = factor * length, 0.0
        if is_green:
            curvature = 1.0
        if is_logarithmic:
            curvature = -1.0 / (stretch * stretch)
        size = areas[column] if each else area
        pull = size * stress * factor
        axial = size * (work[_MODULUS + i] * slope * slope + stress * curvature) / length0
        work[_DX + i], work[_DY + i] = (axial - pull) / (length * length), pull


@inlined
def _put_stiffness(first, last, column, weight, work, stored):
    """Write c and g from a column on to the bars of a run."""
    ahead = column - np.int64(first)
    for k in range(np.int64(first), np.int64(last)):
        i, bar = np.uint64(ahead + k), np.uint64(k)
        stored[0, bar], stored[1, bar] = weight * work[_DX + i], weight * work[_DY + i]


@kernel
def stiffnesses(x, bars, laws, step, weight, stored):
    """Write c = (dN/dl - N/l)/l^2 [N/m3] and g = N/l [N/m], times ``weight``, of each bar to ``stored`` (2, b): the
    stiffness of a bar with end difference d is c d d^T + g I. ``laws``: as of :func:`internal_forces`, ``full``."""
    layout, history, work, rest, areas = bars.layout, bars.history, bars.work, bars.rest, bars.areas
    nodes, ends, far = layout.nodes, layout.bars, layout.far
    for s in range(len(bars.area)):
        law, p, area, gone = laws[s], bars.parameters[s], bars.area[s], bars.gone[s]
        for group in range(layout.sections[s], layout.sections[s + 1]):
            g = group_of(layout, s, group, bars.places[s])
            _read_bars(g, bars.measures[s], (nodes, ends, far), x, rest, bars.heat, work)
            _read_history(g, bars.rows[s], history, work)
            law(p, step, work, g.n)
            _stiffness_of_group(g.n, bars.measures[s], area, areas, g.first, rest, work)
            if gone >= 0:
                for k in range(g.n):
                    if abs(history[g.at + gone * g.stride + k]) >= 1.0:
                        work[_DX + np.uint64(k)] = work[_DY + np.uint64(k)] = 0.0
            for run in range(g.run, g.end):
                _put_stiffness(ends[run], ends[run + 1], run_column(g, run, nodes, ends), weight, work, stored)


@kernel
def states(x, bars, laws, out, densities):
    """Write total strain, stress [Pa] and axial force [N] of each bar at the end of the last step to ``out`` (3, b),
    and its energies, without flow over time, to ``densities`` (number of BAR_ENERGIES, b) [J/m3], or (0, 0).
    ``laws``: ``full``."""
    layout, history, work = bars.layout, bars.history, bars.work
    for s in range(len(layout.counted)):
        law, p, gone, last, measure = laws[s], bars.parameters[s], bars.gone[s], bars.last[s], bars.measures[s]
        row = HISTORY + bars.rows[s]
        for group in range(layout.sections[s], layout.sections[s + 1]):
            g = group_of(layout, s, group, bars.places[s])
            _read_bars(g, measure, (layout.nodes, layout.bars, layout.far), x, bars.rest, bars.heat, work)
            _read_history(g, bars.rows[s], history, work)
            law(p, 0.0, work, g.n)
            for k in range(np.int64(layout.bars[g.run]), np.int64(layout.bars[g.end])):
                i = np.int64(layout.column_of[k]) - g.first
                stretch, state = work[_STRETCH + np.uint64(i)], 0.0
                if gone >= 0:
                    state = abs(history[g.at + gone * g.stride + i])
                    stretch = 0.0 if state >= 1.0 and math.isnan(stretch) else stretch  # it may have no length
                strain, slope, _ = measured(measure, stretch)
                stress = work[_STRESS + np.uint64(i)]
                if last >= 0:  # the rate of the last step is not known any more, but its stress is
                    stress = history[g.at + (last + 1) * g.stride + i] * (1.0 - state)
                out[0, k], out[1, k], out[2, k] = strain, stress, _area(bars, s, g.first + i) * stress * slope
                for j in range(bars.energies.shape[1] if len(densities) > 0 else 0):
                    if bars.energies[s, j] >= 0:
                        densities[bars.energies[s, j], k] = work[(row + j) * ROW + i]


class StepStart(NamedTuple):
    """Positions (local, 3) at the start of a step, and rest lengths (b,) and heat (2, b) then, (0,) and (2, 0) if they
    do not change."""

    x: np.ndarray
    rest: np.ndarray
    heat: np.ndarray


@inlined
def _length(x, a, b):
    dx, dy, dz = x[b, 0] - x[a, 0], x[b, 1] - x[a, 1], x[b, 2] - x[a, 2]
    return math.sqrt(dx * dx + dy * dy + dz * dz)


@kernel
def step_coefficients(x, ends, bars, laws, step, start, out):
    """Write c = A l0 S R [N/m] and dc/dl1/l1 [N/m3] of the discrete gradient of each bar between two positions to
    ``out`` (2, b); c is NaN for a collapsed bar. Of Simo-Tarnow type: S is the mean stress of the step. ``x``
    (local, 3); ``laws``: ``mean``."""
    layout = bars.layout
    work = bars.work
    for s in range(len(layout.counted)):
        law, p, gone, measure = laws[s], bars.parameters[s], bars.gone[s], bars.measures[s]
        for group in range(layout.sections[s], layout.sections[s + 1]):
            g = group_of(layout, s, group, bars.places[s])
            work[STRAIN * ROW : HISTORY * ROW] = 0.0
            _read_history(g, bars.rows[s], bars.history, work)
            for k in range(np.int64(layout.bars[g.run]), np.int64(layout.bars[g.end])):
                i, rest = np.uint64(layout.column_of[k] - g.first), bars.rest[layout.column_of[k]]
                rest0 = start.rest[k] if len(start.rest) > 0 else rest
                length0, length = _length(start.x, ends[k, 0], ends[k, 1]), _length(x, ends[k, 0], ends[k, 1])
                work[_STRAIN0 + i] = measured(measure, length0 / rest0)[0]
                work[_STRAIN + i] = measured(measure, length / rest)[0]
                if bars.heat.shape[1] > 0:
                    work[_STRAIN0 + i] -= start.heat[0, k]
                    work[_STRAIN + i] -= bars.heat[0, k]
                    work[_TEMPERATURE0 + i], work[_TEMPERATURE + i] = start.heat[1, k], bars.heat[1, k]
            law(p, step, work, g.n)
            for k in range(np.int64(layout.bars[g.run]), np.int64(layout.bars[g.end])):
                i = np.int64(layout.column_of[k]) - g.first
                if gone >= 0:  # noqa: SIM102
                    if abs(bars.history[g.at + gone * g.stride + i]) >= 1.0:
                        out[0, k], out[1, k] = 0.0, 0.0
                        continue
                rest1 = bars.rest[g.first + i]
                rest = 0.5 * (rest1 + start.rest[k]) if len(start.rest) > 0 else rest1
                length0, length = _length(start.x, ends[k, 0], ends[k, 1]), _length(x, ends[k, 0], ends[k, 1])
                if not length / rest > COLLAPSED_STRETCH:
                    out[0, k], out[1, k] = math.nan, 0.0
                    continue
                slope = measured(measure, length / rest1)[1] * (rest / rest1)
                r, dr = mean_ratio(measure, length0 / rest, length / rest)
                area, stress = _area(bars, s, g.first + i), work[_STRESS + np.uint64(i)]
                out[0, k] = area * stress * r / rest
                out[1, k] = area * (work[_MODULUS + np.uint64(i)] * slope * r + stress * dr) / (rest * rest) / length


@kernel
def known_rates(ends, bars, s, step, motion, known):
    """Write the known part of the strain rates of a section to ``known`` (n,), see ``Bars.set_rates``; ``motion``:
    positions at the start, positions, velocities, all (local, 3), and eta."""
    x0, x, v, eta = motion
    layout = bars.layout
    for group in range(layout.sections[s], layout.sections[s + 1]):
        g = group_of(layout, s, group, bars.places[s])
        for k in range(np.int64(layout.bars[g.run]), np.int64(layout.bars[g.end])):
            a, b, column = ends[k, 0], ends[k, 1], np.int64(layout.column_of[k]) - g.first
            rest = bars.rest[g.first + column]
            length = _length(x, a, b)
            strain, slope, _ = measured(bars.measures[s], length / rest)
            along = 0.0
            for c in range(3):
                along += (x[b, c] - x[a, c]) * (v[b, c] - v[a, c])
            rate = slope * along / (length * rest) if length > 0.0 else 0.0
            if step > 0.0:
                begun = measured(bars.measures[s], _length(x0, a, b) / rest)[0]
                shift = bars.heat[0, k] if bars.heat.shape[1] > 0 else 0.0
                before = bars.history[g.at + bars.last[s] * g.stride + column]
                # what temperatures and rest lengths change the strain by in the step, and the strain at x
                rate += (begun - shift - before) / step + eta * (before - (strain - shift))
            known[k - np.int64(layout.bars[layout.runs[layout.sections[s]]])] = rate

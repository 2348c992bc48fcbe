"""The evaluation of a bar, written once over a material law and a strain measure, and all loops that are made from it.

A loop gathers what the law reads of a bar, evaluates it, and scatters the result: forces, tangents, products,
linearisations, fields, densities, of a state or of a step between two positions.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from types import SimpleNamespace
from typing import Any, NamedTuple, Protocol

import numpy as np
from numba.core import types
from numba.extending import register_jitable

from ..columns import BAR_ENERGIES
from ..mesh.ordering import NODE_BLOCK
from .compiled import address_of, borrowing, borrowing_apart, borrowing_kernel, inlined, kernel
from .materials.base import Law
from .runs import Columns, Sweep, add_lower_ends, clear_lower_ends, copy, end_differences, scatter_forces
from .tuples import CHUNK, ROW, accumulate, bar_value, differ, put, put_into, sum_up, take, take_from

COLLAPSED_STRETCH = 1e-3  # below this fraction of its rest length a bar is crushed, and no truss model applies
SHORTENED_STRETCH = math.sqrt(0.8)  # only bars shorter than this are checked for passing through zero length


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


class ElementFamily(Protocol):
    """Elements besides the bars, such as springs to the ground: what :class:`~pfem_petsc.mechanics.bars.Bars` adds up.

    Stiffness is that at the positions of the last forces. Each rank adds what acts on the nodes that it owns.

    Attributes
    ----------
    energy : name of the stored energy, of :data:`~pfem_petsc.columns.BAR_ENERGIES`
    """

    energy: str

    def add_forces(self, x: np.ndarray, f: np.ndarray) -> float:
        """Add the internal forces at positions ``x`` to ``f``, both (local, 3); return the stored energy [J]."""

    def add_step_forces(self, x0: np.ndarray, x: np.ndarray, f: np.ndarray) -> None:
        """Add the discrete gradient of a step from ``x0`` to ``x``, whose work is the change of the energy."""

    def add_product(self, weight: float, u: np.ndarray, out: np.ndarray) -> None:
        """Add ``weight`` times the stiffness times ``u`` to ``out``, with a row for each owned node at least."""

    def add_tangents(self, weight: float, pattern: Any, values: np.ndarray) -> None:
        """Add ``weight`` times the stiffness to the values of a matrix with a ``BlockPattern``."""


class BarData(NamedTuple):
    """Bars [start, stop) of one section, as compiled loops read them.

    ``ends`` (b, 2) local ends; ``far`` (b,) upper end of each bar, (0,) if all bars are in runs; ``sweep`` of the bars;
    ``rest`` (b,) rest lengths [m]; ``heat`` (2, b) thermal strains and temperatures [K], (2, 0) for none; both at the
    start of the step, ``rest_at_start`` (0,) if rest lengths are constant; ``parameters`` of the law; ``area`` [m2], a
    number or (n,); ``step`` from its start to the positions [s]; ``history`` (rows, n) of bar k in column k - start:
    ``law.rows``, and after them its ``law.bar_data``, which no loop writes.
    """

    start: np.uint64
    stop: np.uint64  # unsigned: loops need not handle negative indices
    ends: np.ndarray
    far: np.ndarray
    sweep: Sweep
    rest: np.ndarray
    heat: np.ndarray
    rest_at_start: np.ndarray
    heat_at_start: np.ndarray
    parameters: tuple
    area: float | np.ndarray
    step: float
    history: np.ndarray


class Bar(NamedTuple):
    """What a law reads of a bar: rest length [m], thermal strain, temperature [K], area [m2] and its numbers; strain
    and stress at the end of the last step, for laws with a rate; and its internal variables."""

    rest: float
    shift: float
    warmth: float
    area: float
    parameters: tuple
    strain: float
    stress: float
    variables: tuple[float, ...]


def virgin(law: Law) -> tuple[float, ...]:
    """Return the internal variables of a law at the start: zeros."""
    return (0.0,) * len(law.internal)


@borrowing
def end_difference(x, bars, k):
    """Return the end difference (dx, dy, dz) of a bar."""
    a = bars.ends[k, 0]
    b = bars.ends[k, 1]
    return x[b, 0] - x[a, 0], x[b, 1] - x[a, 1], x[b, 2] - x[a, 2]


@inlined
def length_of(d):
    """Return the length of an end difference."""
    return math.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])


@inlined
def stretch_and_inverse(squared, rest):
    """Return the stretch of a bar with a squared length, and the inverse of its length [1/m], by one root and one
    division, which take longest in loops over forces; the stretch of a bar at rest is exactly 1."""
    length = math.sqrt(squared)
    inverse = 1.0 / (length * rest)
    return 1.0 + (length - rest) * (length * inverse), rest * inverse


@cache
def make_element(law: Law, measure: Callable[..., Any]) -> SimpleNamespace:
    """Make the functions that read and evaluate a bar: ``read``, ``evaluate``, ``whole_stress``, ``stiffness`` and
    ``step_stiffness``."""
    response, mean_stress, by_rate, last = law.response, law.mean_stress, law.rate, len(law.internal)
    can_break, gone, ratio = law.rupture >= 0, max(law.rupture, 0), _RATIOS[measure]
    n_rows, n_data = len(law.rows), len(law.bar_data)
    variables_of, data_of = take(len(law.internal)), take_from(n_data)

    @borrowing
    def read(bars, k):
        """Return the :class:`Bar` k of :class:`BarData`."""
        column = k - bars.start
        shift = 0.0
        warmth = 0.0
        if bars.heat.shape[1] > 0:
            shift = bars.heat[0, k]
            warmth = bars.heat[1, k]
        strain = 0.0
        stress = 0.0
        if by_rate:
            strain = bars.history[last, column]
            stress = bars.history[last + 1, column]
        area = bar_value(bars.area, column)
        p = bars.parameters + data_of(bars.history, n_rows, column) if n_data else bars.parameters
        return Bar(bars.rest[k], shift, warmth, area, p, strain, stress, variables_of(bars.history, column))

    @inlined
    def evaluate(stretch, bar, step):
        """Return strain with its first two derivatives by the stretch, stress [Pa], modulus [Pa], internal variables at
        the end of the step and energy densities [J/m3] of a bar; the strain includes the thermal one."""
        strain, slope, curvature = measure(stretch)
        rate = 0.0
        if by_rate and step > 0.0:
            rate = (strain - bar.shift - bar.strain) / step
        stress, modulus, new, densities = response(
            strain - bar.shift, rate, step, bar.warmth, bar.parameters, bar.variables
        )
        return strain, slope, curvature, stress, modulus, new, densities

    @inlined
    def whole_stress(stress, variables):
        """Return the stress [Pa] that a law with a rate keeps: of what is left of a bar."""
        if can_break:
            left = 1.0 - abs(variables[gone])
            return stress / left if left > 0.0 else 0.0
        return stress

    @inlined
    def stiffness(d, bar, step):
        """Return dN/dl [N/m], N/l [N/m] and 1/l of a bar with end difference ``d``."""
        if can_break:  # noqa: SIM102 - not compiled otherwise
            if abs(bar.variables[gone]) >= 1.0:
                return 0.0, 0.0, 0.0
        length = length_of(d)
        _, slope, curvature, stress, modulus, _, _ = evaluate(length / bar.rest, bar, step)
        axial = bar.area * (modulus * slope * slope + stress * curvature) / bar.rest
        return axial, bar.area * stress * slope / length, 1.0 / length

    @inlined
    def step_stiffness(d0, d, start, bar, step):
        """Return the coefficient c = A l0 S R [N/m], dc/dl1 [N/m2] and 1/l1 of the discrete gradient between two end
        differences; c is NaN for a collapsed bar. Of Simo-Tarnow type: S is the mean stress of the step. ``start``:
        rest length, thermal strain and temperature then."""
        if can_break:  # noqa: SIM102 - not compiled otherwise
            if abs(bar.variables[gone]) >= 1.0:
                return 0.0, 0.0, 0.0
        rest0, shift0, warmth0 = start
        length = length_of(d)
        length0 = length_of(d0)
        rest = 0.5 * (rest0 + bar.rest)
        s0 = length0 / rest
        s1 = length / rest
        if not (s1 > COLLAPSED_STRETCH):
            return math.nan, 0.0, 0.0
        e0, _, _ = measure(s0)
        e1, slope, _ = measure(s1)
        if rest0 != bar.rest:
            e0, _, _ = measure(length0 / rest0)
            e1, slope, _ = measure(length / bar.rest)
            slope *= rest / bar.rest
        e0 -= shift0
        e1 -= bar.shift
        rate = 0.0
        if by_rate:
            stress0 = bar.stress * (1.0 - abs(bar.variables[gone])) if can_break else bar.stress
            if step > 0.0:
                rate = (e1 - e0) / step
        else:
            stress0, _, _, _ = response(e0, 0.0, 0.0, warmth0, bar.parameters, bar.variables)
        mean, modulus = mean_stress(stress0, e0, e1, rate, step, bar.warmth, bar.parameters, bar.variables)
        r, dr = ratio(s0, s1)
        c = bar.area * mean * r / rest
        dc = bar.area * (modulus * slope * r + mean * dr) / (rest * rest)
        return c, dc, 1.0 / length

    return SimpleNamespace(
        read=read, evaluate=evaluate, whole_stress=whole_stress, stiffness=stiffness, step_stiffness=step_stiffness
    )


class MatrixRows(NamedTuple):
    """Where bars add blocks to a matrix in compressed rows, see :class:`~.block_pattern.BlockPattern`:
    ``ptr`` (owned + 1,), ``slots`` (b, 4), ``values``; the ``weight`` of the stiffness; and ``inertia`` [kg/(m s2)], a
    number or (n,), which times the ``lengths`` in the mesh (b,) is added twice on the diagonal, and once off it."""

    weight: float
    inertia: float | np.ndarray
    lengths: np.ndarray
    ptr: np.ndarray
    slots: np.ndarray
    values: np.ndarray


@borrowing
def add_blocks(out, bars, k, c, d, n, g):
    """Add the stiffness c d n^T + g I of a bar, and its inertia, to the rows of its owned ends."""
    mass = bar_value(out.inertia, k - bars.start) * out.lengths[k]
    values = out.values
    for side in range(4):
        slot = out.slots[k, side]
        if slot < 0:
            continue
        row = bars.ends[k, 0] if side < 2 else bars.ends[k, 1]
        sign = 1.0 if side % 2 == 0 else -1.0
        at = 6 * out.ptr[row] + 3 * slot
        wide = 3 * (out.ptr[row + 1] - out.ptr[row])
        factor = sign * c
        diagonal = sign * g + (2.0 * mass if side % 2 == 0 else mass)
        for i in range(3):
            for j in range(3):
                part = factor * d[i] * n[j]
                values[at + i * wide + j] += part + diagonal if i == j else part


@borrowing
def add_to_ends(f, bars, k, fx, fy, fz):
    """Subtract a force from the first end of a bar in ``f``, and add it to the second one."""
    a = bars.ends[k, 0]
    b = bars.ends[k, 1]
    f[a, 0] -= fx
    f[a, 1] -= fy
    f[a, 2] -= fz
    f[b, 0] += fx
    f[b, 1] += fy
    f[b, 2] += fz


def _for_all(name: str, visit: Callable[..., Any]) -> Callable[..., Any]:
    """Make the loop over all bars of a block that calls ``visit(x, bars, k, out)``."""

    def loop(x: Any, bars: Any, out: Any) -> None:
        for k in range(bars.start, bars.stop):
            visit(x, bars, k, out)

    loop.__name__ = name
    loop.__qualname__ = f"_for_all.<locals>.{name}"  # each has its own file of machine code
    return kernel(loop)


def _energies_of(law: Law) -> np.ndarray:
    """Return the places of the energies of a law in :data:`~pfem_petsc.columns.BAR_ENERGIES`."""
    return np.array([BAR_ENERGIES.index(name) for name in law.energies], dtype=np.int64)


def _state_loops(law: Law, element: SimpleNamespace, measure: Callable[..., Any]) -> dict[str, Any]:
    """Make the loops that evaluate each bar by itself at positions x, for what :class:`~pfem_petsc.mechanics.bars.Bars`
    documents under the same names."""
    read, evaluate, stiffness = element.read, element.evaluate, element.stiffness
    by_rate, can_break, gone, known = law.rate, law.rupture >= 0, max(law.rupture, 0), max(law.known_rate, 0)
    places = _energies_of(law)

    @borrowing
    def tangents(x, bars, k, out):
        d = end_difference(x, bars, k)
        axial, geometric, inverse = stiffness(d, read(bars, k), bars.step)
        n = (d[0] * inverse, d[1] * inverse, d[2] * inverse)
        add_blocks(out, bars, k, out.weight * (axial - geometric), n, n, out.weight * geometric)

    @borrowing
    def linearise(x, bars, k, out):
        """``out``: weight and (5, b) n, dN/dl - N/l and N/l."""
        weight, stored = out
        d = end_difference(x, bars, k)
        axial, geometric, inverse = stiffness(d, read(bars, k), bars.step)
        stored[0, k], stored[1, k], stored[2, k] = d[0] * inverse, d[1] * inverse, d[2] * inverse
        stored[3, k] = weight * (axial - geometric)
        stored[4, k] = weight * geometric

    @borrowing
    def fields(x, bars, k, out):
        """``out``: (b,) total strain, stress [Pa] and axial force [N] at the end of the last step."""
        strains, stresses, forces = out
        bar = read(bars, k)
        length = length_of(end_difference(x, bars, k))
        if by_rate:
            strain, slope, _ = measure(length / bar.rest)
            stress = bar.stress
            if can_break:
                stress *= 1.0 - abs(bar.variables[gone])
        else:
            strain, slope, _, stress, _, _, _ = evaluate(length / bar.rest, bar, 0.0)
        strains[k] = strain
        stresses[k] = stress
        forces[k] = bar.area * stress * slope

    @borrowing
    def densities(x, bars, k, out):
        """``out``: (number of BAR_ENERGIES, b) energies per rest volume [J/m3], without flow over time."""
        bar = read(bars, k)
        _, _, _, _, _, _, found = evaluate(length_of(end_difference(x, bars, k)) / bar.rest, bar, 0.0)
        for j in range(len(found)):
            out[places[j], k] = found[j]

    @borrowing
    def rates(x, bars, k, out):
        """``out``: positions at the start of the step, velocities at x, and eta; see ``Bars.set_rates``."""
        x0, v, eta = out
        bar = read(bars, k)
        dx, dy, dz = end_difference(x, bars, k)
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        strain, slope, _ = measure(length / bar.rest)
        vx, vy, vz = end_difference(v, bars, k)
        along = dx * vx + dy * vy + dz * vz
        rate = slope * along / (length * bar.rest) if length > 0.0 else 0.0
        if bars.step > 0.0:
            begun, _, _ = measure(length_of(end_difference(x0, bars, k)) / bar.rest)
            # what temperatures and rest lengths change the strain by in the step, and the strain at x
            rate += (begun - bar.shift - bar.strain) / bars.step + eta * (bar.strain - (strain - bar.shift))
        bars.history[known, k - bars.start] = rate

    visits = (tangents, linearise, fields, densities, rates)
    return {visit.__name__: _for_all(visit.__name__, visit) for visit in visits}


def _step_loops(law: Law, element: SimpleNamespace) -> dict[str, Any]:
    """Make the loops of the step between two positions, with ``mean_stress`` of the law: ``step_forces`` and
    ``step_tangents``, not symmetric, which add to ``out`` = (positions at the start, forces or :class:`MatrixRows`)."""
    read, step_stiffness = element.read, element.step_stiffness

    @borrowing
    def both(x0, x, bars, k):
        d0 = end_difference(x0, bars, k)
        d = end_difference(x, bars, k)
        bar = read(bars, k)
        rest0 = bars.rest_at_start[k] if len(bars.rest_at_start) > 0 else bar.rest
        shift0 = 0.0
        warmth0 = 0.0
        if bars.heat.shape[1] > 0:
            shift0 = bars.heat_at_start[0, k]
            warmth0 = bars.heat_at_start[1, k]
        c, dc, inverse = step_stiffness(d0, d, (rest0, shift0, warmth0), bar, bars.step)
        middle = (0.5 * (d0[0] + d[0]), 0.5 * (d0[1] + d[1]), 0.5 * (d0[2] + d[2]))
        return c, dc, middle, (d[0] * inverse, d[1] * inverse, d[2] * inverse)

    @borrowing
    def step_forces(x, bars, k, out):
        x0, f = out
        c, _, middle, _ = both(x0, x, bars, k)
        add_to_ends(f, bars, k, c * middle[0], c * middle[1], c * middle[2])

    @borrowing
    def step_tangents(x, bars, k, out):
        x0, rows = out
        c, dc, middle, n = both(x0, x, bars, k)
        add_blocks(rows, bars, k, rows.weight * dc, middle, n, rows.weight * 0.5 * c)

    return {visit.__name__: _for_all(visit.__name__, visit) for visit in (step_forces, step_tangents)}


@inlined
def sum_energies(work, places, energies):
    """Add the sums of the workspace of loops over chunks and over padded runs, which follow four rows, to ``energies``
    [J] at ``places`` (k,), see :data:`~pfem_petsc.columns.BAR_ENERGIES`."""
    for j in range(len(places)):
        s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = 0.0  # additions that do not wait for each other
        for i in range((4 + j) * ROW, (4 + j) * ROW + CHUNK, 8):
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
def clear_energies(work, places):
    """Set the sums of :func:`sum_energies` to zero."""
    sums = work[4 * ROW :]
    for i in range(len(places) * ROW):  # much faster than an assignment to a slice
        sums[i] = 0.0


def _run_loops(law: Law, element: SimpleNamespace) -> dict[str, Any]:
    """Make the loops that evaluate chunks of runs, several bars at once: ``forces``, with its part for batches
    ``add_forces``; and ``stiffnesses``; ``places`` and ``work_rows`` of the workspace, see :func:`sum_energies`."""
    read, evaluate, whole_stress, stiffness = element.read, element.evaluate, element.whole_stress, element.stiffness
    places = _energies_of(law)
    by_rate, last, n_rows = law.rate, len(law.internal), len(law.rows)
    first_new = 4 + len(places)
    first_pull = first_new + n_rows
    work_rows = first_pull + 3
    add_energies, put_new, changes = accumulate(len(law.energies)), put(len(law.internal)), differ(len(law.internal))
    can_break, gone = law.rupture >= 0, max(law.rupture, 0)

    @borrowing
    def add_forces(x, bars, begun, ended, commit, f, work):
        """Add the internal forces of the chunks [begun, ended) of the sweep to ``f``; results as those of
        :func:`forces`.

        ``work`` (work_rows ROW,): end differences, force over length, sums of the energies, new history, and
        forces as vectors. One sum is kept per position in a chunk, so vector instructions need no reordering.
        """
        failed = -1
        shortened = False
        broke = 0
        starts, chunks = bars.sweep.starts, bars.sweep.chunks
        rest, history, step = bars.rest, bars.history, bars.step
        xs, ys, zs, cs = work[:ROW], work[ROW : 2 * ROW], work[2 * ROW : 3 * ROW], work[3 * ROW : 4 * ROW]
        lasts = work[(first_new + last) * ROW :]
        stresses = work[(first_new + last + 1) * ROW :]
        pulls = work[first_pull * ROW :]
        for chunk in range(begun, ended):
            first = starts[chunks[chunk]]
            n = starts[chunks[chunk + 1]] - first
            begin = first - bars.start  # column of the history
            end_differences(x, bars.sweep, bars.ends, chunk, work)
            short = 0
            changed = 0
            for i in range(n):
                bar = read(bars, first + i)
                stretch, inverse = stretch_and_inverse(xs[i] * xs[i] + ys[i] * ys[i] + zs[i] * zs[i], bar.rest)
                short += 0 if stretch >= SHORTENED_STRETCH else 1  # NaN counts
                strain, slope, _, stress, _, new, densities = evaluate(stretch, bar, step)
                add_energies(work, 4 * ROW + i, bar.area * bar.rest, densities)
                if n_rows > 0:
                    put_new(work, first_new * ROW + i, new)
                    changed += 1 if by_rate or changes(new, bar.variables) else 0
                    if can_break:
                        broke += 1 if new[gone] != bar.variables[gone] else 0
                if by_rate:
                    lasts[i] = strain - bar.shift
                    stresses[i] = whole_stress(stress, bar.variables)
                cs[i] = bar.area * stress * slope * inverse
            if n_rows > 0 and commit and changed > 0:
                for j in range(n_rows):
                    copy(work[(first_new + j) * ROW :], history[j][begin : begin + n])
            if short > 0:
                for i in range(n):
                    stretch = math.sqrt(xs[i] ** 2 + ys[i] ** 2 + zs[i] ** 2) / rest[first + i]
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
            scatter_forces(f, bars.sweep, bars.far, chunk, work, pulls)
        return failed, shortened, broke

    @kernel
    def forces(x, bars, commit, f, energies):
        """Add internal forces to ``f``, and sums over counted bars to ``energies``, see
        :data:`~pfem_petsc.columns.BAR_ENERGIES` [J]; return the first failed bar or -1, whether any bar is so short
        that it may be inverted, and how many bars have changed their state of rupture."""
        work = np.empty(work_rows * ROW)
        failed = -1
        shortened = False
        broke = 0
        limits = (bars.sweep.counted, len(bars.sweep.diagonal), 0, bars.sweep.counted)
        for side in range(0, 4, 2):  # first the bars that are counted on other ranks
            clear_energies(work, places)
            at, short, more = add_forces(x, bars, limits[side], limits[side + 1], commit, f, work)
            failed = at if failed < 0 else failed
            shortened = shortened or short
            broke += more
        sum_energies(work, places, energies)
        return failed, shortened, broke

    @borrowing
    def linearise_chunk(x, bars, chunk, weight, stored, work):
        starts, chunks = bars.sweep.starts, bars.sweep.chunks
        first = starts[chunks[chunk]]
        n = starts[chunks[chunk + 1]] - first
        end_differences(x, bars.sweep, bars.ends, chunk, work)
        along, across = stored[0, first : first + n], stored[1, first : first + n]
        for i in range(n):
            d = (work[i], work[ROW + i], work[2 * ROW + i])
            axial, geometric, inverse = stiffness(d, read(bars, first + i), bars.step)
            along[i] = weight * ((axial - geometric) * inverse * inverse)
            across[i] = weight * geometric

    @kernel
    def stiffnesses(x, bars, weight, stored):
        """Write (dN/dl - N/l)/l^2 and N/l of each bar [N/m3], [N/m] times ``weight`` to ``stored`` (2, b)."""
        work = np.empty(3 * ROW)
        for chunk in range(len(bars.sweep.diagonal)):
            linearise_chunk(x, bars, chunk, weight, stored, work)

    return {
        "forces": forces,
        "add_forces": add_forces,
        "stiffnesses": stiffnesses,
        "places": places,
        "work_rows": work_rows,
    }


def _padded_loops(law: Law, element: SimpleNamespace) -> dict[str, Any]:
    """Make ``add_padded`` and ``add_padded_energies``, which add internal forces of padded runs for batches of steps,
    the latter with the sums of energies."""
    evaluate, whole_stress = element.evaluate, element.whole_stress
    by_rate, last, n_rows, n_data = law.rate, len(law.internal), len(law.rows), len(law.bar_data)
    variables_of, data_of = take(len(law.internal)), take_from(n_data)
    add_force, put_new, put_last = accumulate(3), put_into(len(law.internal)), put_into(2)
    n_energies = len(law.energies)
    sum_densities, nothing = sum_up(n_energies), (0.0,) * n_energies
    put_energies = accumulate(n_energies)
    masks = n_rows + n_data > 0 or not law.relaxed  # whether columns without a bar would give forces
    rupture, can_break, gone = law.rupture, law.rupture >= 0, max(law.rupture, 0)

    def make(counts: bool) -> Callable[..., Any]:
        @borrowing_apart
        def add_padded(x, bars, base, begun, ended, work):
            """Add the internal forces of the groups [begun, ended) of padded runs to ``bars.pulls`` (3 stride,), and
            update the history in ``bars.columns.kept``; results as those of :func:`forces`.

            ``x`` (n, 3) positions, which are also in ``bars.planes`` (3 stride,) from node ``base`` on; ``work``: the
            forces on the lower ends of the bars of a block of nodes by components, and the sums of energies if the loop
            ``counts`` them.
            """
            failed = -1
            shortened = False
            broke = 0
            data, columns, planes, sums = bars.data, bars.columns, bars.planes, bars.pulls
            stride = len(planes) // 3
            heads, fars, starts = columns.heads, columns.fars, columns.starts
            rests, kept, step = columns.rest, columns.kept, data.step
            origin = -1  # first node of the block whose forces are in the workspace
            wide = 0
            stored = nothing
            for group in range(begun, ended):
                first = starts[group]
                n = starts[group + 1] - first
                node = np.int64(heads[group])
                block = node // NODE_BLOCK * NODE_BLOCK
                if block != origin:
                    if origin >= 0:
                        add_lower_ends(work, wide, sums, origin - base)
                    clear_lower_ends(work)
                    origin = block
                    wide = 0
                lower = work[node - block :]
                wide = max(wide, node - block + n)
                x0, x1 = node - base, np.int64(fars[group]) - base
                y0, y1, z0, z1 = x0 + stride, x1 + stride, x0 + 2 * stride, x1 + 2 * stride
                short = False
                for i in range(n):
                    rest = rests[first + i]
                    real = rest > 0.0
                    rest = rest if real else 1.0
                    # unsigned: negative indices need not be handled
                    dx = planes[np.uint64(x1 + i)] - planes[np.uint64(x0 + i)]
                    dy = planes[np.uint64(y1 + i)] - planes[np.uint64(y0 + i)]
                    dz = planes[np.uint64(z1 + i)] - planes[np.uint64(z0 + i)]
                    squared = dx * dx + dy * dy + dz * dz
                    stretch, inverse = stretch_and_inverse(squared if real else 1.0, rest)
                    short |= not stretch >= SHORTENED_STRETCH  # NaN counts
                    q = variables_of(kept, first + i)
                    before = kept[last, first + i] if by_rate else 0.0
                    p = data.parameters + data_of(kept, n_rows, first + i) if n_data else data.parameters
                    area = bar_value(columns.area, first + i)
                    bar = Bar(rest, 0.0, 0.0, area, p, before, 0.0, q)
                    strain, slope, _, stress, _, new, densities = evaluate(stretch, bar, step)
                    if counts:
                        stored = sum_densities(stored, real if masks else True, area * rest, densities)
                    pull = area * stress * slope * inverse
                    if masks:
                        pull = pull if real else 0.0
                    pull = pull if stretch > COLLAPSED_STRETCH else 0.0
                    add_force(lower, i, -pull, (dx, dy, dz))
                    sums[np.uint64(x1 + i)] += pull * dx
                    sums[np.uint64(y1 + i)] += pull * dy
                    sums[np.uint64(z1 + i)] += pull * dz
                    if n_rows > 0:
                        put_new(kept, 0, first + i, new)
                        if can_break:
                            broke += 1 if real and new[gone] != q[gone] else 0
                    if by_rate:
                        put_last(kept, last, first + i, (strain, whole_stress(stress, q)))
                if short:
                    at, inverted = find_short(x, data.sweep, columns, group, rupture)
                    failed = at if failed < 0 else failed
                    shortened = shortened or inverted
            if origin >= 0:
                add_lower_ends(work, wide, sums, origin - base)
            if counts:
                put_energies(work, 4 * ROW, 1.0, stored)
            return failed, shortened, broke

        return add_padded

    return {"add_padded": make(False), "add_padded_energies": make(True)}


@borrowing
def find_short(x, sweep, columns, group, rupture):
    """Return the first collapsed bar of a group of padded runs at positions ``x`` (n, 3), or -1, and whether any is so
    short that it may be inverted; broken bars may have any length. ``rupture``: see
    :class:`~pfem_petsc.mechanics.materials.base.Law`."""
    failed, shortened = -1, False
    head, far, first = np.int64(columns.heads[group]), np.int64(columns.fars[group]), np.int64(columns.starts[group])
    for run in range(columns.runs[group], columns.runs[group + 1]):
        ahead = np.int64(sweep.heads[run]) - head
        for k in range(sweep.starts[run + 1] - sweep.starts[run]):
            i = ahead + k
            if rupture >= 0 and abs(columns.kept[rupture, first + i]) >= 1.0:
                continue
            a, b = head + i, far + i
            dx, dy, dz = x[b, 0] - x[a, 0], x[b, 1] - x[a, 1], x[b, 2] - x[a, 2]
            stretch = math.sqrt(dx * dx + dy * dy + dz * dz) / columns.rest[first + i]
            if stretch < SHORTENED_STRETCH:
                shortened = True
            if not (stretch > COLLAPSED_STRETCH) and failed < 0:  # NaN fails this test too
                failed = np.int64(sweep.starts[run] + k)  # signed, like -1
    return failed, shortened


@cache
def make_loops(law: Law, measure: Callable[..., Any]) -> SimpleNamespace:
    """Make all loops of a law and a strain measure; those of steps only if the law has a mean stress."""
    element = make_element(law, measure)
    found = _state_loops(law, element, measure) | _run_loops(law, element) | _padded_loops(law, element)
    if law.mean_stress is not None:
        found |= _step_loops(law, element)
    return SimpleNamespace(**found)


PULLED = types.Tuple((types.int64, types.boolean, types.int64))
"""Results of the loops that batches call by their addresses: the first failed bar, or -1, whether any bar is so short
that it may be inverted, and the number of bars that have changed their state of rupture."""


class PulledBars(NamedTuple):
    """The bars of a section as the loops of batches read them: ``columns``, or none, and ``planes`` and ``pulls``
    (3 stride,), positions and forces of nodes by components."""

    data: BarData
    columns: Columns
    planes: np.ndarray
    pulls: np.ndarray


@cache
def batch_pulls(law: Law, measure: Callable[..., Any]) -> SimpleNamespace:
    """Make the loops of a law that batches call by their addresses: ``chunks``, which adds the forces of some chunks of
    bars, and ``padded``, which adds those of some groups of padded runs, and their energies if it ``counts`` them. Both
    get a pointer to :class:`PulledBars`."""
    loops = make_loops(law, measure)
    add_forces, add_padded, add_padded_energies = loops.add_forces, loops.add_padded, loops.add_padded_energies

    @borrowing_kernel
    def chunks(x, bars, begun, ended, f, work):
        failed, shortened, broke = add_forces(x, bars[0].data, begun, ended, True, f, work)
        return np.int64(failed), bool(shortened), np.int64(broke)

    @borrowing_kernel
    def padded(x, bars, base, begun, ended, work, counts):
        if counts:
            failed, shortened, broke = add_padded_energies(x, bars[0], base, begun, ended, work)
        else:
            failed, shortened, broke = add_padded(x, bars[0], base, begun, ended, work)
        return np.int64(failed), bool(shortened), np.int64(broke)

    return SimpleNamespace(chunks=chunks, padded=padded)


def pull_addresses(law: Law, measure: Callable[..., Any], pointer: types.Type) -> tuple[int, int]:
    """Return the addresses of the loops of :func:`batch_pulls` for a pointer of a type."""
    loops, vectors, numbers, at = batch_pulls(law, measure), types.float64[:, ::1], types.float64[::1], types.int64
    return (
        address_of(loops.chunks, (vectors, pointer, at, at, vectors, numbers), PULLED),
        address_of(loops.padded, (vectors, pointer, at, at, at, numbers, types.boolean), PULLED),
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

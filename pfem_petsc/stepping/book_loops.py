"""Compiled loops of the energy ledger: sums over owned nodes in one pass over the nodal arrays.

The vectors of the nodes are read as flat arrays (x, y, z, x, ...). Each of the first 3 :data:`LANES` positions has a
sum of its own, to which the numbers that far apart are added: vector instructions then need no reordering, and the sums
do not depend on how the nodes are divided into blocks.
"""

from __future__ import annotations

import numpy as np

from ..mechanics.compiled import inlined, kernel

__all__ = [
    "LANES",
    "TOTALS",
    "WIDE",
    "WORKS",
    "book_nodes",
    "book_totals",
    "new_lanes",
    "spread",
    "sum_lane",
]

WORKS = ("external", "contact", "damping", "inertial", "internal")
"""Works that :func:`book_nodes` returns [J], in this order; the first includes supports."""

TOTALS = ("momentum", "angular_momentum", "mass_times_position", "support", "external", "damping")
"""Vectors that :func:`book_nodes` returns, in this order; the last two are sums of forces."""

LANES = 128
"""Nodes with sums of their own; blocks of nodes begin at multiples of it."""

WIDE = 3 * LANES
"""Components of these nodes."""

_KINETIC, _MOMENTUM, _ANGULAR, _MOVED, _SUPPORT, _EXTERNAL, _DAMPING, _CROSSED = (WIDE * k for k in range(8))
_WORK_EXTERNAL, _WORK_CONTACT, _WORK_DAMPING, _WORK_INERTIAL, _WORK_INTERNAL = (WIDE * k for k in range(8, 13))
_WORK_SUPPORT = WIDE * 13
_BY_EXTERNAL = WORKS.index("external")
# workspaces after the sums: mass, mass times velocity, half the displacement
_MASSES, _PULSES, _WAYS = (WIDE * k for k in range(14, 17))


@kernel
def new_lanes():
    """Return the sums of all lanes, zero, and workspace."""
    return np.zeros(_WAYS + WIDE)


@kernel
def _book_part(
    x0,
    x1,
    mass,
    factor,
    v,
    p,
    support,
    damping,
    a0,
    a1,
    v0,
    v1,
    f0,
    f1,
    e0,
    e1,
    s0,
    s1,
    r0,
    r1,
    lanes,
):
    """Add all nodes to the sums of the lanes; arguments as those of :func:`book_nodes`."""
    # Each loop reads few arrays: with more the compiler does not check that they do not overlap. Loops begin at zero,
    # which spares them a check for negative indices.
    masses, ways = lanes[_MASSES : _MASSES + WIDE], lanes[_WAYS : _WAYS + WIDE]
    kinetic = lanes[_KINETIC : _KINETIC + WIDE]
    inertial = lanes[_WORK_INERTIAL : _WORK_INERTIAL + WIDE]
    internal = lanes[_WORK_INTERNAL : _WORK_INTERNAL + WIDE]
    external = lanes[_WORK_EXTERNAL : _WORK_EXTERNAL + WIDE]
    for first in range(0, len(x0), LANES):
        last = min(first + LANES, len(x0))
        wide = 3 * (last - first)
        z0, z1 = x0[first:last].reshape(-1), x1[first:last].reshape(-1)
        speeds, pulses = v[first:last].reshape(-1), p[first:last].reshape(-1)
        _add_totals(mass[first:last], factor[first:last], z1, pulses, lanes)
        spread(factor[first:last], masses)
        for j in range(wide):
            kinetic[j] += masses[j] * pulses[j] * speeds[j]
        one, other = a0[first:last].reshape(-1), a1[first:last].reshape(-1)
        for j in range(wide):
            way = 0.5 * (z1[j] - z0[j])
            ways[j] = way
            inertial[j] += masses[j] * (way * (one[j] + other[j]))
        one, other = f0[first:last].reshape(-1), f1[first:last].reshape(-1)
        for j in range(wide):
            internal[j] += ways[j] * (one[j] + other[j])
        if len(e0) > 0:
            one, other = e0[first:last].reshape(-1), e1[first:last].reshape(-1)
            loads = lanes[_EXTERNAL : _EXTERNAL + WIDE]
            for j in range(wide):
                external[j] += ways[j] * (one[j] + other[j])
                loads[j] += other[j]
        if len(s0) > 0:
            one, other, held = s0[first:last].reshape(-1), s1[first:last].reshape(-1), support[first:last].reshape(-1)
            reactions, work = lanes[_SUPPORT : _SUPPORT + WIDE], lanes[_WORK_SUPPORT : _WORK_SUPPORT + WIDE]
            for j in range(wide):
                work[j] += ways[j] * (one[j] + other[j])
                reactions[j] += held[j]
        if len(r0) > 0:
            one, other = r0[first:last].reshape(-1), r1[first:last].reshape(-1)
            contact = lanes[_WORK_CONTACT : _WORK_CONTACT + WIDE]
            for j in range(wide):
                contact[j] += ways[j] * (one[j] + other[j])
        if len(damping) > 0:
            spread(damping[first:last], masses)
            one, other = v0[first:last].reshape(-1), v1[first:last].reshape(-1)
            work, drags = lanes[_WORK_DAMPING : _WORK_DAMPING + WIDE], lanes[_DAMPING : _DAMPING + WIDE]
            for j in range(wide):
                work[j] += masses[j] * (ways[j] * (one[j] + other[j]))
                drags[j] -= masses[j] * other[j]


@inlined
def spread(values, masses):
    """Write the value of each node three times."""
    for i in range(len(values)):
        masses[3 * i] = values[i]
        masses[3 * i + 1] = values[i]
        masses[3 * i + 2] = values[i]


@kernel
def _add_totals(mass, factor, x, p, lanes):
    """Add momentum, angular momentum and mass times position of some nodes to the sums of the lanes."""
    masses, products = lanes[_MASSES : _MASSES + WIDE], lanes[_PULSES : _PULSES + WIDE]
    moved, momentum = lanes[_MOVED : _MOVED + WIDE], lanes[_MOMENTUM : _MOMENTUM + WIDE]
    angular, crossed = lanes[_ANGULAR : _ANGULAR + WIDE], lanes[_CROSSED : _CROSSED + WIDE]
    spread(mass, masses)
    for j in range(len(x)):
        moved[j] += masses[j] * x[j]
    spread(factor, masses)
    for j in range(len(x)):
        products[j] = masses[j] * p[j]
        momentum[j] += products[j]
    # x p_y - y p_x and y p_z - z p_y at the places of x and y, x p_z - z p_x at that of x; others are not used
    for j in range(len(x) - 1):
        angular[j] += x[j] * products[j + 1] - x[j + 1] * products[j]
    for j in range(len(x) - 2):
        crossed[j] += x[j] * products[j + 2] - x[j + 2] * products[j]


@kernel
def _sum_totals(lanes, wide, count, totals):
    """Write the first ``count`` vectors of ``totals`` from the sums of the lanes."""
    for k in range(count):
        totals[k] = sum_lane(lanes[_MOMENTUM + WIDE * k :], wide)
    across = sum_lane(lanes[_CROSSED:], wide)[0]
    totals[1, 0], totals[1, 1], totals[1, 2] = totals[1, 1], -across, totals[1, 0]


@kernel
def book_totals(x, mass, v, lanes, totals):
    """Write momentum, angular momentum and mass times position of lumped masses into the first rows of ``totals``;
    ``lanes`` is workspace."""
    wide = min(3 * len(x), WIDE)
    for row in (_MOMENTUM, _ANGULAR, _MOVED, _CROSSED):
        sums = lanes[row : row + WIDE]
        for j in range(wide):  # much faster than an assignment to a slice
            sums[j] = 0.0
    for first in range(0, len(x), LANES):
        last = min(first + LANES, len(x))
        masses = mass[first:last]
        _add_totals(masses, masses, x[first:last].reshape(-1), v[first:last].reshape(-1), lanes)
    _sum_totals(lanes, wide, 3, totals)


@inlined
def sum_lane(lanes, wide):
    """Return the sums of each component of some lanes, of four nodes at a time, so that additions do not wait for each
    other; beyond ``wide`` lanes are zero."""
    x0 = x1 = x2 = x3 = y0 = y1 = y2 = y3 = z0 = z1 = z2 = z3 = 0.0
    for j in range(0, wide, 12):
        x0 += lanes[j]
        y0 += lanes[j + 1]
        z0 += lanes[j + 2]
        x1 += lanes[j + 3]
        y1 += lanes[j + 4]
        z1 += lanes[j + 5]
        x2 += lanes[j + 6]
        y2 += lanes[j + 7]
        z2 += lanes[j + 8]
        x3 += lanes[j + 9]
        y3 += lanes[j + 10]
        z3 += lanes[j + 11]
    return (x0 + x1) + (x2 + x3), (y0 + y1) + (y2 + y3), (z0 + z1) + (z2 + z3)


@kernel
def book_nodes(
    x0, x1, mass, factor, v, p, support, damping, a0, a1, v0, v1, f0, f1, e0, e1, s0, s1, r0, r1, totals, works
):
    """Return the kinetic energy [J] at the end of a step; sum over nodes there, and works over dx = x1 - x0 by the mean
    of two sets of forces.

    Parameters
    ----------
    x0, x1 : (owned, 3) positions at start and end
    mass : (owned,); the momentum of a node is ``factor`` (owned,) times ``p``: m v, or M v with factor one
    v, p, support : (owned, 3) at the end
    damping : (owned,), (0,) for none; like ``factor`` it multiplies ``v0`` and ``v1``
    a0, a1, v0, v1, f0, f1, e0, e1, s0, s1, r0, r1 : acceleration, velocity, internal, external, support and contact
        force at start and end of the works' rule (owned, 3); the last six may be (0, 3) for zero, in pairs
    totals : (6, 3) output, see :data:`TOTALS`; external and damping force are those at the end of the works' rule
    works : (5,) output [J], see :data:`WORKS`
    """
    lanes = new_lanes()
    _book_part(x0, x1, mass, factor, v, p, support, damping, a0, a1, v0, v1, f0, f1, e0, e1, s0, s1, r0, r1, lanes)
    wide = min(3 * len(x0), WIDE)
    _sum_totals(lanes, wide, len(totals), totals)
    for k in range(len(works)):
        x, y, z = sum_lane(lanes[_WORK_EXTERNAL + WIDE * k :], wide)
        works[k] = x + y + z
    x, y, z = sum_lane(lanes[_WORK_SUPPORT:], wide)
    works[_BY_EXTERNAL] += x + y + z
    x, y, z = sum_lane(lanes, wide)  # the first are those of the kinetic energy
    return 0.5 * (x + y + z)

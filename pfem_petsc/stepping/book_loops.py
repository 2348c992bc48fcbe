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
    "WORKS",
    "book_nodes",
    "book_part",
    "book_supports",
    "clear_lanes",
    "new_lanes",
    "sum_lanes",
]

WORKS = ("external", "contact", "damping", "inertial", "internal")
"""Works that :func:`book_nodes` returns [J], in this order; the first includes supports."""

TOTALS = ("momentum", "angular_momentum", "mass_times_position", "support", "external", "damping")
"""Vectors that :func:`book_nodes` returns, in this order; the last two are sums of forces."""

LANES = 128
"""Nodes with sums of their own; blocks of nodes begin at multiples of it."""

_WIDE = 3 * LANES
_KINETIC, _MOMENTUM, _ANGULAR, _MOVED, _SUPPORT, _EXTERNAL, _DAMPING, _CROSSED = (_WIDE * k for k in range(8))
_WORK_EXTERNAL, _WORK_CONTACT, _WORK_DAMPING, _WORK_INERTIAL, _WORK_INTERNAL = (_WIDE * k for k in range(8, 13))
_WORK_SUPPORT = _WIDE * 13
_BY_EXTERNAL = WORKS.index("external")
_FORCES = TOTALS.index("support")
# workspaces after the sums: mass, mass times velocity, half the displacement
_MASSES, _PULSES, _WAYS = (_WIDE * k for k in range(14, 17))


@kernel
def new_lanes():
    """Return the sums of all lanes, zero, and workspace."""
    return np.zeros(_WAYS + _WIDE)


@kernel
def clear_lanes(lanes, n):
    """Set the sums of ``n`` nodes to zero."""
    wide = min(3 * n, _WIDE)
    for first in range(0, _MASSES, _WIDE):
        row = lanes[first : first + _WIDE]
        for j in range(wide):  # much faster than an assignment to a slice
            row[j] = 0.0


@kernel
def book_part(
    begin,
    end,
    whole,
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
    """Add the nodes [begin, end) to the sums of the lanes; arguments as those of :func:`book_nodes`."""
    # Each loop reads few arrays: with more the compiler does not check that they do not overlap. Loops begin at zero,
    # which spares them a check for negative indices.
    masses, ways = lanes[_MASSES : _MASSES + _WIDE], lanes[_WAYS : _WAYS + _WIDE]
    kinetic = lanes[_KINETIC : _KINETIC + _WIDE]
    inertial = lanes[_WORK_INERTIAL : _WORK_INERTIAL + _WIDE]
    internal = lanes[_WORK_INTERNAL : _WORK_INTERNAL + _WIDE]
    external = lanes[_WORK_EXTERNAL : _WORK_EXTERNAL + _WIDE]
    for first in range(begin, end, LANES):
        last = min(first + LANES, end)
        wide = 3 * (last - first)
        z0, z1 = x0[first:last].reshape(-1), x1[first:last].reshape(-1)
        speeds, pulses = v[first:last].reshape(-1), p[first:last].reshape(-1)
        if whole:
            _book_totals(mass[first:last], factor[first:last], z1, pulses, lanes)
        _spread(factor[first:last], masses)
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
            loads = lanes[_EXTERNAL : _EXTERNAL + _WIDE]
            for j in range(wide):
                external[j] += ways[j] * (one[j] + other[j])
                loads[j] += other[j]
        if len(s0) > 0:
            one, other, held = s0[first:last].reshape(-1), s1[first:last].reshape(-1), support[first:last].reshape(-1)
            reactions, work = lanes[_SUPPORT : _SUPPORT + _WIDE], lanes[_WORK_SUPPORT : _WORK_SUPPORT + _WIDE]
            for j in range(wide):
                work[j] += ways[j] * (one[j] + other[j])
                reactions[j] += held[j]
        if len(r0) > 0:
            one, other = r0[first:last].reshape(-1), r1[first:last].reshape(-1)
            contact = lanes[_WORK_CONTACT : _WORK_CONTACT + _WIDE]
            for j in range(wide):
                contact[j] += ways[j] * (one[j] + other[j])
        if len(damping) > 0:
            _spread(damping[first:last], masses)
            one, other = v0[first:last].reshape(-1), v1[first:last].reshape(-1)
            work, drags = lanes[_WORK_DAMPING : _WORK_DAMPING + _WIDE], lanes[_DAMPING : _DAMPING + _WIDE]
            for j in range(wide):
                work[j] += masses[j] * (ways[j] * (one[j] + other[j]))
                drags[j] -= masses[j] * other[j]


@kernel
def book_supports(begin, end, nodes, components, x0, x1, s0, s1, lanes):
    """Add the forces ``s0`` and ``s1`` (owned, 3) at the prescribed components [begin, end), sorted by node, to the
    sums of the lanes, like :func:`book_part` those at all components."""
    for k in range(begin, end):
        i, c = nodes[k], components[k]
        j = 3 * (i % LANES) + c
        lanes[_WORK_SUPPORT + j] += 0.5 * (x1[i, c] - x0[i, c]) * (s0[i, c] + s1[i, c])
        lanes[_SUPPORT + j] += s1[i, c]


@inlined
def _spread(values, masses):
    """Write the value of each node three times."""
    for i in range(len(values)):
        masses[3 * i] = values[i]
        masses[3 * i + 1] = values[i]
        masses[3 * i + 2] = values[i]


@kernel
def _book_totals(mass, factor, x, p, lanes):
    """Add momentum, angular momentum and mass times position of some nodes to the sums of the lanes."""
    masses, products = lanes[_MASSES : _MASSES + _WIDE], lanes[_PULSES : _PULSES + _WIDE]
    moved, momentum = lanes[_MOVED : _MOVED + _WIDE], lanes[_MOMENTUM : _MOMENTUM + _WIDE]
    angular, crossed = lanes[_ANGULAR : _ANGULAR + _WIDE], lanes[_CROSSED : _CROSSED + _WIDE]
    _spread(mass, masses)
    for j in range(len(x)):
        moved[j] += masses[j] * x[j]
    _spread(factor, masses)
    for j in range(len(x)):
        products[j] = masses[j] * p[j]
        momentum[j] += products[j]
    # x p_y - y p_x and y p_z - z p_y at the places of x and y, x p_z - z p_x at that of x; others are not used
    for j in range(len(x) - 1):
        angular[j] += x[j] * products[j + 1] - x[j + 1] * products[j]
    for j in range(len(x) - 2):
        crossed[j] += x[j] * products[j + 2] - x[j + 2] * products[j]


@kernel
def sum_lanes(lanes, n, whole, totals, works):
    """Write ``totals`` and ``works`` from the sums of ``n`` nodes, forces alone unless ``whole``; return the kinetic
    energy [J]."""
    wide = min(3 * n, _WIDE)
    for k in range(0 if whole else _FORCES, len(totals)):
        totals[k] = _sum(lanes, _MOMENTUM + _WIDE * k, wide)
    if whole:
        across = _sum(lanes, _CROSSED, wide)[0]
        totals[1, 0], totals[1, 1], totals[1, 2] = totals[1, 1], -across, totals[1, 0]
    for k in range(len(works)):
        x, y, z = _sum(lanes, _WORK_EXTERNAL + _WIDE * k, wide)
        works[k] = x + y + z
    x, y, z = _sum(lanes, _WORK_SUPPORT, wide)
    works[_BY_EXTERNAL] += x + y + z
    x, y, z = _sum(lanes, _KINETIC, wide)
    return 0.5 * (x + y + z)


@inlined
def _sum(lanes, first, wide):
    """Return the sums of each component, of four nodes at a time, so that additions do not wait for each other."""
    x0 = x1 = x2 = x3 = y0 = y1 = y2 = y3 = z0 = z1 = z2 = z3 = 0.0
    for j in range(first, first + wide, 12):  # beyond ``wide`` is zero
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
    n = len(x0)
    lanes = new_lanes()
    book_part(
        0, n, True, x0, x1, mass, factor, v, p, support, damping, a0, a1, v0, v1, f0, f1, e0, e1, s0, s1, r0, r1, lanes
    )
    return sum_lanes(lanes, n, True, totals, works)

"""Compiled sums over owned nodes for the energy ledger: powers of forces, sums of forces, momenta.

Sums are accumulated in lanes, one for each component of :data:`LANES` consecutive nodes, so that the loops are
vectorised and a sum over blocks of nodes has the bits of a sum over all nodes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ..mechanics.compiled import add_freely, borrowing_apart, inlined, kernel

WORKS = ("external", "contact", "damping", "inertial", "internal")
"""Works of the ledger [J], in this order; the first includes supports."""

EXTERNAL, CONTACT, DAMPING, INERTIAL, INTERNAL = range(len(WORKS))
REACTIONS, _PUSHES, _DRAGS = (len(WORKS) + k for k in range(3))  # further lanes of a balance: sums of forces
ENDS = _DRAGS + 1
"""The first of the lanes of the works of loads, contact and damping over the last half step, in the order of
:data:`WORKS`."""
_SUMS = ENDS + DAMPING + 1  # not lanes, but the sums of :func:`add_ends`: two works, kinetic energy, three vectors
_N_SUMS = 12

LANES = 64
"""Nodes with sums of their own; blocks of nodes begin at multiples of it."""

WIDE = 3 * LANES
"""Components of these nodes."""


class Acting(NamedTuple):
    """Whether supports, loads, contact and damping act in a balance."""

    supports: bool
    loads: bool
    contact: bool
    damping: bool


@inlined
def spread(values, masses):
    """Write the value of each node three times."""
    for i in range(len(values)):
        masses[3 * i] = values[i]
        masses[3 * i + 1] = values[i]
        masses[3 * i + 2] = values[i]


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
def power(force, v):
    """Return the sum of force times velocity, or of force times displacement, (n, 3) both, over nodes and
    components."""
    lanes = np.zeros(WIDE)
    add_powers(force.reshape(-1), v.reshape(-1), lanes)
    x, y, z = sum_lane(lanes, min(3 * len(v), WIDE))
    return x + y + z


@kernel
def total(force):
    """Return the sum (3,) of vectors (n, 3) over nodes."""
    lanes, sums = np.zeros(WIDE), np.empty(3)
    add_forces(force.reshape(-1), lanes)
    sums[0], sums[1], sums[2] = sum_lane(lanes, min(3 * len(force), WIDE))
    return sums


@inlined
def turn(place, momentum):
    """Return the cross product of the place of a node and its momentum."""
    (x, y, z), (px, py, pz) = place, momentum
    return y * pz - z * py, z * px - x * pz, x * py - y * px


@kernel
def sum_momenta(x, mass, momentum):
    """Return momentum, angular momentum and mass times position (3, 3) of nodes at ``x`` (n, 3) with ``momentum`` (n,
    3) and lumped ``mass`` (n,)."""
    sums = np.zeros((3, 3))
    for i in range(len(x)):
        angular = turn((x[i, 0], x[i, 1], x[i, 2]), (momentum[i, 0], momentum[i, 1], momentum[i, 2]))
        for c in range(3):
            sums[0, c] += momentum[i, c]
            sums[1, c] += angular[c]
            sums[2, c] += mass[i] * x[i, c]
    return sums


@kernel
def new_sums():
    """Return the lanes of all sums, zero."""
    return np.zeros((_SUMS + 1, WIDE))


@kernel
def clear_sums(sums, n):
    """Set the lanes of a sum over ``n`` nodes to zero."""
    for j in range(min(3 * n, WIDE)):  # much faster than an assignment to a slice
        sums[j] = 0.0


@kernel
def clear_forces(lanes, n, acting):
    """Set the sums of a balance to zero, as far as there are supports, loads and damping; not those of contact."""
    clear_sums(lanes[INTERNAL], n)
    if acting.supports:
        clear_sums(lanes[REACTIONS], n)
    if acting.loads:
        clear_sums(lanes[EXTERNAL], n)
        clear_sums(lanes[_PUSHES], n)
    if acting.damping:
        clear_sums(lanes[DAMPING], n)
        clear_sums(lanes[_DRAGS], n)


@kernel
def clear_ends(lanes, n):
    """Set the sums of :func:`add_ends`, and the lanes of the other works over the last half step, to zero."""
    for k in range(_N_SUMS):
        lanes[_SUMS, k] = 0.0
    for row in range(ENDS, _SUMS):
        clear_sums(lanes[row], n)


class EndArrays(NamedTuple):
    """Room for the end of a step at the nodes of a block: increments, and displacements in the last half of the step,
    (3 m,)."""

    u: np.ndarray
    left: np.ndarray


def _ends_loop(free: bool) -> Callable[..., Any]:
    """Make the loop over nodes that adds up the end of a step; at ``free`` nodes internal forces alone determine the
    increments."""

    @borrowing_apart
    def add_ends(given, numbers, lanes):
        """Add what the ledger needs of the end of a step at consecutive nodes: the works of inertia and of internal
        forces over half the step, kinetic energy and momenta.

        ``given``: increments (3 n,), of free nodes the inverse stiffness of the balance (n,) instead; velocities half a
        step later, internal forces and positions, (3 n,) too, and masses (n,); ``numbers``: h, alpha and eta. The sums
        are without factors, see :func:`sum_ends`.
        """
        u, half, force, x, mass = given
        h, alpha, eta = numbers
        sums = lanes[_SUMS]
        back = 0.5 * h * alpha
        internal = inertial = kinetic = 0.0
        p0 = p1 = p2 = q0 = q1 = q2 = m0 = m1 = m2 = 0.0
        for i in range(len(mass)):
            # unsigned: negative indices need not be handled
            a, b, c = np.uint64(3 * i), np.uint64(3 * i + 1), np.uint64(3 * i + 2)
            m, place, (f0, f1, f2) = mass[i], (x[a], x[b], x[c]), (force[a], force[b], force[c])
            u0, u1, u2 = (-f0 * u[i], -f1 * u[i], -f2 * u[i]) if free else (u[a], u[b], u[c])
            v0, v1, v2 = half[a] - eta * u0, half[b] - eta * u1, half[c] - eta * u2
            work = f0 * (v0 - back * u0) + f1 * (v1 - back * u1) + f2 * (v2 - back * u2)
            momentum = m * v0, m * v1, m * v2
            angular = turn(place, momentum)
            internal = add_freely(internal, work)
            inertial = add_freely(inertial, m * (u0 * u0 + u1 * u1 + u2 * u2))
            kinetic = add_freely(kinetic, momentum[0] * v0 + momentum[1] * v1 + momentum[2] * v2)
            p0, p1, p2 = add_freely(p0, momentum[0]), add_freely(p1, momentum[1]), add_freely(p2, momentum[2])
            q0, q1, q2 = add_freely(q0, angular[0]), add_freely(q1, angular[1]), add_freely(q2, angular[2])
            m0, m1, m2 = add_freely(m0, m * place[0]), add_freely(m1, m * place[1]), add_freely(m2, m * place[2])
        inertial *= alpha * alpha
        found = internal, inertial, kinetic, p0, p1, p2, q0, q1, q2, m0, m1, m2
        for k in range(_N_SUMS):
            sums[k] += found[k]

    return add_ends


add_ends, add_free_ends = _ends_loop(False), _ends_loop(True)


@kernel
def sum_ends(lanes, n, h, ends, momenta):
    """Write the works of :data:`WORKS` over the last half step, and at last the kinetic energy, to ``ends`` (6,) [J],
    and momentum, angular momentum and mass times position (3, 3)."""
    wide, sums = min(3 * n, WIDE), lanes[_SUMS]
    for k in (EXTERNAL, CONTACT, DAMPING):
        x, y, z = sum_lane(lanes[ENDS + k], wide)
        ends[k] = x + y + z
    ends[INTERNAL] = (0.5 * h) * sums[0]
    ends[INERTIAL] = 0.125 * h * h * sums[1]
    ends[len(WORKS)] = 0.5 * sums[2]
    for k in range(9):
        momenta[k // 3, k % 3] = sums[3 + k]


@kernel
def start_of_step(x, h, v, a, before):
    """Compute the positions ``before`` the last step; arrays (3 n,)."""
    for j in range(len(x)):
        before[j] = x[j] - h * (v[j] - 0.5 * h * a[j])


@kernel
def add_powers(force, v, sums):
    """Add force times velocity (3 n,) of consecutive nodes, from a multiple of :data:`LANES` on, to ``sums``."""
    for first in range(0, len(v), WIDE):
        last = min(first + WIDE, len(v))
        one, other = force[first:last], v[first:last]
        for j in range(len(one)):
            sums[j] += one[j] * other[j]


@kernel
def add_forces(force, sums):
    """Add forces (3 n,) of consecutive nodes, from a multiple of :data:`LANES` on, to ``sums``."""
    for first in range(0, len(force), WIDE):
        last = min(first + WIDE, len(force))
        one = force[first:last]
        for j in range(len(one)):
            sums[j] += one[j]


@kernel
def add_sparse_powers(nodes, force, v, sums):
    """Add force times velocity (n, 3) at some nodes, sorted, like :func:`add_powers` those at all nodes."""
    for i in nodes:
        at = 3 * (i % LANES)
        for c in range(3):
            sums[at + c] += force[i, c] * v[i, c]


@kernel
def add_sparse_forces(begin, end, nodes, components, force, sums):
    """Add ``force`` (n, 3) at the components [begin, end), sorted by node, like :func:`add_forces` all forces."""
    for k in range(begin, end):
        i, c = nodes[k], components[k]
        sums[3 * (i % LANES) + c] += force[i, c]


@kernel
def add_drags(damping, v, drag, lanes):
    """Add damping forces and their powers; ``damping`` (n,), ``v`` (3 n,), of consecutive nodes; ``drag``, workspace of
    this size or larger."""
    spread(damping, drag)
    for j in range(len(v)):
        drag[j] *= v[j]
    add_powers(drag, v, lanes[DAMPING])
    add_forces(drag[: len(v)], lanes[_DRAGS])


@kernel
def add_loads(external, v, lanes):
    """Add external forces and their powers; arrays (3 n,) of consecutive nodes."""
    add_powers(external, v, lanes[EXTERNAL])
    add_forces(external, lanes[_PUSHES])


@kernel
def sum_balance(lanes, n, h, acting, totals, powers):
    """Add ``h`` times the powers of a balance to ``powers`` (5,) [J], and write the sums (3, 3) of support, external
    and damping forces into ``totals``; those of supports, loads, contact and damping as far as there are any."""
    wide = min(3 * n, WIDE)
    totals[:] = 0.0
    _sum_power(lanes, INTERNAL, wide, h, powers)
    if acting.supports:
        totals[0] = sum_lane(lanes[REACTIONS], wide)
    if acting.loads:
        _sum_power(lanes, EXTERNAL, wide, h, powers)
        totals[1] = sum_lane(lanes[_PUSHES], wide)
    if acting.contact:
        _sum_power(lanes, CONTACT, wide, h, powers)
    if acting.damping:
        _sum_power(lanes, DAMPING, wide, h, powers)
        x, y, z = sum_lane(lanes[_DRAGS], wide)
        totals[2] = -x, -y, -z


@kernel
def _sum_power(lanes, row, wide, h, powers):
    x, y, z = sum_lane(lanes[row], wide)
    powers[row] += h * (x + y + z)

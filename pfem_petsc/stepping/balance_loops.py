"""Compiled loops of the ledger of leapfrog schemes: sums over balances, and what a row of the history adds to them.

See :mod:`~pfem_petsc.stepping.leapfrog_ledger` for the formulas. Sums are divided among lanes as in
:mod:`~pfem_petsc.stepping.book_loops`, so they do not depend on the blocks of nodes in which they are computed.
"""

from __future__ import annotations

import numpy as np

from ..mechanics.compiled import kernel
from .book_loops import LANES, WIDE, WORKS, book_totals, spread, sum_lane

__all__ = [
    "CONTACT",
    "DAMPING",
    "EXTERNAL",
    "INERTIAL",
    "INTERNAL",
    "REACTIONS",
    "add_drags",
    "add_forces",
    "add_loads",
    "add_powers",
    "add_sparse_forces",
    "add_sparse_powers",
    "book_balance",
    "book_row",
    "clear_forces",
    "clear_sums",
    "new_sums",
    "start_of_step",
    "sum_balance",
]

# rows of lanes: one for each work, in the order of WORKS, with that of inertia unused; then sums of forces
EXTERNAL, CONTACT, DAMPING, INERTIAL, INTERNAL = range(len(WORKS))
REACTIONS, _PUSHES, _DRAGS = (len(WORKS) + k for k in range(3))
_ROWS = len(WORKS) + 3


@kernel
def new_sums():
    """Return the lanes of all sums, zero."""
    return np.zeros((_ROWS, WIDE))


@kernel
def clear_sums(sums, n):
    """Set the lanes of a sum over ``n`` nodes to zero."""
    for j in range(min(3 * n, WIDE)):  # much faster than an assignment to a slice
        sums[j] = 0.0


@kernel
def clear_forces(lanes, n, supported, loaded, damped):
    """Set the sums of a balance to zero, as far as there are supports, loads and damping; not those of contact."""
    clear_sums(lanes[INTERNAL], n)
    if supported:
        clear_sums(lanes[REACTIONS], n)
    if loaded:
        clear_sums(lanes[EXTERNAL], n)
        clear_sums(lanes[_PUSHES], n)
    if damped:
        clear_sums(lanes[DAMPING], n)
        clear_sums(lanes[_DRAGS], n)


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
def sum_balance(lanes, n, h, supported, loaded, pressed, damped, totals, powers):
    """Add ``h`` times the powers of a balance to ``powers`` (5,) [J], and write the sums of forces into ``totals``;
    those of supports, loads, contact and damping as far as there are any."""
    wide = min(3 * n, WIDE)
    for k in range(3, 6):
        for c in range(3):
            totals[k, c] = 0.0
    _sum_power(lanes, INTERNAL, wide, h, powers)
    if supported:
        totals[3] = sum_lane(lanes[REACTIONS], wide)
    if loaded:
        _sum_power(lanes, EXTERNAL, wide, h, powers)
        totals[4] = sum_lane(lanes[_PUSHES], wide)
    if pressed:
        _sum_power(lanes, CONTACT, wide, h, powers)
    if damped:
        _sum_power(lanes, DAMPING, wide, h, powers)
        x, y, z = sum_lane(lanes[_DRAGS], wide)
        totals[5] = -x, -y, -z


@kernel
def _sum_power(lanes, row, wide, h, powers):
    x, y, z = sum_lane(lanes[row], wide)
    powers[row] += h * (x + y + z)


@kernel
def book_balance(f, external, damping, support, contact, v, h, totals, powers):
    """Add the works of a balance, ``h`` times force times velocity, to ``powers`` (5,) [J], in the order of ``WORKS``;
    write the sums of support, external and damping forces into ``totals`` (6, 3) [N].

    ``f``, ``v`` (owned, 3); ``support``, ``external`` and ``contact`` (owned, 3), or (0, 3) for none; ``damping``
    (owned,), or (0,) for none.
    """
    n = len(v)
    lanes = new_sums()
    drag = np.empty(WIDE)
    for first in range(0, n, LANES):  # velocities are read once from memory
        last = min(first + LANES, n)
        speeds = v[first:last].reshape(-1)
        add_powers(f[first:last].reshape(-1), speeds, lanes[INTERNAL])
        if len(support) > 0:
            add_forces(support[first:last].reshape(-1), lanes[REACTIONS])
        if len(external) > 0:
            add_loads(external[first:last].reshape(-1), speeds, lanes)
        if len(contact) > 0:
            add_powers(contact[first:last].reshape(-1), speeds, lanes[CONTACT])
        if len(damping) > 0:
            add_drags(damping[first:last], speeds, drag, lanes)
    sum_balance(lanes, n, h, len(support) > 0, len(external) > 0, len(contact) > 0, len(damping) > 0, totals, powers)


@kernel
def book_row(x, mass, v, a, f, external, damping, contact, h, lanes, room, totals, ends):
    """Return the kinetic energy [J]; write momentum, angular momentum and mass times position into ``totals`` (6, 3),
    and into ``ends`` (5,) [J], in the order of ``WORKS``, half the works over the last step of the forces at its end.

    The step was h v - h^2 a/2. At the place of inertia is h^2/8 times the sum of m a . a. Arrays as in
    :func:`book_balance`; ``lanes`` and ``room``, from :func:`~pfem_petsc.stepping.book_loops.new_lanes`, are workspace.
    """
    n = len(v)
    wide = min(3 * n, WIDE)
    half, eighth = 0.5 * h, 0.125 * h * h
    loaded, pressed, damped = len(external) > 0, len(contact) > 0, len(damping) > 0
    masses, ways, drags = np.empty(WIDE), np.empty(WIDE), np.empty(WIDE)
    for k in range(len(lanes)):
        clear_sums(lanes[k], n)
    kinetic, inertial = lanes[REACTIONS], lanes[INERTIAL]
    for first in range(0, n, LANES):
        last = min(first + LANES, n)
        speeds, pulls = v[first:last].reshape(-1), a[first:last].reshape(-1)
        spread(mass[first:last], masses)
        for j in range(len(speeds)):
            kinetic[j] += masses[j] * speeds[j] * speeds[j]
            inertial[j] += masses[j] * pulls[j] * pulls[j]
        for j in range(len(speeds)):
            ways[j] = half * (speeds[j] - half * pulls[j])
        here = ways[: len(speeds)]
        add_powers(f[first:last].reshape(-1), here, lanes[INTERNAL])
        if loaded:
            add_powers(external[first:last].reshape(-1), here, lanes[EXTERNAL])
        if pressed:
            add_powers(contact[first:last].reshape(-1), here, lanes[CONTACT])
        if damped:
            spread(damping[first:last], drags)
            for j in range(len(speeds)):
                drags[j] *= speeds[j]
            add_powers(drags, here, lanes[DAMPING])
    for k in range(len(ends)):
        ends[k] = 0.0
        _sum_power(lanes, k, wide, eighth if k == INERTIAL else 1.0, ends)
    one, two, three = sum_lane(kinetic, wide)
    book_totals(x, mass, v, room, totals)
    return 0.5 * (one + two + three)

"""Supports that move, and springs to the ground, in the loop of a batch of steps.

A component that moves has the positions of its motion at the ends of the steps; velocities at half steps are
differences of these. The loop solves for it like for one at rest, which gives velocities and accelerations by
differences, over which the works of all forces are summed. Velocities and accelerations of the state, inertia, damping
and reactions are those of the motion itself: they differ by the errors of the scheme, which are added here.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..mechanics.compiled import borrowing
from .ledger_loops import DAMPING, EXTERNAL, INERTIAL, WORKS

_KINETIC = len(WORKS)


class SpringArrays(NamedTuple):
    """Springs to the ground at ``nodes`` (m,), ascending; ``starts`` (blocks + 1,) the first one of each block of
    nodes; see :class:`~pfem_petsc.mechanics.springs.Springs`."""

    nodes: np.ndarray
    starts: np.ndarray
    stiffness: np.ndarray
    anchors: np.ndarray


class MovingSupports(NamedTuple):
    """Prescribed components that move in a batch.

    Attributes
    ----------
    at, columns : (p,) which of the prescribed components, and the columns of their motions
    origins : (p,) positions without displacement [m]
    motions : (t, 3, m) displacements, velocities and accelerations of all motions at the start of the first step,
        at the end of each, and of one more
    probed : (q, 2) which of the components are at probes, and at which
    """

    at: np.ndarray
    columns: np.ndarray
    origins: np.ndarray
    motions: np.ndarray
    probed: np.ndarray


@borrowing
def add_springs(begin, end, springs, x, f, start, sums):
    """Add the forces of the springs [begin, end) to ``f``, which begins at node ``start``; and their forces and their
    energy to ``sums`` (4,) [N], [J]."""
    nodes, stiffness, anchors = springs.nodes, springs.stiffness, springs.anchors
    for k in range(begin, end):
        i = nodes[k]
        a, b, c = x[i, 0] - anchors[k, 0], x[i, 1] - anchors[k, 1], x[i, 2] - anchors[k, 2]
        p = stiffness[k, 0, 0] * a + stiffness[k, 0, 1] * b + stiffness[k, 0, 2] * c
        q = stiffness[k, 1, 0] * a + stiffness[k, 1, 1] * b + stiffness[k, 1, 2] * c
        r = stiffness[k, 2, 0] * a + stiffness[k, 2, 1] * b + stiffness[k, 2, 2] * c
        f[i - start, 0] += p
        f[i - start, 1] += q
        f[i - start, 2] += r
        sums[0] += p
        sums[1] += q
        sums[2] += r
        sums[3] += 0.5 * (p * a + q * b + r * c)


@borrowing
def place_supports(moving, step, nodes):
    """Set the positions that the components reach one step after a step of the batch."""
    for p in range(len(moving.at)):
        nodes.support_positions[moving.at[p]] = moving.origins[p] + moving.motions[step + 2, 0, moving.columns[p]]


@borrowing
def scheme_rates(p, moving, nodes, shared):
    """Return node, component, velocity and acceleration by the scheme of a component that moves."""
    k = moving.at[p]
    i, c = nodes.support_nodes[k], nodes.support_components[k]
    u = shared.held[k]
    return i, c, shared.half[i, c] - shared.eta * u, shared.alpha * u


@borrowing
def add_inertia(moving, step, nodes, shared, sums):
    """Correct the balance of a step: reactions; the forces in ``totals`` (3, 3) [N]; the works ``powers`` (5,) [J]; and
    write to ``jumps`` (2, 3) by how much the momenta of the components at the half step and at the end of the step
    exceed those of the scheme [kg m/s]. ``sums``: the latter three."""
    totals, powers, jumps = sums
    h, support = shared.h, shared.support
    damped = len(nodes.damping) > 0
    for c in range(3):
        jumps[0, c] = jumps[1, c] = 0.0
    for p in range(len(moving.at)):
        i, c, v, a = scheme_rates(p, moving, nodes, shared)
        speed, rate = moving.motions[step + 1, 1, moving.columns[p]], moving.motions[step + 1, 2, moving.columns[p]]
        mass = nodes.mass[i]
        change = mass * (rate - a)
        if damped:
            drag = nodes.damping[i] * (speed - v)
            change += drag
            totals[2, c] -= drag
            powers[DAMPING] += h * (drag * v)
        support[i, c] += change
        totals[0, c] += change
        powers[EXTERNAL] += h * (support[i, c] * v)
        powers[INERTIAL] += h * (mass * rate * v)
        jumps[0, c] += mass * (h * (a - rate))
        jumps[1, c] += mass * (speed - (shared.half[i, c] - h * a + 0.5 * h * rate))


@borrowing
def add_ends_of_supports(moving, step, nodes, shared, ends, values):
    """Correct the sums at the end of a step, ``ends`` of :func:`~pfem_petsc.stepping.ledger_loops.sum_ends`, and
    the ``values`` (p, 4, 3) of probes."""
    works, momenta = ends
    h, x, support = shared.h, shared.x, shared.support
    damped = len(nodes.damping) > 0
    for p in range(len(moving.at)):
        i, c, v, a = scheme_rates(p, moving, nodes, shared)
        speed, rate = moving.motions[step + 1, 1, moving.columns[p]], moving.motions[step + 1, 2, moving.columns[p]]
        mass, left = nodes.mass[i], (0.5 * h) * (v - (0.5 * h) * a)
        works[EXTERNAL] += support[i, c] * left
        if damped:
            works[DAMPING] += nodes.damping[i] * (speed - v) * left
        works[INERTIAL] += 0.5 * mass * speed * speed - mass * rate * left - 0.125 * h * h * (mass * a * a)
        works[_KINETIC] += 0.5 * mass * (speed * speed - v * v)
        momentum = mass * (speed - v)
        one, other = (c + 1) % 3, (c + 2) % 3
        momenta[0, c] += momentum
        momenta[1, one] += x[i, other] * momentum
        momenta[1, other] -= x[i, one] * momentum
    for k in range(len(moving.probed)):
        p, at = moving.probed[k, 0], moving.probed[k, 1]
        c = nodes.support_components[moving.at[p]]
        values[at, 1, c] = moving.motions[step + 1, 1, moving.columns[p]]
        values[at, 2, c] = moving.motions[step + 1, 2, moving.columns[p]]


@borrowing
def put_rates(moving, step, nodes, v, a):
    """Set velocities and accelerations (n, 3) of the components at the end of a step of the batch."""
    for p in range(len(moving.at)):
        k = moving.at[p]
        i, c = nodes.support_nodes[k], nodes.support_components[k]
        v[i, c] = moving.motions[step + 1, 1, moving.columns[p]]
        a[i, c] = moving.motions[step + 1, 2, moving.columns[p]]

"""Coulomb friction of rows that share nodes: sweeps over rows between bodies and of nodes at walls alike.

A row bounds a relative coordinate, n . (sum over its nodes of w x) >= d, with weights w of its nodes: -1 and 1 of a
pair, 1 of a node at a wall. A normal force N and a drag T, which is tangential, push each of its nodes by w (N n + T).
Its slip is s = (I - n n^T) (sum of w (x - x at the start of the step) - way of the wall). By Coulomb's law

    |T| <= mu_s N where s = 0,   else T = -mu N s/|s|.

The sweeps are those of Gauss and Seidel: each row in turn gets the normal force that closes its gap, then the drag that
would stop its slip, limited by the law (M. Jean, J. J. Moreau, Contact Mechanics International Symposium, 1992).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..mechanics.compiled import inlined, kernel
from .rotations import NOWHERE, add_to, along, dot, minus, put, times, vector

_SWEEPS = 20_000
_STEADY = 10_000  # sweeps after which those that have not settled go half as far
_BROKEN = 1_000  # sweeps after which static friction no longer holds: with it there may be no solution
_SLIDES = 1e-13  # of the position: slips beyond are no rounding
_OVERSHOOT = 0.9  # of the drag over the normal force, from which on sweeps go a part of the way
_SETTLED = 1e-15  # of forces and positions: changes that are rounding


class RubbingRows(NamedTuple):
    """Rows (r,) and what their nodes, numbered as in ``soft``, do without their forces.

    Attributes
    ----------
    ends, weights : (r, k) nodes of each row, -1 for none, and their weights
    gradients : (r, k, 3) w n, zero in components that supports prescribe
    normals : (r, 3) unit vectors
    values : (r,) gaps [m]; slips : (r, 3) sum of w (x - x at the start) - way [m]
    friction : (r, 2) coefficients of dynamic and static friction; zero for rows without weights, whose gradients are
        any
    soft : (n, 3) displacements by unit forces on the nodes [m/N], 0.0 where supports prescribe a component
    gives : (r, 2) room: largest displacement by a unit drag, and that by a unit normal force [m/N]
    """

    ends: np.ndarray
    weights: np.ndarray
    gradients: np.ndarray
    normals: np.ndarray
    values: np.ndarray
    slips: np.ndarray
    friction: np.ndarray
    soft: np.ndarray
    gives: np.ndarray


class Pushes(NamedTuple):
    """``normal`` forces of rows (r,) and ``drag`` (r, 3) [N], and the displacements ``moves`` (n, 3) of nodes by these
    [m]."""

    normal: np.ndarray
    drag: np.ndarray
    moves: np.ndarray


@inlined
def _softness(a, rows):
    """Return the displacements of the components of a row's coordinate by unit forces on them."""
    total = NOWHERE
    for d in range(rows.ends.shape[1]):
        i = rows.ends[a, d]
        if i >= 0:
            total = along(total, rows.weights[a, d] * rows.weights[a, d], vector(rows.soft, i))
    return total


@inlined
def _slip_of(a, rows, moves):
    """Return the relative displacement of a row in the step, along its normal and across."""
    total = vector(rows.slips, a)
    for d in range(rows.ends.shape[1]):
        i = rows.ends[a, d]
        if i >= 0:
            total = along(total, rows.weights[a, d], vector(moves, i))
    return total


@inlined
def _across(slip, normal):
    """Return the part of a slip across a normal."""
    return along(slip, -dot(slip, normal), normal)


@inlined
def compliance(a, rows):
    """Return the displacement of a row along its normal by a unit normal force."""
    total = 0.0
    for d in range(rows.ends.shape[1]):
        i = rows.ends[a, d]
        for c in range(3 if i >= 0 else 0):
            total += rows.gradients[a, d, c] * rows.gradients[a, d, c] * rows.soft[i, c]
    return total


@inlined
def displace(a, force, drag, rows, moves):
    """Displace the nodes of a row by a normal force and a drag."""
    for d in range(rows.ends.shape[1]):
        i = rows.ends[a, d]
        for c in range(3 if i >= 0 else 0):
            push = force * rows.gradients[a, d, c] + rows.weights[a, d] * drag[c]
            moves[i, c] += push * rows.soft[i, c]


@inlined
def _slides_along_guide(count, rows, size, pushes):
    """Find the forces of a row that is the only one to press, and whose coordinate supports let move along one axis
    only, in closed form; return whether it is such a row and slides. Otherwise nothing has changed.

    Where the coordinate is, and so its slip s, is decided by the row alone. Along the free component f, with N_0 the
    normal force without friction, N (n_f - mu s_f/|s|) = N_0 n_f: no sweeps are needed, which creep where the normal
    is almost across the guide.
    """
    a, free, pressing, moving = -1, -1, 0, 0
    for b in range(count):
        if pushes.normal[b] > 0.0:
            a, pressing = b, pressing + 1
    if pressing != 1 or not rows.friction[a, 0] > 0.0:
        return False
    soft = _softness(a, rows)
    for c in range(3):
        if soft[c] > 0.0:
            free, moving = c, moving + 1
    if moving != 1:
        return False
    n = vector(rows.normals, a)
    slip = _across(_slip_of(a, rows, pushes.moves), n)
    length = math.sqrt(dot(slip, slip))
    if not length > _SLIDES * size:
        return False
    helped = 1.0 - rows.friction[a, 0] * slip[free] / (length * n[free])
    if not helped > _SLIDES:
        return False
    pushes.normal[a] /= helped
    put(pushes.drag, a, times(-rows.friction[a, 0] * pushes.normal[a] / length, slip))
    return True


@inlined
def _part_of_the_way(count, rows):
    """Set the softness of all rows; return the part of the way that sweeps go.

    Where supports leave little of a normal free, drag moves the coordinate along its normal, or the normal force moves
    it across, r times as far as itself; sweeps overshoot for r >= 1 unless they are underrelaxed.
    """
    part = 1.0
    for a in range(count):
        largest, normal, square = 0.0, compliance(a, rows), 0.0
        if rows.friction[a, 1] > 0.0:
            soft = _softness(a, rows)
            largest = max(soft[0], soft[1], soft[2])
            for c in range(3):
                square += soft[c] * rows.normals[a, c] * soft[c] * rows.normals[a, c]
            ratio = rows.friction[a, 1] * math.sqrt(max(square - normal * normal, 0.0)) / normal
            if ratio > _OVERSHOOT:
                part = min(part, 1.0 / (1.0 + ratio))
        rows.gives[a, 0], rows.gives[a, 1] = largest, normal
    return part


@kernel
def settle_friction(count, rows, size, pushes):
    """Add friction to rows that press on the nodes.

    Parameters
    ----------
    count : number of rows; supports must let each of them move along its normal
    rows : RubbingRows
    size : largest coordinate of their nodes [m]
    pushes : Pushes without drag, by the normal forces alone; changed in place

    Returns
    -------
    bool
        Whether the sweeps have converged.
    """
    values, friction, gives = rows.values, rows.friction, rows.gives
    normal, drag, moves = pushes
    pressed, largest = False, 0.0
    for a in range(count):
        put(drag, a, NOWHERE)
        pressed = pressed or (normal[a] > 0.0 and friction[a, 1] > 0.0)
        largest = max(largest, normal[a])
    if not pressed or _slides_along_guide(count, rows, size, pushes):
        return True
    part = _part_of_the_way(count, rows)
    for sweep in range(_SWEEPS):
        settled, before, largest = True, largest, 0.0
        if sweep > 0 and sweep % _STEADY == 0:
            part *= 0.5
        for a in range(count):
            gap = values[a]
            for d in range(rows.ends.shape[1]):
                i = rows.ends[a, d]
                if i >= 0:
                    gap += dot(rows.gradients[a, d], moves[i])
            old = normal[a]
            change = max(0.0, old - gap / gives[a, 1]) - old
            if old == 0.0 and change == 0.0:
                continue
            # where supports leave little of a normal free, rounding is amplified in forces
            limit = _SETTLED * (before + size / gives[a, 1])
            settled = settled and abs(change) <= limit
            displace(a, part * change, NOWHERE, rows, moves)
            normal[a] = old + part * change
            largest = max(largest, normal[a])
            if friction[a, 1] == 0.0:
                continue
            # the force that would stop the slip, limited by Coulomb's law
            slip = _across(_slip_of(a, rows, moves), vector(rows.normals, a))
            goal = along(vector(drag, a), -1.0 / gives[a, 0], slip)
            needed, factor = math.sqrt(dot(goal, goal)), 1.0
            if needed > friction[a, 1 if sweep < _BROKEN else 0] * normal[a]:
                factor = friction[a, 0] * normal[a] / needed
            turn = minus(times(factor, goal), vector(drag, a))
            settled = settled and max(abs(turn[0]), abs(turn[1]), abs(turn[2])) <= limit
            add_to(drag, a, part, turn)
            displace(a, 0.0, times(part, turn), rows, moves)
        if settled:
            return True
    return False

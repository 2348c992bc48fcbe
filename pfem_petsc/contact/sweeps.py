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
    """Normal forces of rows (r,) and drags (r, 3) [N], and the displacements (n, 3) of the nodes by these [m]."""

    normal: np.ndarray
    drag: np.ndarray
    moves: np.ndarray


@inlined
def _soft_component(a, c, rows):
    """Return the displacement of a component of a row's coordinate by a unit force on it."""
    total = 0.0
    for d in range(rows.ends.shape[1]):
        i = rows.ends[a, d]
        if i >= 0:
            total += rows.weights[a, d] * rows.weights[a, d] * rows.soft[i, c]
    return total


@inlined
def slip_of(a, c, rows, moves):
    """Return a component of the relative displacement of a row in the step, along its normal and across."""
    total = rows.slips[a, c]
    for d in range(rows.ends.shape[1]):
        i = rows.ends[a, d]
        if i >= 0:
            total += rows.weights[a, d] * moves[i, c]
    return total


@inlined
def _slides_along_guide(count, rows, size, pushes):
    """Find the forces of a row that is the only one to press, and whose coordinate supports let move along one axis
    only, in closed form; return whether it is such a row and slides. Otherwise nothing has changed.

    Where the coordinate is, and so its slip s, is decided by the row alone. Along the free component f, with N_0 the
    normal force without friction, N (n_f - mu s_f/|s|) = N_0 n_f: no sweeps are needed, which creep where the normal
    is almost across the guide.
    """
    a, free = -1, -1
    for b in range(count):
        if pushes.normal[b] > 0.0:
            if a >= 0:
                return False
            a = b
    if a < 0 or not rows.friction[a, 0] > 0.0:
        return False
    for c in range(3):
        if _soft_component(a, c, rows) > 0.0:
            if free >= 0:
                return False
            free = c
    if free < 0:
        return False
    n, along, square = rows.normals[a], 0.0, 0.0
    for c in range(3):
        along += slip_of(a, c, rows, pushes.moves) * n[c]
    for c in range(3):
        slip = slip_of(a, c, rows, pushes.moves) - along * n[c]
        square += slip * slip
    length = math.sqrt(square)
    if not length > _SLIDES * size:
        return False
    helped = 1.0 - rows.friction[a, 0] * (slip_of(a, free, rows, pushes.moves) - along * n[free]) / (length * n[free])
    if not helped > _SLIDES:
        return False
    pushes.normal[a] /= helped
    for c in range(3):
        slip = slip_of(a, c, rows, pushes.moves) - along * n[c]
        pushes.drag[a, c] = -rows.friction[a, 0] * pushes.normal[a] * slip / length
    return True


@inlined
def _part_of_the_way(count, rows):
    """Set the softness of all rows; return the part of the way that sweeps go.

    Where supports leave little of a normal free, drag moves the coordinate along its normal, or the normal force moves
    it across, r times as far as itself; sweeps overshoot for r >= 1 unless they are underrelaxed.
    """
    part = 1.0
    for a in range(count):
        largest, normal, square = 0.0, 0.0, 0.0
        for d in range(rows.ends.shape[1]):
            i = rows.ends[a, d]
            if i >= 0:
                for c in range(3):
                    normal += rows.gradients[a, d, c] * rows.gradients[a, d, c] * rows.soft[i, c]
        if rows.friction[a, 1] > 0.0:
            for c in range(3):
                soft = _soft_component(a, c, rows)
                largest = max(largest, soft)
                square += soft * rows.normals[a, c] * soft * rows.normals[a, c]
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
    ends, weights, gradients, normals, values, _, friction, soft, gives = rows
    normal, drag, moves = pushes
    pressed, largest = False, 0.0
    for a in range(count):
        for c in range(3):
            drag[a, c] = 0.0
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
            for d in range(ends.shape[1]):
                i = ends[a, d]
                if i >= 0:
                    for c in range(3):
                        gap += gradients[a, d, c] * moves[i, c]
            old = normal[a]
            change = max(0.0, old - gap / gives[a, 1]) - old
            if old == 0.0 and change == 0.0:
                continue
            # where supports leave little of a normal free, rounding is amplified in forces
            limit = _SETTLED * (before + size / gives[a, 1])
            settled = settled and abs(change) <= limit
            change *= part
            for d in range(ends.shape[1]):
                i = ends[a, d]
                if i >= 0:
                    for c in range(3):
                        moves[i, c] += change * gradients[a, d, c] * soft[i, c]
            normal[a] = old + change
            largest = max(largest, normal[a])
            if friction[a, 1] == 0.0:
                continue
            # the force that would stop the slip, limited by Coulomb's law
            x, y, z = slip_of(a, 0, rows, moves), slip_of(a, 1, rows, moves), slip_of(a, 2, rows, moves)
            along = x * normals[a, 0] + y * normals[a, 1] + z * normals[a, 2]
            x = drag[a, 0] - (x - along * normals[a, 0]) / gives[a, 0]
            y = drag[a, 1] - (y - along * normals[a, 1]) / gives[a, 0]
            z = drag[a, 2] - (z - along * normals[a, 2]) / gives[a, 0]
            needed, factor = math.sqrt(x * x + y * y + z * z), 1.0
            if needed > friction[a, 1 if sweep < _BROKEN else 0] * normal[a]:
                factor = friction[a, 0] * normal[a] / needed
            for c in range(3):
                change = factor * (x if c == 0 else y if c == 1 else z) - drag[a, c]
                settled = settled and abs(change) <= limit
                change *= part
                drag[a, c] += change
                for d in range(ends.shape[1]):
                    i = ends[a, d]
                    if i >= 0:
                        moves[i, c] += weights[a, d] * change * soft[i, c]
        if settled:
            return True
    return False

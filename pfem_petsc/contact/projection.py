"""Exact solutions of small contact problems with friction: of a node at planes, and of the nodes of rows that share
nodes, with the planes at these, both as rows of a group.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..mechanics.compiled import NEEDED, inlined, kernel
from ..tolerances import FREE_PART, SINGULAR_ROW
from .rotations import NOWHERE, add_to, dot, free_components, minus, put, vector
from .sweeps import Pushes, RubbingRows, compliance, displace, settle_friction


@inlined
def _exchange(table, k):
    """Exchange unknown k and row k of a table (n, n + 1), which gives rows by unknowns and a constant: both are known
    by the others then."""
    pivot = table[k, k]
    for i in range(len(table)):
        if i != k:
            factor = table[i, k] / pivot
            for j in range(len(table) + 1):
                table[i, j] -= factor * table[k, j]
            table[i, k] = factor
    for j in range(len(table) + 1):
        table[k, j] /= -pivot
    table[k, k] = 1.0 / pivot


@kernel
def find_multipliers(matrix, values, tolerance, z):
    """Solve 0 <= z complementary to (matrix z + values) >= 0 for a positive semidefinite matrix (n, n), into z (n,);
    return False if there is no solution.

    Uses dual active sets, the most violated row first (D. Goldfarb, A. Idnani, Mathematical Programming 27, 1983). Rows
    violated by at most the tolerance count as satisfied.
    """
    n = len(values)
    held, table = np.zeros(n, dtype=np.bool_), np.empty((n, n + 1))
    # of held rows the multipliers, of others the values, by what of each is zero now
    table[:, :n], table[:, n], z[:] = matrix, values, 0.0
    for _ in range(10 * n + 10):
        row, least = -1, math.inf
        for i in range(n):
            left = 0.0 if held[i] else table[i, n]
            if left < least or left != left:
                row, least = i, left
        if n == 0 or least >= -tolerance:
            return True
        while not held[row]:
            # a unit of the new multiplier changes those of held rows, which stay satisfied, and lifts its row
            gain, out = table[row, row], -1
            full = part = math.inf
            if gain > SINGULAR_ROW * matrix[row, row]:
                full = -least / gain
            for a in range(n):
                if held[a] and table[a, row] < 0.0 and -z[a] / table[a, row] < part:
                    part, out = -z[a] / table[a, row], a
            step = min(full, part)
            if not step < math.inf:
                return False
            for a in range(n):
                z[a] = max(z[a] + step * table[a, row], 0.0) if held[a] else z[a]
            z[row] += step
            least += step * max(gain, 0.0)
            swapped = row if full <= part else out
            _exchange(table, swapped)
            held[swapped] = full <= part
        for a in range(n):
            z[a] = max(table[a, n], 0.0) if held[a] else 0.0
    return False


class Planes(NamedTuple):
    """Planes (w,) at nodes (m,).

    Attributes
    ----------
    normals : (m, w, 3) unit normals, towards the allowed side
    gaps : (m, w) distances of the nodes without contact from the planes [m], infinite where none applies
    friction, slips : (m, w, 2), (m, w, 3) see :class:`~pfem_petsc.contact.sweeps.RubbingRows`; (0, w, 2), (0, w, 3)
        without friction
    """

    normals: np.ndarray
    gaps: np.ndarray
    friction: np.ndarray
    slips: np.ndarray


class NodesAtPlanes(NamedTuple):
    """Nodes (m,): positions ``free`` (m, 3) without contact [m], ``fixed`` (m, 3) bool, components that supports
    prescribe, ``stiffness`` (m,), force for a displacement [N/m], and ``planes``, see :class:`Planes`."""

    free: np.ndarray
    fixed: np.ndarray
    stiffness: np.ndarray
    planes: Planes


class Pressed(NamedTuple):
    """Results for nodes (m,) at planes (w,): positions ``x`` (m, 3) [m], ``normal`` forces (m, w) and ``drag``
    (m, w, 3) by friction [N]."""

    x: np.ndarray
    normal: np.ndarray
    drag: np.ndarray


class Room(NamedTuple):
    """Room for the rows of a group: RubbingRows, Pushes, and which row or plane each is, ``slot`` (r,)."""

    rows: RubbingRows
    pushes: Pushes
    slot: np.ndarray


INFEASIBLE, JAMMED = 1, 2
"""Why a problem has no solution: no positions satisfy its rows, or its friction has none."""


@inlined
def new_room(size, width, soft, moves):
    """Return room for rows over ``width`` nodes each; ``soft``, ``moves``: (n, 3) of nodes."""
    vectors, numbers = np.zeros((3, size, 3)), np.zeros((2, size))
    ends, weights, gradients = np.full((size, width), -1), np.zeros((size, width)), np.zeros((size, width, 3))
    friction, gives = np.zeros((size, 2)), np.empty((size, 2))
    rows = RubbingRows(ends, weights, gradients, vectors[0], numbers[0], vectors[1], friction, soft, gives)
    return Room(rows, Pushes(numbers[1], vectors[2], moves), np.empty(size, np.int64))


@inlined
def new_pressed(m, w):
    """Return room for the results of nodes (m,) at planes (w,)."""
    return Pressed(np.empty((m, 3)), np.empty((m, w)), np.empty((m, w, 3)))


@inlined
def _add_planes(at, i, n, planes, room):
    """Add the planes of node ``at`` to ``n`` rows, in which it is the i-th node, if it can move along their normals;
    return how many there are then."""
    rows = room.rows
    for w in range(planes.gaps.shape[1]):
        if not planes.gaps[at, w] < math.inf:
            continue
        held = rows.soft[i, 0] == 0.0, rows.soft[i, 1] == 0.0, rows.soft[i, 2] == 0.0
        free = free_components(vector(planes.normals[at], w), held)
        put(rows.normals, n, vector(planes.normals[at], w))
        put(rows.gradients[n], 0, free)
        if not dot(free, free) > FREE_PART:
            continue
        rows.values[n], rows.weights[n, 0], room.slot[n] = planes.gaps[at, w], 1.0, w
        rows.ends[n, :], rows.ends[n, 0], rows.friction[n, :] = -1, i, 0.0
        if len(planes.friction) > 0:
            rows.friction[n, 0], rows.friction[n, 1] = planes.friction[at, w, 0], planes.friction[at, w, 1]
            put(rows.slips, n, vector(planes.slips[at], w))
        n += 1
    return n


@kernel
def _solve_several(n, rows, tolerances, pushes):
    """Find the normal forces of rows, and the displacements by these; return whether there are such forces."""
    gram, width = np.zeros((n, n)), rows.ends.shape[1]
    for a in range(n):
        for b in range(a, n):
            for d in range(width):
                i = rows.ends[a, d]
                for e in range(width if i >= 0 else 0):
                    if rows.ends[b, e] == i:
                        for c in range(3):
                            gram[a, b] += rows.gradients[a, d, c] * rows.gradients[b, e, c] * rows.soft[i, c]
            gram[b, a] = gram[a, b]
    values, normal = rows.values[:n], pushes.normal
    # planes through one point may lie beyond each other by rounding for ever, unless that is tolerated
    found = find_multipliers(gram, values, tolerances[0], normal)
    if not found and tolerances[0] < tolerances[1]:
        found = find_multipliers(gram, values, tolerances[1], normal)
    for a in range(n if found else 0):
        displace(a, normal[a], NOWHERE, rows, pushes.moves)
    return found


@inlined
def _solve_rows(n, rows, tolerances, size, pushes):
    """Find the forces of rows, and the displacements of their nodes, which are zero before, with friction.

    A row violated by at most the first of the ``tolerances`` counts as satisfied, or by at most the second where there
    is no solution otherwise; ``size``: largest coordinate [m]. Returns :data:`INFEASIBLE`, :data:`JAMMED`, or 0.
    """
    normal, drag, moves = pushes
    broken = False
    for a in range(n):
        normal[a], drag[a, :] = 0.0, 0.0
        broken = broken or not rows.values[a] >= 0.0
    if not broken:
        return 0
    if n == 1:
        normal[0] = -rows.values[0] / compliance(0, rows)
        displace(0, normal[0], NOWHERE, rows, moves)
    if (n == 1 and not normal[0] < math.inf) or (n > 1 and not _solve_several(n, rows, tolerances, pushes)):
        return INFEASIBLE
    return 0 if settle_friction(n, rows, size, pushes) else JAMMED


@inlined
def _press_single(j, nodes, tolerance, found):
    """Move the j-th node, which is ``found`` where it is free to move, onto the only plane that it is beyond, if it has
    no friction and all others remain satisfied; return whether that is so."""
    (normals, gaps, friction, _), broken, first = nodes.planes, 0, 0
    for k in range(gaps.shape[1]):
        if gaps[j, k] < 0.0:
            broken, first = broken + 1, k
    if broken != 1 or (len(friction) > 0 and friction[j, first, 1] > 0.0):
        return broken == 0
    free = free_components(vector(normals[j], first), nodes.fixed[j])
    if not dot(free, free) > FREE_PART:
        return False
    push, alone = -gaps[j, first] / dot(free, free), True
    add_to(found.x, j, push, free)
    moved = minus(vector(found.x, j), vector(nodes.free, j))
    for k in range(gaps.shape[1]):
        alone = alone and (k == first or gaps[j, k] + dot(vector(normals[j], k), moved) >= -tolerance)
    found.normal[j, first] = push * nodes.stiffness[j]
    return alone


@kernel
def press(which, nodes, tolerance, found, several):
    """Move :class:`NodesAtPlanes` to the nearest positions that satisfy all planes, and from there by friction.

    Each node is solved for by itself: its bits do not depend on the others.

    Parameters
    ----------
    which : (2,) the first of some nodes that are next to each other, and the end of these
    nodes : NodesAtPlanes
    tolerance : a plane violated by at most this counts as satisfied [m]
    found : Pressed, written for these nodes; those with infeasible planes are not moved
    several : ``NEEDED``, or None if there is a single plane, without friction

    Returns
    -------
    node, why : int
        First of the nodes without a solution, or -1; :data:`INFEASIBLE` or :data:`JAMMED`.
    """
    w, failed, reason = nodes.planes.gaps.shape[1], -1, 0
    room = new_room(w, 1, np.empty((1, 3)), np.empty((1, 3)))
    rows, pushes, slot = room
    first, last = which
    found.x[first:last], found.normal[first:last], found.drag[first:last] = nodes.free[first:last], 0.0, 0.0
    for j in range(first, last):
        if _press_single(j, nodes, tolerance, found) or several is None:
            continue
        x, soft = vector(nodes.free, j), 1.0 / nodes.stiffness[j]
        put(rows.soft, 0, free_components((soft, soft, soft), nodes.fixed[j]))
        put(pushes.moves, 0, NOWHERE)
        n = _add_planes(j, 0, 0, nodes.planes, room)
        why = _solve_rows(n, rows, (0.0, tolerance), abs(x[0]) + abs(x[1]) + abs(x[2]), pushes)
        if why > 0 and failed < 0:
            failed, reason = j, why
        found.normal[j, :] = 0.0
        put(found.x, j, x)
        if why != INFEASIBLE:
            add_to(found.x, j, 1.0, vector(pushes.moves, 0))
            for a in range(n):
                found.normal[j, slot[a]] = pushes.normal[a]
                put(found.drag[j], slot[a], vector(pushes.drag, a))
    return failed, reason


def pressed(nodes: NodesAtPlanes, tolerance: float) -> Pressed:
    """Return all nodes pressed, see :func:`press`."""
    found = new_pressed(*nodes.planes.gaps.shape)
    press((0, len(nodes.free)), nodes, tolerance, found, NEEDED)
    return found


@kernel
def project(x, fixed, normals, offsets, tolerance, multipliers):
    """Move nodes to the nearest position that satisfies all planes.

    Parameters
    ----------
    x : (m, 3) free positions [m], changed in place
    fixed : (m, 3) bool, prescribed components, which do not move
    normals : (m, w, 3) unit normals; offsets : (m, w) [m], -inf for a plane that does not apply
    tolerance : a plane violated by at most this counts as satisfied [m]
    multipliers : (m, w) output [m]: the node moves by the sum of multipliers times normals (free components)

    Returns
    -------
    int
        First node with infeasible planes, or -1.
    """
    m, w = offsets.shape
    gaps = np.empty((m, w))
    for j in range(m):
        for k in range(w):
            gaps[j, k] = dot(vector(normals[j], k), vector(x, j)) - offsets[j, k]
    planes = Planes(normals, gaps, np.empty((0, w, 2)), np.empty((0, w, 3)))
    nodes, found = NodesAtPlanes(x.copy(), fixed, np.ones(m), planes), Pressed(x, multipliers, np.empty((m, w, 3)))
    return press((0, m), nodes, tolerance, found, NEEDED)[0]


class Groups(NamedTuple):
    """Groups of rows that share nodes: group g has the rows[starts[g] : starts[g + 1]], and likewise the nodes."""

    starts: np.ndarray
    rows: np.ndarray
    node_starts: np.ndarray
    nodes: np.ndarray


class System(NamedTuple):
    """Rows and their nodes at free positions, as they are solved in groups.

    Attributes
    ----------
    rows : RubbingRows, with values that are infinite for rows that do not apply; their normals, and room, are empty
    plane : (n,) index of each node among those at walls (m,), -1 for none; planes : Planes of walls at these
    """

    rows: RubbingRows
    plane: np.ndarray
    planes: Planes


@inlined
def _add_rows(group, groups, system, room):
    """Begin the room with those rows of a group that can press; return how many there are."""
    every, rows, n = system.rows, room.rows, 0
    for q in range(groups.starts[group], groups.starts[group + 1]):
        r, square = groups.rows[q], 0.0
        for k in range(every.ends.shape[1]):
            i = every.ends[r, k]
            rows.ends[n, k], rows.weights[n, k] = i, every.weights[r, k]
            for c in range(3):
                gradient = every.gradients[r, k, c]
                rows.gradients[n, k, c] = gradient if i >= 0 and every.soft[i, c] > 0.0 else 0.0
                square += rows.gradients[n, k, c] * rows.gradients[n, k, c]
                if every.weights[r, k] != 0.0:
                    rows.normals[n, c] = gradient / every.weights[r, k]
        if square > FREE_PART and every.values[r] != math.inf:
            rows.values[n], room.slot[n] = every.values[r], r
            rows.friction[n, 0], rows.friction[n, 1] = every.friction[r, 0], every.friction[r, 1]
            put(rows.slips, n, vector(every.slips, r))
            n += 1
    return n


@kernel
def project_groups(which, groups, system, tolerances, size, pushes):
    """Solve for the forces of the rows of some groups (g,), and the displacements of their nodes, with their walls.

    Parameters
    ----------
    which, groups : (g,) numbers of these groups; Groups
    system : System
    tolerances : (groups,) a row violated by at most this counts as satisfied [m]
    size : largest coordinate [m]
    pushes : Pushes, output; written for these groups only

    Returns
    -------
    group, why : int
        First of the groups without a solution, or -1; :data:`INFEASIBLE` or :data:`JAMMED`.
    """
    most, walls = 0, system.planes.gaps.shape[1]
    for g in which:
        at_walls = walls * (groups.node_starts[g + 1] - groups.node_starts[g])
        most = max(most, groups.starts[g + 1] - groups.starts[g] + at_walls)
    room = new_room(most, system.rows.ends.shape[1], system.rows.soft, pushes.moves)
    for g in which:
        for q in range(groups.starts[g], groups.starts[g + 1]):
            pushes.normal[groups.rows[q]] = 0.0
            put(pushes.drag, groups.rows[q], NOWHERE)
        for q in range(groups.node_starts[g], groups.node_starts[g + 1]):
            put(pushes.moves, groups.nodes[q], NOWHERE)
        count = n = _add_rows(g, groups, system, room)
        for q in range(groups.node_starts[g], groups.node_starts[g + 1] if walls > 0 else 0):
            i = groups.nodes[q]
            if system.plane[i] >= 0:
                n = _add_planes(system.plane[i], i, n, system.planes, room)
        why = _solve_rows(n, room.rows, (tolerances[g], tolerances[g]), size, room.pushes)
        if why != 0:
            return g, why
        for a in range(count):
            pushes.normal[room.slot[a]] = room.pushes.normal[a]
            put(pushes.drag, room.slot[a], vector(room.pushes.drag, a))
    return -1, 0

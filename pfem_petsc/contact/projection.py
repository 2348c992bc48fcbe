"""Exact solutions of small contact problems: the nearest feasible point of a node, and that of the nodes of rows that
share nodes, both by one solver of complementarity problems.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..mechanics.compiled import NEEDED, inlined, kernel
from ..tolerances import FREE_PART, SINGULAR_ROW
from .sweeps import Pushes, RubbingRows, settle_friction


@kernel
def _solve_complementarity(matrix, rhs, n):
    """Solve the leading n x n system in place, by elimination with pivoting; return False if it is singular."""
    for k in range(n):
        pivot = k
        for i in range(k + 1, n):
            if abs(matrix[i, k]) > abs(matrix[pivot, k]):
                pivot = i
        if matrix[pivot, k] == 0.0:
            return False
        if pivot != k:
            for j in range(k, n):
                matrix[k, j], matrix[pivot, j] = matrix[pivot, j], matrix[k, j]
            rhs[k], rhs[pivot] = rhs[pivot], rhs[k]
        for i in range(k + 1, n):
            factor = matrix[i, k] / matrix[k, k]
            if factor != 0.0:
                for j in range(k + 1, n):
                    matrix[i, j] -= factor * matrix[k, j]
                rhs[i] -= factor * rhs[k]
    for k in range(n - 1, -1, -1):
        s = rhs[k]
        for j in range(k + 1, n):
            s -= matrix[k, j] * rhs[j]
        rhs[k] = s / matrix[k, k]
    return True


@kernel
def _active_system(matrix, active, count, system):
    for a in range(count):
        for b in range(count):
            system[a, b] = matrix[active[a], active[b]]


@kernel
def find_multipliers(matrix, values, tolerance, z):
    """Solve 0 <= z complementary to (matrix z + values) >= 0 for a positive semidefinite matrix (n, n), into z (n,);
    return False if there is no solution.

    Uses dual active sets, the most violated row first (D. Goldfarb, A. Idnani, Mathematical Programming 27, 1983). Rows
    violated by at most the tolerance count as satisfied.
    """
    n = len(values)
    active = np.empty(n, dtype=np.int64)
    held = np.zeros(n, dtype=np.bool_)
    system, lost = np.empty((n, n)), np.empty(n)
    count = np.int64(0)
    for i in range(n):
        z[i] = 0.0
    for _ in range(10 * n + 10):
        row = -1
        least = math.inf
        for i in range(n):
            left = values[i]
            for a in range(count):
                left += matrix[i, active[a]] * z[active[a]]
            if held[i]:
                left = 0.0
            if left < least or left != left:
                row, least = i, left
        if n == 0 or least >= -tolerance:
            return True
        while True:
            # with the active rows satisfied, a unit of the new multiplier reduces theirs by `lost` and lifts its row
            _active_system(matrix, active, count, system)
            for a in range(count):
                lost[a] = matrix[active[a], row]
            if not _solve_complementarity(system, lost, count):
                return False
            gain = matrix[row, row]
            for a in range(count):
                gain -= matrix[row, active[a]] * lost[a]
            full = -least / gain if gain > SINGULAR_ROW * matrix[row, row] else math.inf
            part = math.inf
            out = -1
            for a in range(count):
                if lost[a] > 0.0 and z[active[a]] / lost[a] < part:
                    part = z[active[a]] / lost[a]
                    out = a
            step = min(full, part)
            if not step < math.inf:
                return False
            for a in range(count):
                z[active[a]] -= step * lost[a]
            z[row] += step
            if full <= part:
                active[count] = row
                held[row] = True
                count += 1
                break
            least += step * max(gain, 0.0)
            z[active[out]] = 0.0
            held[active[out]] = False
            for a in range(out, count - 1):
                active[a] = active[a + 1]
            count -= 1
            for a in range(count):
                z[active[a]] = max(z[active[a]], 0.0)
        _active_system(matrix, active, count, system)
        for a in range(count):
            lost[a] = -values[active[a]]
        if not _solve_complementarity(system, lost, count):
            return False
        for a in range(count):
            z[active[a]] = max(lost[a], 0.0)
    return False


@kernel
def project(x, fixed, normals, offsets, tolerance, multipliers, several=NEEDED):
    """Move nodes to the nearest position that satisfies all planes.

    Parameters
    ----------
    x : (m, 3) free positions [m], changed in place
    fixed : (m, 3) bool, prescribed components, which do not move
    normals : (m, w, 3) unit normals; offsets : (m, w) [m], -inf for a plane that does not apply
    tolerance : a plane violated by at most this counts as satisfied [m]
    multipliers : (m, w) output [m]: the node moves by the sum of multipliers times normals (free components)
    several : ``NEEDED``, or None if w is 1

    Returns
    -------
    int
        First node with infeasible planes, or -1.
    """
    m, w = offsets.shape
    free = np.zeros((w, 3))
    gap = np.zeros(w)
    usable = np.zeros(w, dtype=np.bool_)
    move = np.zeros(3)
    infeasible = -1
    for i in range(m):
        count, first, n = 0, 0, 0
        for k in range(w):
            multipliers[i, k] = 0.0
            g = -offsets[i, k]
            length = 0.0
            for c in range(3):
                g += normals[i, k, c] * x[i, c]
                free[k, c] = 0.0 if fixed[i, c] else normals[i, k, c]
                length += free[k, c] * free[k, c]
            gap[k] = g
            usable[k] = length > FREE_PART and g < math.inf
            n += usable[k]
            if usable[k] and g < 0.0:
                first = k
                count += 1
        if count == 0:
            continue
        alone = False
        if count == 1:  # the common case: a single violated plane whose projection satisfies all others
            square = free[first, 0] * free[first, 0] + free[first, 1] * free[first, 1] + free[first, 2] * free[first, 2]
            multipliers[i, first] = -gap[first] / square
            alone = True
            for c in range(3):
                move[c] = multipliers[i, first] * free[first, c]
            for k in range(w):
                g = gap[k] + free[k, 0] * move[0] + free[k, 1] * move[1] + free[k, 2] * move[2]
                alone = alone and (k == first or not usable[k] or g >= -tolerance)
        if several is not None:  # noqa: SIM102 - what is not needed is not compiled
            if not alone:
                planes, values, z = np.flatnonzero(usable), np.empty(n), np.zeros(n)
                gram = np.empty((n, n))
                for a in range(n):
                    values[a] = gap[planes[a]]
                    for b in range(n):
                        gram[a, b] = 0.0
                        for c in range(3):
                            gram[a, b] += free[planes[a], c] * free[planes[b], c]
                # planes through one point may lie beyond each other by rounding for ever, unless that is tolerated
                if not find_multipliers(gram, values, 0.0, z) and not find_multipliers(gram, values, tolerance, z):
                    multipliers[i, first] = 0.0
                    if infeasible < 0:
                        infeasible = i
                    continue
                move[:] = 0.0
                multipliers[i, first] = 0.0
                for a in range(n):
                    multipliers[i, planes[a]] = z[a]
                    for c in range(3):
                        move[c] += z[a] * free[planes[a], c]
        for c in range(3):
            x[i, c] += move[c]
    return infeasible


class Groups(NamedTuple):
    """Groups of rows that share nodes: group g has the rows[starts[g] : starts[g + 1]], and likewise the nodes."""

    starts: np.ndarray
    rows: np.ndarray
    node_starts: np.ndarray
    nodes: np.ndarray


class System(NamedTuple):
    """Rows and their nodes at free positions.

    Attributes
    ----------
    ends, gradients : (r, k), (r, k, 3) nodes of each row, -1 for none, and its gradient there
    values : (r,) rows [m], infinite for rows that do not apply
    stiffness, free : (n,), (n, 3) of nodes: force for a displacement [N/m]; 0.0 where supports prescribe a component
    plane : (n,) index of each node among those at walls, -1 for none
    normals, gaps : (m, w, 3), (m, w) of walls at these nodes: distances [m], infinite where a wall does not apply
    weights, friction, slips : (r, k), (r, 2), (r, 3) of rows, see :class:`~pfem_petsc.contact.sweeps.RubbingRows`
    wall_friction, wall_slips : (m, w, 2), (m, w, 3), likewise; (0, w, 2), (0, w, 3) without friction
    """

    ends: np.ndarray
    gradients: np.ndarray
    values: np.ndarray
    stiffness: np.ndarray
    free: np.ndarray
    plane: np.ndarray
    normals: np.ndarray
    gaps: np.ndarray
    weights: np.ndarray
    friction: np.ndarray
    slips: np.ndarray
    wall_friction: np.ndarray
    wall_slips: np.ndarray


class RowPushes(NamedTuple):
    """Results for rows (r,) and nodes (n,): normal ``force`` (r,) and ``drag`` (r, 3) [N], displacements (n, 3) [m]."""

    force: np.ndarray
    drag: np.ndarray
    moves: np.ndarray


RUBS = 1
"""Why a group has no solution: its friction, and not its rows."""


@inlined
def _solve_single(group, groups, system, tolerance, pushes):
    """Solve a group of one row, if its walls remain satisfied and it does not rub; return whether they do."""
    ends, gradients, stiffness, free, gaps = system.ends, system.gradients, system.stiffness, system.free, system.gaps
    r, square, soft, width = groups.rows[groups.starts[group]], 0.0, 0.0, ends.shape[1]
    force, moves = pushes.force, pushes.moves
    for k in range(width):
        i = ends[r, k]
        if i >= 0:
            along = 0.0
            for c in range(3):
                part = gradients[r, k, c] * free[i, c]
                along += part * part
            square += along
            soft += 1.0 / stiffness[i] * along
    force[r] = -system.values[r] / soft if system.values[r] < 0.0 and square > FREE_PART else 0.0
    if not force[r] < math.inf or (force[r] > 0.0 and system.friction[r, 1] > 0.0):
        return False
    for k in range(width):
        i = ends[r, k]
        if i >= 0:
            push = force[r] / stiffness[i]
            for c in range(3):
                moves[i, c] = push * (gradients[r, k, c] * free[i, c])
    for q in range(groups.node_starts[group], groups.node_starts[group + 1] if gaps.shape[1] > 0 else 0):
        i = groups.nodes[q]
        at = system.plane[i]
        for w in range(gaps.shape[1] if at >= 0 else 0):
            gap, square = gaps[at, w], 0.0
            least = gap
            for c in range(3):
                part = system.normals[at, w, c] * free[i, c]
                square += part * part
                gap += part * moves[i, c]
            if not (least == math.inf or square <= FREE_PART or min(least, gap) >= -tolerance):
                return False
    return True


@inlined
def _gather_group(group, groups, system, soft):
    """Return the rows of a group that can press, with those of its walls, as :class:`RubbingRows`; the number of each
    among the rows of the system, or -1 (n,); and whether any rubs."""
    ends, gradients, values, _, free, plane, normals, gaps, weights, friction, slips, wall_friction, wall_slips = system
    begin, end = groups.starts[group], groups.starts[group + 1]
    first, last = groups.node_starts[group], groups.node_starts[group + 1]
    width, walls, size, n, rubs = ends.shape[1], gaps.shape[1], end - begin, 0, False
    for q in range(first, last if walls > 0 else first):
        size += walls if plane[groups.nodes[q]] >= 0 else 0
    rows = RubbingRows(
        np.full((size, width), -1),
        np.zeros((size, width)),
        np.zeros((size, width, 3)),
        np.zeros((size, 3)),
        np.empty(size),
        np.zeros((size, 3)),
        np.zeros((size, 2)),
        soft,
        np.empty((size, 2)),
    )
    row = np.full(size, -1)
    for q in range(begin, end):
        r, square = groups.rows[q], 0.0
        if not values[r] < math.inf and values[r] == values[r]:
            continue
        for k in range(width):
            i = ends[r, k]
            rows.ends[n, k], rows.weights[n, k] = i, weights[r, k]
            for c in range(3):
                rows.gradients[n, k, c] = gradients[r, k, c] * free[i, c] if i >= 0 else 0.0
                square += rows.gradients[n, k, c] * rows.gradients[n, k, c]
                if weights[r, k] != 0.0:
                    rows.normals[n, c] = gradients[r, k, c] / weights[r, k]
        if square > FREE_PART:
            rows.values[n], row[n] = values[r], r
            for c in range(3):
                rows.slips[n, c] = slips[r, c]
            rows.friction[n, 0], rows.friction[n, 1] = friction[r, 0], friction[r, 1]
            rubs = rubs or friction[r, 1] > 0.0
            n += 1
    for q in range(first, last if walls > 0 else first):
        i = groups.nodes[q]
        at = plane[i]
        for w in range(walls if at >= 0 else 0):
            if not gaps[at, w] < math.inf:
                continue
            square = 0.0
            for k in range(width):
                rows.ends[n, k] = i if k == 0 else -1
            row[n], rows.values[n], rows.weights[n, 0] = -1, gaps[at, w], 1.0
            for c in range(3):
                rows.normals[n, c] = normals[at, w, c]
                rows.gradients[n, 0, c] = normals[at, w, c] * free[i, c]
                square += rows.gradients[n, 0, c] * rows.gradients[n, 0, c]
            if len(wall_friction) > 0:
                rows.friction[n, 0], rows.friction[n, 1] = wall_friction[at, w, 0], wall_friction[at, w, 1]
                for c in range(3):
                    rows.slips[n, c] = wall_slips[at, w, c]
            if square > FREE_PART:
                rubs = rubs or rows.friction[n, 1] > 0.0
                n += 1
    return rows, row[:n], rubs


@kernel
def project_groups(which, groups, system, tolerances, size, pushes):
    """Solve for the forces of the rows of some groups (g,), and the displacements of their nodes, with their walls.

    Parameters
    ----------
    which, groups : (g,) numbers of these groups; Groups
    system : System
    tolerances : (groups,) a row violated by at most this counts as satisfied [m]
    size : largest coordinate [m]
    pushes : RowPushes, output; written for these groups only

    Returns
    -------
    group, why : int
        First of the groups without a solution, or -1; :data:`RUBS`, or 0 if its rows are infeasible.
    """
    stiffness, free, width = system.stiffness, system.free, system.ends.shape[1]
    soft = np.empty(free.shape)
    for group in which:
        begin, end = groups.starts[group], groups.starts[group + 1]
        for q in range(begin, end):
            r = groups.rows[q]
            pushes.force[r] = pushes.drag[r, 0] = pushes.drag[r, 1] = pushes.drag[r, 2] = 0.0
        if end - begin == 1 and _solve_single(group, groups, system, tolerances[group], pushes):
            continue
        for q in range(groups.node_starts[group], groups.node_starts[group + 1]):
            i = groups.nodes[q]
            for c in range(3):
                soft[i, c], pushes.moves[i, c] = free[i, c] / stiffness[i], 0.0
        rows, row, rubs = _gather_group(group, groups, system, soft)
        n = len(row)
        gram = np.zeros((n, n))
        for a in range(n):
            for b in range(a, n):
                s = 0.0
                for d in range(width):
                    i = rows.ends[a, d]
                    if i < 0:
                        continue
                    for e in range(width):
                        if rows.ends[b, e] == i:
                            for c in range(3):
                                s += rows.gradients[a, d, c] * rows.gradients[b, e, c] / stiffness[i]
                gram[a, b] = gram[b, a] = s
        z, drag = np.zeros(n), np.zeros((n, 3))
        if not find_multipliers(gram, rows.values[:n], tolerances[group], z):
            return group, 0
        for a in range(n):
            for k in range(width):
                i = rows.ends[a, k]
                if i >= 0:
                    for c in range(3):
                        pushes.moves[i, c] += z[a] * rows.gradients[a, k, c] / stiffness[i]
        if rubs and not settle_friction(n, rows, size, Pushes(z, drag, pushes.moves)):
            return group, RUBS
        for a in range(n):
            if row[a] >= 0:
                pushes.force[row[a]] = z[a]
                for c in range(3):
                    pushes.drag[row[a], c] = drag[a, c]
    return -1, 0

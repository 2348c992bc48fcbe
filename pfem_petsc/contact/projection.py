"""Exact solutions of small contact problems: the nearest feasible point of a node, and that of the nodes of rows that
share nodes, both by one solver of complementarity problems.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..mechanics.compiled import NEEDED, kernel
from ..tolerances import FREE_PART, SINGULAR_ROW


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
    """

    ends: np.ndarray
    gradients: np.ndarray
    values: np.ndarray
    stiffness: np.ndarray
    free: np.ndarray
    plane: np.ndarray
    normals: np.ndarray
    gaps: np.ndarray


@kernel
def project_groups(which, groups, system, tolerances, force, moves):
    """Solve for the forces of the rows of some groups (g,), and the displacements of their nodes, with their walls.

    Parameters
    ----------
    which, groups : (g,) numbers of these groups; Groups
    system : System
    tolerances : (groups,) a row violated by at most this counts as satisfied [m]
    force, moves : (r,), (n, 3) output [N], [m]; written for these groups only

    Returns
    -------
    int
        First of the groups with infeasible rows, else -1.
    """
    # each field of a record would count references
    ends, gradients, values, stiffness, free, plane, normals, gaps = system
    starts, members, node_starts, every_node = groups
    walls, width = gaps.shape[1], ends.shape[1]
    for group in which:
        tolerance = tolerances[group]
        begin, end, first, last = starts[group], starts[group + 1], node_starts[group], node_starts[group + 1]
        size = end - begin
        for q in range(first, last if walls > 0 else first):
            size += walls if plane[every_node[q]] >= 0 else 0
        if end - begin == 1:  # the common case: a single row, whose walls remain satisfied
            r = members[begin]
            square, soft = 0.0, 0.0
            for k in range(width):
                i = ends[r, k]
                if i >= 0:
                    along = 0.0
                    for c in range(3):
                        part = gradients[r, k, c] * free[i, c]
                        along += part * part
                    square += along
                    soft += 1.0 / stiffness[i] * along
            force[r] = -values[r] / soft if values[r] < 0.0 and square > FREE_PART else 0.0
            if not force[r] < math.inf:
                return group
            for k in range(width):
                i = ends[r, k]
                if i >= 0:
                    push = force[r] / stiffness[i]
                    for c in range(3):
                        moves[i, c] = push * (gradients[r, k, c] * free[i, c])
            fits = True
            for q in range(first, last if size > 1 else first):
                i = every_node[q]
                at = plane[i]
                for w in range(walls if at >= 0 else 0):
                    gap, square = gaps[at, w], 0.0
                    least = gap
                    for c in range(3):
                        part = normals[at, w, c] * free[i, c]
                        square += part * part
                        gap += part * moves[i, c]
                    fits = fits and (least == math.inf or square <= FREE_PART or min(least, gap) >= -tolerance)
            if fits:
                continue
        for q in range(first, last):
            i = every_node[q]
            moves[i, 0] = moves[i, 1] = moves[i, 2] = 0.0
        node, vector = np.full((size, width), -1), np.zeros((size, width, 3))
        value, row = np.empty(size), np.full(size, -1)
        n = 0
        for q in range(begin, end):
            r = members[q]
            force[r] = 0.0
            if not values[r] < math.inf and values[r] == values[r]:
                continue
            square = 0.0
            for k in range(width):
                i = ends[r, k]
                node[n, k] = i
                for c in range(3):
                    vector[n, k, c] = gradients[r, k, c] * free[i, c] if i >= 0 else 0.0
                    square += vector[n, k, c] * vector[n, k, c]
            if square > FREE_PART:
                value[n], row[n] = values[r], r
                n += 1
        for q in range(first, last):
            i = every_node[q]
            at = plane[i]
            for w in range(walls):
                if at < 0 or not gaps[at, w] < math.inf:
                    continue
                square = 0.0
                for k in range(width):
                    node[n, k] = -1
                node[n, 0], row[n], value[n] = i, -1, gaps[at, w]
                for c in range(3):
                    vector[n, 0, c] = normals[at, w, c] * free[i, c]
                    square += vector[n, 0, c] * vector[n, 0, c]
                if square > FREE_PART:
                    n += 1
        gram = np.zeros((n, n))
        for a in range(n):
            for b in range(a, n):
                s = 0.0
                for d in range(width):
                    i = node[a, d]
                    if i < 0:
                        continue
                    for e in range(width):
                        if node[b, e] == i:
                            for c in range(3):
                                s += vector[a, d, c] * vector[b, e, c] / stiffness[i]
                gram[a, b] = gram[b, a] = s
        z = np.zeros(n)
        if not find_multipliers(gram, value[:n], tolerance, z):
            return group
        for a in range(n):
            if row[a] >= 0:
                force[row[a]] = z[a]
            for k in range(width):
                i = node[a, k]
                if i >= 0:
                    for c in range(3):
                        moves[i, c] += z[a] * vector[a, k, c] / stiffness[i]
    return -1

"""Small complementarity problems of nodes that pairs, walls and supports couple.

One compiled loop solves the problems of all groups of pairs, one after the other; see
:mod:`~pfem_petsc.contact.coupled`.
"""

from __future__ import annotations

import math

import numpy as np

from ..mechanics.compiled import kernel
from ..tolerances import FREE_PART, SINGULAR_ROW

__all__ = ["complementary", "find_multipliers", "solve_groups"]


@kernel
def _solve(matrix, rhs, n):
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
    """See :func:`complementary`; return False if there is no solution."""
    n = len(values)
    active = np.empty(n, dtype=np.int64)
    held = np.zeros(n, dtype=np.bool_)
    system, lost = np.empty((n, n)), np.empty(n)
    count = 0
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
            if not _solve(system, lost, count):
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
        if not _solve(system, lost, count):
            return False
        for a in range(count):
            z[active[a]] = max(lost[a], 0.0)
    return False


def complementary(matrix: np.ndarray, values: np.ndarray, tolerance: float) -> np.ndarray | None:
    """Solve 0 <= z complementary to (matrix z + values) >= 0 for a positive semidefinite matrix (n, n).

    Uses dual active sets, the most violated row first (D. Goldfarb, A. Idnani, Mathematical Programming 27, 1983). Rows
    violated by at most the tolerance count as satisfied. Returns None if there is no solution.
    """
    z = np.zeros(len(values))
    return z if find_multipliers(np.ascontiguousarray(matrix), values, tolerance, z) else None


@kernel
def solve_groups(
    groups, starts, members, ends, pair_normals, least, x, stiffness, free, first_plane, planes, tolerance, force
):
    """Solve for the forces of the pairs of some groups, together with the walls at their nodes.

    Parameters
    ----------
    groups : (g,) indices of the groups
    starts, members : (groups + 1,), (p,) pairs of each group: members[starts[k] : starts[k + 1]]
    ends, pair_normals, least : (2, p), (p, 3), (p,) nodes, directions and bounds of pairs, -inf for pairs that do not
        apply
    x, stiffness, free : (n, 3), (n,), (n, 3) of nodes; ``free`` is 0.0 where supports prescribe
    first_plane : (n,) first row of a node among the planes, -1 for nodes of other groups
    planes : (normals (k, w, 3), offsets (k, w), stopped (n, w) bool), -inf where a wall is no concern; the last says
        which walls stop which nodes where several nodes have the same planes, (0, 0) where each has its own
    tolerance : a constraint broken by no more counts as kept
    force : (p,) out; written for these groups

    Returns
    -------
    int
        First of the groups with infeasible constraints, else -1.
    """
    normals, offsets, stopped = planes
    walls = offsets.shape[1]
    shared = len(stopped) > 0
    for group in groups:
        begin, end = starts[group], starts[group + 1]
        if end - begin == 1:  # the common case: a single pair whose own solution violates no wall
            p = members[begin]
            i, j = ends[0, p], ends[1, p]
            square, distance, soft_first, soft_second = 0.0, 0.0, 0.0, 0.0
            for c in range(3):
                back, forth = -pair_normals[p, c] * free[i, c], pair_normals[p, c] * free[j, c]
                square += back**2 + forth**2
                soft_first += back * back / stiffness[i]
                soft_second += forth * forth / stiffness[j]
                distance += pair_normals[p, c] * (x[j, c] - x[i, c])
            soft = soft_first + soft_second
            settled = square > FREE_PART and least[p] > -math.inf and soft > 0.0
            strength = 0.0
            if settled and distance - least[p] < -tolerance:
                strength = -(distance - least[p]) / soft
            for e in range(2):
                node_here = ends[e, p]
                at = first_plane[node_here]
                sign = -1.0 if e == 0 else 1.0
                for k in range(walls):
                    if not settled or offsets[at, k] == -math.inf or (shared and not stopped[node_here, k]):
                        continue
                    gap, along, wall_square = -offsets[at, k], 0.0, 0.0
                    for c in range(3):
                        gap += normals[at, k, c] * x[node_here, c]
                        part = normals[at, k, c] * free[node_here, c]
                        wall_square += part**2
                        along += part * sign * pair_normals[p, c] / stiffness[node_here]
                    broken = gap < -tolerance or gap + along * strength < -tolerance
                    if wall_square > FREE_PART and (broken or gap != gap):
                        settled = False
            if settled:
                force[p] = strength
                continue
        rows = (end - begin) * (1 + 2 * walls)
        node = np.full((rows, 2), -1)
        vector = np.zeros((rows, 2, 3))
        value = np.empty(rows)
        pair = np.full(rows, -1)
        n = 0
        for q in range(begin, end):
            p = members[q]
            force[p] = 0.0
            if least[p] == -math.inf:
                continue
            i, j = ends[0, p], ends[1, p]
            square, distance = 0.0, 0.0
            for c in range(3):
                vector[n, 0, c] = -pair_normals[p, c] * free[i, c]
                vector[n, 1, c] = pair_normals[p, c] * free[j, c]
                square += vector[n, 0, c] ** 2 + vector[n, 1, c] ** 2
                distance += pair_normals[p, c] * (x[j, c] - x[i, c])
            if square > FREE_PART:
                node[n, 0], node[n, 1] = i, j
                value[n] = distance - least[p]
                pair[n] = p
                n += 1
        for q in range(begin, end):
            for e in range(2):
                i = ends[e, members[q]]
                known = False
                for b in range(begin, q + 1):  # the walls of a node in several pairs enter once
                    for d in range(2):
                        if (b < q or d < e) and ends[d, members[b]] == i:
                            known = True
                if known or first_plane[i] < 0:
                    continue
                for k in range(walls):
                    at = first_plane[i]
                    if offsets[at, k] == -math.inf or (shared and not stopped[i, k]):
                        continue
                    square, distance = 0.0, 0.0
                    for c in range(3):
                        vector[n, 0, c] = normals[at, k, c] * free[i, c]
                        vector[n, 1, c] = 0.0
                        square += vector[n, 0, c] ** 2
                        distance += normals[at, k, c] * x[i, c]
                    if square > FREE_PART:
                        node[n, 0], node[n, 1] = i, -1
                        value[n] = distance - offsets[at, k]
                        pair[n] = -1
                        n += 1
        gram = np.zeros((n, n))
        for a in range(n):
            for b in range(a, n):
                s = 0.0
                for d in range(2):
                    for e in range(2):
                        if node[a, d] >= 0 and node[a, d] == node[b, e]:
                            hard = stiffness[node[a, d]]
                            for c in range(3):
                                s += vector[a, d, c] * vector[b, e, c] / hard
                gram[a, b] = gram[b, a] = s
        z = np.zeros(n)
        if not find_multipliers(gram, value[:n], tolerance, z):
            return group
        for a in range(n):
            if pair[a] >= 0:
                force[pair[a]] = z[a]
    return -1

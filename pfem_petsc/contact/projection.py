"""Exact solutions of small contact problems: the nearest feasible point of a node, and complementarity problems of
coupled nodes.
"""

from __future__ import annotations

import math

import numpy as np

from ..mechanics.compiled import kernel
from ..tolerances import FREE_PART, SINGULAR_ROW


@kernel
def _solve(gram, rhs, n, factor, out):
    """Solve the n x n (n <= 3) system by Cholesky factorisation; return False if it is not positive definite."""
    for i in range(n):
        for j in range(i + 1):
            s = gram[i, j]
            for k in range(j):
                s -= factor[i, k] * factor[j, k]
            if i == j:
                if s <= SINGULAR_ROW * gram[i, i]:
                    return False
                factor[i, i] = math.sqrt(s)
            else:
                factor[i, j] = s / factor[j, j]
    for i in range(n):
        s = rhs[i]
        for k in range(i):
            s -= factor[i, k] * out[k]
        out[i] = s / factor[i, i]
    for i in range(n - 1, -1, -1):
        s = out[i]
        for k in range(i + 1, n):
            s -= factor[k, i] * out[k]
        out[i] = s / factor[i, i]
    return True


@kernel
def _best_set(free, gap, among, count, tolerance, gram, rhs, factor, solution, chosen, multipliers, move):
    """Find the optimum for the planes ``among[:count]``; return the number of active planes, 0 if there is none.

    ``chosen`` and ``multipliers`` (3,) receive the active planes, ``move`` (3,) the displacement to the optimum.
    """
    best = math.inf
    found = 0
    active = np.zeros(3, dtype=np.int64)
    trial = np.zeros(3)
    for i in range(count):
        for j in range(i, count):
            for l in range(j, count):
                if j == i and l != j:
                    continue
                n = 1
                active[0] = among[i]
                if j > i:
                    active[1] = among[j]
                    n = 2
                    if l > j:
                        active[2] = among[l]
                        n = 3
                for p in range(n):
                    for q in range(n):
                        s = 0.0
                        for c in range(3):
                            s += free[active[p], c] * free[active[q], c]
                        gram[p, q] = s
                    rhs[p] = -gap[active[p]]
                if not _solve(gram, rhs, n, factor, solution):
                    continue
                usable = True
                for p in range(n):
                    if solution[p] < 0.0:
                        usable = False
                if not usable:
                    continue
                distance = 0.0
                for c in range(3):
                    trial[c] = 0.0
                    for p in range(n):
                        trial[c] += solution[p] * free[active[p], c]
                    distance += trial[c] * trial[c]
                if distance >= best:
                    continue
                for q in range(count):
                    k = among[q]
                    g = gap[k]
                    for c in range(3):
                        g += free[k, c] * trial[c]
                    if g < -tolerance:
                        usable = False
                if usable:
                    best = distance
                    found = n
                    for p in range(n):
                        chosen[p] = active[p]
                        multipliers[p] = solution[p]
                    for c in range(3):
                        move[c] = trial[c]
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
    free = np.zeros((w, 3))
    gap = np.zeros(w)
    usable = np.zeros(w, dtype=np.bool_)
    among = np.zeros(w, dtype=np.int64)
    gram = np.zeros((3, 3))
    factor = np.zeros((3, 3))
    rhs = np.zeros(3)
    solution = np.zeros(3)
    chosen = np.zeros(3, dtype=np.int64)
    strengths = np.zeros(3)
    move = np.zeros(3)
    infeasible = -1
    for i in range(m):
        count = 0
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
            if usable[k] and g < 0.0:
                among[count] = k
                count += 1
        found = 0
        if count == 1:  # the common case: a single violated plane whose projection satisfies all others
            k = among[0]
            square = free[k, 0] * free[k, 0] + free[k, 1] * free[k, 1] + free[k, 2] * free[k, 2]
            strengths[0] = -gap[k] / square
            chosen[0] = k
            for c in range(3):
                move[c] = strengths[0] * free[k, c]
            found = 1
            for q in range(w):
                g = gap[q] + free[q, 0] * move[0] + free[q, 1] * move[1] + free[q, 2] * move[2]
                if q != k and usable[q] and g < -tolerance:
                    found = 0
            if found == 1:
                count = 0
        while count > 0:
            found = _best_set(free, gap, among, count, tolerance, gram, rhs, factor, solution, chosen, strengths, move)
            if found == 0:
                if infeasible < 0:
                    infeasible = i
                break
            before = count
            for k in range(w):
                if not usable[k]:
                    continue
                g = gap[k]
                for c in range(3):
                    g += free[k, c] * move[c]
                if g < -tolerance:
                    known = False
                    for q in range(before):
                        known = known or among[q] == k
                    if not known:
                        among[count] = k
                        count += 1
            if count == before:
                break
        for p in range(found):
            multipliers[i, chosen[p]] = strengths[p]
        if found > 0:
            for c in range(3):
                x[i, c] += move[c]
    return infeasible


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

"""The explicit contact problem: one small problem per node, solved exactly.

With lumped mass, minimise |x - x_free|^2 subject to n_k . x >= d_k for the planes of the node's walls; the mass is the
same in all directions and drops out. The solution has an active set of at most three independent planes with
nonnegative multipliers and satisfies all other planes: 0 <= lambda complementary to N x - d >= 0. Projecting onto one
plane after the other would be wrong for oblique planes. Only planes that are violated during the search take part in
it: an optimum for these that satisfies all other planes is the optimum for all.
"""

from __future__ import annotations

import math

import numpy as np

from ..mechanics.compiled import kernel
from ..tolerances import FREE_PART, SINGULAR_ROW

__all__ = ["project"]


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

"""The explicit contact problem, one small problem a node, solved exactly.

With lumped mass, minimise |x - x_free|^2 subject to n_k . x >= d_k for the planes that the node's walls offer; the mass
is the same in all directions, so it drops out. The solution is the one active set of at most three independent planes
whose multipliers are not negative and whose point breaks no other plane: 0 <= lambda complementary to N x - d >= 0.
Clamping one plane after the other is wrong where planes are oblique.
"""

from __future__ import annotations

import math

import numpy as np

from ..mechanics.compiled import kernel

__all__ = ["project"]


@kernel
def _solve(gram, rhs, n, out):
    """Solve the n x n (n <= 3) symmetric positive system by Cholesky; False where it is not positive."""
    factor = np.zeros((3, 3))
    for i in range(n):
        for j in range(i + 1):
            s = gram[i, j]
            for k in range(j):
                s -= factor[i, k] * factor[j, k]
            if i == j:
                if s <= 1e-10 * gram[i, i]:
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
def project(x, fixed, normals, offsets, tolerance, multipliers):
    """Move nodes to the nearest position that breaks no plane.

    Parameters
    ----------
    x : (m, 3) free positions [m], changed in place
    fixed : (m, 3) bool, components that supports prescribe: they do not move
    normals : (m, w, 3) unit normals; offsets : (m, w) [m], -inf for a plane that does not concern the node
    tolerance : a plane broken by no more counts as kept [m]
    multipliers : (m, w) out [m]: the node moved by the sum of multipliers times normals (free components)

    Returns
    -------
    int
        First node for which no active set fits (contradicting planes), or -1.
    """
    m, w = offsets.shape
    free = np.zeros((w, 3))
    gap = np.zeros(w)
    active = np.zeros(3, dtype=np.int64)
    gram = np.zeros((3, 3))
    rhs = np.zeros(3)
    solution = np.zeros(3)
    trial = np.zeros(3)
    stuck = -1
    for i in range(m):
        broken = False
        for k in range(w):
            multipliers[i, k] = 0.0
            g = -offsets[i, k]
            for c in range(3):
                g += normals[i, k, c] * x[i, c]
                free[k, c] = 0.0 if fixed[i, c] else normals[i, k, c]
            gap[k] = g
            if g < 0.0:
                broken = True
        if not broken:
            continue
        best = math.inf
        found = 0
        found_set = np.zeros(3, dtype=np.int64)
        found_multipliers = np.zeros(3)
        # all subsets of one, two and three planes; -1 pads
        for first in range(w):
            for second in range(first, w):
                for third in range(second, w):
                    if second == first and third != second:
                        continue
                    n = 1
                    active[0] = first
                    if second > first:
                        active[1] = second
                        n = 2
                        if third > second:
                            active[2] = third
                            n = 3
                    usable = True
                    for p in range(n):
                        if not gap[active[p]] < math.inf:
                            usable = False
                        for q in range(n):
                            s = 0.0
                            for c in range(3):
                                s += free[active[p], c] * free[active[q], c]
                            gram[p, q] = s
                        if gram[p, p] < 1e-12:
                            usable = False
                        rhs[p] = -gap[active[p]]
                    if not usable or not _solve(gram, rhs, n, solution):
                        continue
                    for p in range(n):
                        if solution[p] < 0.0:
                            usable = False
                    if not usable:
                        continue
                    worst = 0.0
                    distance = 0.0
                    for c in range(3):
                        trial[c] = 0.0
                        for p in range(n):
                            trial[c] += solution[p] * free[active[p], c]
                        distance += trial[c] * trial[c]
                    for k in range(w):
                        g = gap[k]
                        length = 0.0
                        for c in range(3):
                            g += free[k, c] * trial[c]
                            length += free[k, c] * free[k, c]
                        if length > 1e-12 and g < worst:
                            worst = g
                    if worst < -tolerance:
                        continue
                    if distance < best:
                        best = distance
                        found = n
                        for p in range(n):
                            found_set[p] = active[p]
                            found_multipliers[p] = solution[p]
        if found == 0:
            if stuck < 0:
                stuck = i
            continue
        for p in range(found):
            multipliers[i, found_set[p]] = found_multipliers[p]
            for c in range(3):
                x[i, c] += found_multipliers[p] * free[found_set[p], c]
    return stuck

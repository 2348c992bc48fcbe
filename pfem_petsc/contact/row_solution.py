"""Complementarity problems of groups of rows over several nodes, with the walls at these nodes, one after the other.

A single row has a closed-form solution; others use the dual active-set method of
:mod:`~pfem_petsc.contact.complementarity`.
"""

from __future__ import annotations

import math

import numpy as np

from ..mechanics.compiled import kernel
from ..tolerances import FREE_PART
from .complementarity import find_multipliers

__all__ = ["solve_row_groups"]


@kernel
def solve_row_groups(
    groups, starts, rows, node_starts, nodes, ends, gradients, values, stiffness, free, planes, tolerances, force, moves
):
    """Solve for the forces of the rows of some groups and the displacements of their nodes, with their walls.

    Parameters
    ----------
    groups : (g,) which groups; starts, rows, node_starts, nodes :
        see :func:`~pfem_petsc.contact.row_loops.broken_groups`
    ends, gradients, values : (r, k), (r, k, 3), (r,) at the free positions; infinite for rows that do not apply
    stiffness, free : (n,), (n, 3) of nodes; ``free`` is 0.0 where supports prescribe
    planes : (first (n,), normals (m, w, 3), gaps (m, w)): index of a node among the planes, -1 for none, and distances
        from walls at the free positions, infinite where a wall does not apply
    tolerances : (groups,) a row violated by at most this counts as satisfied
    force, moves : (r,), (n, 3) output; written for these groups only

    Returns
    -------
    int
        First of the groups with infeasible rows, else -1.
    """
    first_plane, normals, gaps = planes
    walls = gaps.shape[1]
    width = ends.shape[1]
    for group in groups:
        begin, end = starts[group], starts[group + 1]
        tolerance = tolerances[group]
        n_walled = 0
        for q in range(node_starts[group], node_starts[group + 1]):
            i = nodes[q]
            for c in range(3):
                moves[i, c] = 0.0
            if first_plane[i] >= 0:
                for k in range(walls):
                    if gaps[first_plane[i], k] < math.inf:
                        n_walled += 1
        if end - begin == 1 and n_walled == 0:  # a single row
            r = rows[begin]
            force[r] = 0.0
            square, gram = 0.0, 0.0
            for k in range(width):
                i = ends[r, k]
                if i < 0:
                    continue
                for c in range(3):
                    part = gradients[r, k, c] * free[i, c]
                    square += part * part
                    gram += part * part / stiffness[i]
            if values[r] < math.inf and square > FREE_PART and not values[r] >= -tolerance:
                strength = -values[r] / gram
                if not strength < math.inf:
                    return group
                force[r] = strength
                for k in range(width):
                    i = ends[r, k]
                    if i < 0:
                        continue
                    for c in range(3):
                        moves[i, c] += strength * (gradients[r, k, c] * free[i, c]) / stiffness[i]
            continue
        size = end - begin + n_walled
        node, vector = np.full((size, width), -1), np.zeros((size, width, 3))
        value, row = np.empty(size), np.full(size, -1)
        n = 0
        for q in range(begin, end):
            r = rows[q]
            force[r] = 0.0
            square = 0.0
            if not values[r] < math.inf and values[r] == values[r]:
                continue
            for k in range(width):
                i = ends[r, k]
                node[n, k] = i
                for c in range(3):
                    vector[n, k, c] = gradients[r, k, c] * free[i, c] if i >= 0 else 0.0
                    square += vector[n, k, c] * vector[n, k, c]
            if square > FREE_PART:
                value[n], row[n] = values[r], r
                n += 1
        for q in range(node_starts[group], node_starts[group + 1]):
            i = nodes[q]
            at = first_plane[i]
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

"""Compiled loops over rows of several nodes and over the groups that hang together.

Rows are padded to the same number of nodes: ``ends`` (r, k) indices of nodes, negative for none.
"""

from __future__ import annotations

import math

import numpy as np

from ..mechanics.compiled import kernel
from ..tolerances import FREE_PART
from .complementarity import find_multipliers

__all__ = [
    "add_forces",
    "advance_groups",
    "broken_groups",
    "free_positions",
    "free_stiffness",
    "gather_rows",
    "group_rows",
    "last_forces",
    "leaving_nodes",
    "linearise",
    "mark_pressed",
    "push_nodes",
    "solve_row_groups",
]


@kernel
def _root(parent, i):
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@kernel
def group_rows(ends, n, label):
    """Label (n,) nodes with the lowest node that rows (r, k) join them to."""
    for i in range(n):
        label[i] = i
    for r in range(len(ends)):
        for k in range(1, ends.shape[1]):
            if ends[r, k] < 0:
                continue
            a, b = _root(label, ends[r, 0]), _root(label, ends[r, k])
            if a < b:
                label[b] = a
            else:
                label[a] = b
    for i in range(n):
        label[i] = _root(label, i)


@kernel
def leaving_nodes(rows, predictor, u, stiffness, start, leaving):
    """Put predictor + u and stiffness of owned nodes (m,) into ``leaving`` (m, 4...), and positions at the start, unless
    these are (0, 3)."""
    started = len(start) > 0
    for k in range(len(rows)):
        i = rows[k]
        for c in range(3):
            leaving[k, c] = predictor[i, c] + u[i, c]
            if started:
                leaving[k, 4 + c] = start[i, c]
        leaving[k, 3] = stiffness[i]


@kernel
def free_positions(where, predictor, u, far, x):
    """Positions x (n, 3) of nodes from predictor + u (owned, 3), and those that others own from ``far`` (m, 3 or more).

    ``where`` (n,): index of an owned node, else -1 less the row of ``far``.
    """
    for k in range(len(where)):
        i = where[k]
        for c in range(3):
            x[k, c] = predictor[i, c] + u[i, c] if i >= 0 else far[-1 - i, c]


@kernel
def free_stiffness(where, stiffness, far, hard):
    """The stiffness (n,) of the same nodes, from that of owned nodes (owned,) and ``far`` (m, 4 or more)."""
    for k in range(len(where)):
        hard[k] = stiffness[where[k]] if where[k] >= 0 else far[-1 - where[k], 3]


@kernel
def gather_rows(at, array, vectors):
    """Vectors (k, 3, r) of rows with nodes ``at`` (r, k) from those of nodes (n, 3)."""
    for r in range(len(at)):
        for k in range(at.shape[1]):
            i = at[r, k]
            for c in range(3):
                vectors[k, c, r] = array[i, c]


@kernel
def broken_groups(starts, rows, node_starts, nodes, values, x, near, tolerance, chosen, tolerances):
    """Mark groups with a row below its bound, or with nodes near walls; gives their number.

    Parameters
    ----------
    starts, rows, node_starts, nodes : rows and nodes of each group: rows[starts[g] : starts[g + 1]]
    values : (r,) rows; x : (n, 3) positions; near : (n,) bool, (0,) for none
    tolerance : a row broken by no more counts as kept, or by no more than rounding of the group's positions
    chosen, tolerances : (groups,) out; tolerances of chosen groups alone
    """
    count = 0
    walled = len(near) > 0
    for g in range(len(starts) - 1):
        broken = False
        for q in range(starts[g], starts[g + 1]):
            broken = broken or not values[rows[q]] >= -tolerance
        if walled and not broken:
            for q in range(node_starts[g], node_starts[g + 1]):
                broken = broken or near[nodes[q]]
        chosen[g] = broken
        if broken:
            largest = 0.0
            for q in range(node_starts[g], node_starts[g + 1]):
                for c in range(3):
                    largest = max(largest, abs(x[nodes[q], c]))
            tolerances[g] = max(tolerance, 16.0 * 2.0**-52 * largest)
            count += 1
    return count


@kernel
def solve_row_groups(
    groups, starts, rows, node_starts, nodes, ends, gradients, values, stiffness, free, planes, tolerances, force, moves
):
    """Forces of the rows of some groups, and how the nodes move, from the problems with their walls.

    Parameters
    ----------
    groups : (g,) which groups; starts, rows, node_starts, nodes : see :func:`broken_groups`
    ends, gradients, values : (r, k), (r, k, 3), (r,) at the free positions; infinite for rows that are no concern
    stiffness, free : (n,), (n, 3) of nodes; ``free`` is 0.0 where supports hold
    planes : (first (n,), normals (m, w, 3), gaps (m, w)): place of a node among the planes, -1 for none, and distances
        from walls at the free positions, infinite where a wall is no concern
    tolerances : (groups,) a row broken by no more counts as kept
    force, moves : (r,), (n, 3) out; written for these groups

    Returns
    -------
    int
        First of the groups whose rows contradict each other, else -1.
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
        if end - begin == 1 and n_walled == 0:  # a row on its own
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


@kernel
def advance_groups(groups, node_starts, nodes, x, moves, at, tolerances, settled):
    """Put nodes of groups (g,) to x + moves (n, 3) in ``at`` (n, 3), and tell in ``settled`` (g,) whether they were
    there already, to the tolerances (groups,)."""
    for k in range(len(groups)):
        g = groups[k]
        same = True
        for q in range(node_starts[g], node_starts[g + 1]):
            i = nodes[q]
            for c in range(3):
                place = x[i, c] + moves[i, c]
                same = same and abs(place - at[i, c]) <= tolerances[g]
                at[i, c] = place
        settled[k] = same


@kernel
def linearise(rows, ends, gradients, free, x, at, own, values):
    """Put ``own`` (m,) of some rows (m,) at positions ``at`` (n, 3), led on to ``x`` (n, 3), into ``values`` (r,)."""
    for k in range(len(rows)):
        r = rows[k]
        total = 0.0
        for e in range(ends.shape[1]):
            i = ends[r, e]
            if i >= 0:
                for c in range(3):
                    total += gradients[r, e, c] * free[i, c] * (x[i, c] - at[i, c])
        values[r] = own[k] + total


@kernel
def last_forces(counted, source, last, gradients, force, totals):
    """Add the forces of counted rows on their last nodes to the totals (sources, 3)."""
    for r in range(len(force)):
        if force[r] != 0.0 and counted[r]:
            for c in range(3):
                totals[source[r], c] += force[r] * gradients[r, last[r], c]


@kernel
def add_forces(ends, gradients, force, load):
    """Add the forces (r,) of rows to those on their nodes (n, 3)."""
    for r in range(len(force)):
        if force[r] == 0.0:
            continue
        for k in range(ends.shape[1]):
            i = ends[r, k]
            if i >= 0:
                for c in range(3):
                    load[i, c] += force[r] * gradients[r, k, c]


@kernel
def push_nodes(where, load, free, stiffness, u, contact):
    """Move owned nodes of u (owned, 3) by forces ``load`` (n, 3) of rows, and add these to ``contact`` (owned, 3)."""
    for k in range(len(where)):
        i = where[k]
        if i < 0:
            continue
        for c in range(3):
            if load[k, c] != 0.0:
                u[i, c] += load[k, c] * free[k, c] / stiffness[i]
                contact[i, c] += load[k, c]


@kernel
def mark_pressed(ends, where, force, held):
    """Mark owned nodes (owned,) on which rows press; gives how often."""
    count = 0
    for r in range(len(force)):
        if force[r] > 0.0:
            for k in range(ends.shape[1]):
                if ends[r, k] >= 0 and where[ends[r, k]] >= 0:
                    held[where[ends[r, k]]] = True
                    count += 1
    return count

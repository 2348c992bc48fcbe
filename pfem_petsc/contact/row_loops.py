"""Compiled loops over rows of several nodes and over groups of rows that share nodes.

Rows are padded to the same number of nodes: ``ends`` (r, k) indices of nodes, negative for none.
"""

from __future__ import annotations

from ..mechanics.compiled import kernel

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
]


@kernel
def _root(parent, i):
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@kernel
def group_rows(ends, n, label):
    """Label nodes (n,) with the lowest node to which rows (r, k) connect them."""
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
    """Write predictor + u and stiffness of owned nodes (m,) into ``leaving`` (m, 4...), and initial positions unless
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
    """Fill positions x (n, 3) from predictor + u (owned, 3), or from ``far`` (m, 3 or more) for nodes of other ranks.

    ``where`` (n,): index of an owned node, else -1 minus the row of ``far``.
    """
    for k in range(len(where)):
        i = where[k]
        for c in range(3):
            x[k, c] = predictor[i, c] + u[i, c] if i >= 0 else far[-1 - i, c]


@kernel
def free_stiffness(where, stiffness, far, hard):
    """Fill the stiffness (n,) of the same nodes from owned nodes (owned,) and ``far`` (m, 4 or more)."""
    for k in range(len(where)):
        hard[k] = stiffness[where[k]] if where[k] >= 0 else far[-1 - where[k], 3]


@kernel
def gather_rows(at, array, vectors):
    """Fill vectors (k, 3, r) of rows with nodes ``at`` (r, k) from those of nodes (n, 3)."""
    for r in range(len(at)):
        for k in range(at.shape[1]):
            i = at[r, k]
            for c in range(3):
                vectors[k, c, r] = array[i, c]


@kernel
def broken_groups(starts, rows, node_starts, nodes, values, x, near, tolerance, chosen, tolerances):
    """Mark groups with a row below its bound, or with nodes near walls; return their number.

    Parameters
    ----------
    starts, rows, node_starts, nodes : rows and nodes of each group: rows[starts[g] : starts[g + 1]]
    values : (r,) rows; x : (n, 3) positions; near : (n,) bool, (0,) for none
    tolerance : a row violated by at most this, or by rounding of the group's positions, counts as satisfied
    chosen, tolerances : (groups,) output; tolerances of chosen groups only
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
def advance_groups(groups, node_starts, nodes, x, moves, at, tolerances, settled):
    """Set nodes of groups (g,) to x + moves (n, 3) in ``at`` (n, 3), and set ``settled`` (g,) if they were there
    already, to the tolerances (groups,)."""
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
    """Write ``own`` of rows (m,) at positions ``at`` (n, 3), extrapolated to ``x`` (n, 3), into ``values`` (r,)."""
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
    """Mark owned nodes (owned,) with active rows; return the number of marks."""
    count = 0
    for r in range(len(force)):
        if force[r] > 0.0:
            for k in range(ends.shape[1]):
                if ends[r, k] >= 0 and where[ends[r, k]] >= 0:
                    held[where[ends[r, k]]] = True
                    count += 1
    return count

"""Compiled loops over the pairs of a rank.

An end i = where[e, p] is a node of this rank for i >= 0, else row -1 - i of arrays received from partners. Distances
are summed as (d_0 + d_2) + d_1, so that the values of a pair are bitwise equal on all ranks that have it.
"""

from __future__ import annotations

import math

import numpy as np

from ..mechanics.compiled import kernel

__all__ = [
    "broken_pairs",
    "compliances",
    "leaving_rows",
    "mark_nodes",
    "move_nodes",
    "needed_forces",
    "part_nodes",
    "pressed_nodes",
    "push_nodes",
    "table_forces",
]


@kernel
def part_nodes(where, x, u, stiffness, far, axes, normals, soft, least, free, held, force, load):
    """Move the nodes of pairs so that the bounds are satisfied; each node is in one pair only.

    Parameters
    ----------
    where : (2, p)
    x, u : (owned, 3); positions are their sum [m]; u is changed
    stiffness : (owned,) force for a displacement of a node [N/m]
    far : (partners, k) components ``axes`` of positions [m]
    axes : (k,) components in which any direction is not zero
    normals, soft, least : (p, 3); (p,) compliance, see :func:`compliances`; (p,) bounds [m]
    free, held : (2, p, 3) 0.0 where supports prescribe a component; (2, p) bool, ends with such components
    force : (p,) output, zero or positive [N]
    load : (owned, 3) to which the forces on nodes are added, unless it is (0, 3) [N]

    Returns
    -------
    int
        Number of pairs with a force.
    """
    count = 0
    loaded = len(load) > 0
    apart = np.zeros(3)
    for p in range(len(force)):
        # inlined by hand: a call that passes the arrays costs more than all the rest
        i, j = where[0, p], where[1, p]
        for k in range(len(axes)):
            c = axes[k]
            there = x[j, c] + u[j, c] if j >= 0 else far[-1 - j, k]
            here = x[i, c] + u[i, c] if i >= 0 else far[-1 - i, k]
            apart[c] = normals[p, c] * (there - here)
        short = least[p] - ((apart[0] + apart[2]) + apart[1])
        force[p] = 0.0
        if short <= 0.0 or not soft[p] > 0.0:
            continue
        force[p] = short / max(soft[p], 1e-300)
        count += 1
        for end in range(2):
            node = where[end, p]
            if node < 0:
                continue
            hard = stiffness[node]
            strength = force[p] if end == 1 else -force[p]
            for c in axes:
                push = strength * normals[p, c]
                if loaded:
                    load[node, c] += push
                if held[end, p]:
                    push *= free[end, p, c]
                u[node, c] += push / hard
    return count


@kernel
def compliances(where, stiffness, far, along, soft):
    """Compute the displacement ``soft`` (p,) by which a unit force parts each pair [m/N].

    ``stiffness`` (owned,), ``far`` (partners,) 1/stiffness; ``along`` (2, p) compliance factors of ends along the
    direction.
    """
    for p in range(len(soft)):
        i, j = where[0, p], where[1, p]
        soft[p] = (1.0 / stiffness[i] if i >= 0 else far[-1 - i]) * along[0, p]
        soft[p] += (1.0 / stiffness[j] if j >= 0 else far[-1 - j]) * along[1, p]


@kernel
def leaving_rows(rows, x, u, axes, leaving):
    """Write components ``axes`` (k,) of x + u (owned, 3) of the nodes that partners need into ``leaving`` (rows, k)."""
    for m in range(len(rows)):
        i = rows[m]
        for k in range(len(axes)):
            leaving[m, k] = x[i, axes[k]] + u[i, axes[k]]


@kernel
def needed_forces(where, x, stiffness, far, normals, along, least, force):
    """Compute forces of pairs that bring the distances at x (owned, 3) to bounds (p,), zero where these are -inf.

    As :func:`part_nodes`, but no node is moved, and ``force`` (p,) may be negative.
    """
    apart = np.empty(3)
    for p in range(len(force)):
        i, j = where[0, p], where[1, p]
        soft = (1.0 / stiffness[i] if i >= 0 else far[-1 - i, 3]) * along[0, p]
        soft += (1.0 / stiffness[j] if j >= 0 else far[-1 - j, 3]) * along[1, p]
        force[p] = 0.0
        if not (soft > 0.0 and least[p] > -math.inf):
            continue
        for c in range(3):
            there = x[j, c] if j >= 0 else far[-1 - j, c]
            here = x[i, c] if i >= 0 else far[-1 - i, c]
            apart[c] = normals[p, c] * (there - here)
        short = least[p] - ((apart[0] + apart[2]) + apart[1])
        force[p] = short / max(soft, 1e-300)


@kernel
def move_nodes(where, force, normals, free, held, stiffness, u, load):
    """Add displacements by forces (p,) to u (owned, 3), and the forces to ``load`` (owned, 3) unless it is (0, 3).

    ``free`` (2, p, 3) is 0.0 where supports prescribe a component; ``held`` (2, p) marks ends with such components.
    """
    loaded = len(load) > 0
    for end in range(2):
        sign = -1.0 if end == 0 else 1.0
        for p in range(len(force)):
            i = where[end, p]
            if i < 0 or force[p] == 0.0:
                continue
            hard = stiffness[i]
            strength = sign * force[p]
            for c in range(3):
                push = strength * normals[p, c]
                if loaded:
                    load[i, c] += push
                if held[end, p]:
                    push *= free[end, p, c]
                u[i, c] += push / hard


@kernel
def push_nodes(where, force, factor, normals, load):
    """Add the forces (p,) of pairs, times a factor, to those on nodes (owned, 3)."""
    for end in range(2):
        sign = -1.0 if end == 0 else 1.0
        for p in range(len(force)):
            i = where[end, p]
            push = factor * force[p]
            if i >= 0 and push != 0.0:
                for c in range(3):
                    load[i, c] += (sign * push) * normals[p, c]


@kernel
def pressed_nodes(where, force, normals, nodes, directions):
    """Write owned nodes of pairs in contact and the pairs' directions into the arrays; return their number."""
    count = 0
    for end in range(2):
        for p in range(len(force)):
            i = where[end, p]
            if i >= 0 and force[p] > 0.0:
                nodes[count] = i
                for c in range(3):
                    directions[count, c] = normals[p, c]
                count += 1
    return count


@kernel
def mark_nodes(where, force, held):
    """Mark owned nodes (owned,) that pairs press."""
    for end in range(2):
        for p in range(len(force)):
            if where[end, p] >= 0 and force[p] > 0.0:
                held[where[end, p]] = True


@kernel
def table_forces(where, table, force, normals, sums):
    """Sum the forces of the pairs of each table whose second node is owned, into (tables, 3)."""
    last = -1
    for p in range(len(force)):
        if where[1, p] < 0:
            continue
        k = table[p]
        for c in range(3):
            push = force[p] * normals[p, c]
            if k == last:
                sums[k, c] += push
            else:
                sums[k, c] = push
        last = k


@kernel
def broken_pairs(ends, x, least, normals, tolerance, broken):
    """Mark pairs of nodes ``ends`` (2, p) at x (n, 3) that violate their bounds (p,); return their number."""
    count = 0
    for p in range(len(least)):
        i, j = ends[0, p], ends[1, p]
        d0 = normals[p, 0] * (x[j, 0] - x[i, 0])
        d1 = normals[p, 1] * (x[j, 1] - x[i, 1])
        d2 = normals[p, 2] * (x[j, 2] - x[i, 2])
        broken[p] = least[p] - ((d0 + d2) + d1) > tolerance
        if broken[p]:
            count += 1
    return count

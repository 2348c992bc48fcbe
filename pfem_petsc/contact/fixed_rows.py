"""Rows over two nodes with a fixed direction, n . (x_2 - x_1) >= least, and the compiled loops over them."""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

import numpy as np

from ..mechanics.compiled import borrowing, kernel
from ..mesh.ordering import NODE_BLOCK


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


class FixedRows(NamedTuple):
    """The rows of a link with fixed directions (p rows, b blocks of nodes).

    Attributes
    ----------
    starts : (b + 1,) the first row of each block: rows are sorted by the block of their later node
    place : (p,) where the rows are, in the order of the link, which is that of sums; ``table_starts`` (tables + 1,) the
        first row of each table in this order
    ready : (b,) the block after which each block can be finished, ascending; (0,) if there are no rows
    near : (b,) bool, blocks with nodes of rows
    nodes, of, node_starts : (2 p,), (2 p,), (b + 1,) all nodes, ascending; their rows; the first node of each block
    where : (2, p) nodes
    normals, soft, least, axes, free, held : see :func:`~pfem_petsc.contact.fixed_rows.part_nodes`
    along : (2, p) compliance factors of the nodes along the direction
    totals : (tables, 3) room for the forces on the second nodes of each table [N]
    force, closed : (p,) forces [N]; bool, rows that have closed and not opened since; both are overwritten
    """

    starts: np.ndarray
    place: np.ndarray
    table_starts: np.ndarray
    ready: np.ndarray
    near: np.ndarray
    nodes: np.ndarray
    of: np.ndarray
    node_starts: np.ndarray
    where: np.ndarray
    normals: np.ndarray
    soft: np.ndarray
    least: np.ndarray
    axes: np.ndarray
    free: np.ndarray
    held: np.ndarray
    along: np.ndarray
    totals: np.ndarray
    force: np.ndarray
    closed: np.ndarray


def make_rows(
    where: np.ndarray,
    normals: np.ndarray,
    least: np.ndarray,
    axes: np.ndarray,
    free: np.ndarray,
    along: np.ndarray,
    table: np.ndarray,
    n_tables: int,
    stiffness: np.ndarray,
) -> FixedRows:
    """Return rows without forces; ``table`` (p,) of each row, ascending; ``stiffness`` (owned,) of the nodes [N/m];
    others see :class:`FixedRows`."""
    p, n_blocks = where.shape[1], -(-len(stiffness) // NODE_BLOCK)
    blocks = where // NODE_BLOCK
    later = blocks.max(axis=0)
    order = np.lexsort((where[0], later))
    place = np.empty(p, dtype=np.int64)
    place[order] = np.arange(p)
    numbers = np.arange(n_blocks + 1)
    ready = np.arange(n_blocks)
    for end in blocks:
        np.maximum.at(ready, end, later)
    where = np.ascontiguousarray(where[:, order])
    at = np.argsort(where.ravel(), kind="stable")
    nodes = where.ravel()[at]
    near = np.zeros(n_blocks, dtype=bool)
    near[blocks] = True
    free, along, soft = (
        np.ascontiguousarray(free[:, order]),
        np.ascontiguousarray(along[:, order]),
        np.empty(p),
    )
    compliances(where, stiffness, np.empty(0), along, soft)
    return FixedRows(
        np.searchsorted(later[order], numbers),
        place,
        np.searchsorted(table, np.arange(n_tables + 1)),
        np.maximum.accumulate(ready) if p else np.empty(0, dtype=np.int64),
        near,
        nodes,
        at % max(p, 1),
        np.searchsorted(nodes, NODE_BLOCK * numbers),
        where,
        normals[order],
        soft,
        least[order],
        axes.copy(),
        free,
        (free == 0.0).any(axis=2),
        along,
        np.zeros((n_tables, 3)),
        np.zeros(p),
        np.zeros(p, dtype=bool),
    )


class RowLender(Protocol):
    """Lends rows to loops over many steps."""

    def lend_rows(self, stiffness: np.ndarray) -> FixedRows:
        """Return the rows with their present forces; ``stiffness`` (owned,) is the force for a displacement of a node
        [N/m], the same array as long as its values stay the same."""

    def take_rows(self, rows: FixedRows) -> None:
        """Take the forces after the last of the steps from rows that were lent."""


class NoRows:
    """The :class:`RowLender` of a case without links."""

    def lend_rows(self, stiffness: np.ndarray) -> FixedRows:
        """See :class:`RowLender`."""
        none, whole = np.empty(0), np.empty(0, dtype=np.int64)
        ends = np.empty((2, 0), dtype=np.int64)
        return make_rows(ends, np.empty((0, 3)), none, whole, np.empty((2, 0, 3)), np.empty((2, 0)), whole, 0, none)

    def take_rows(self, rows: FixedRows) -> None:
        """Nothing."""


@borrowing
def solve_rows(block, rows, x, h, half, mass, damping, alpha, eta, u, contact):
    """Solve the rows whose later node is in a block, as :func:`~pfem_petsc.contact.fixed_rows.part_nodes` does.

    ``x``, ``half`` (n, 3): positions and velocities at half steps, to which increments ``u`` (n, 3) are added;
    ``contact`` (n, 3) [N] is written, and zero at nodes of rows without a force. Returns the number of rows with a
    force, and of rows whose force begins or ends with respect to ``rows.closed``.
    """
    where, normals, axes, force = rows.where, rows.normals, rows.axes, rows.force
    damped = len(damping) > 0
    count, changed = 0, 0
    for p in range(rows.starts[block], rows.starts[block + 1]):
        i, j = where[0, p], where[1, p]
        d0 = d1 = d2 = 0.0
        for m in range(len(axes)):
            c = axes[m]
            there = (x[j, c] + h * half[j, c]) + u[j, c]
            here = (x[i, c] + h * half[i, c]) + u[i, c]
            d = normals[p, c] * (there - here)
            if c == 0:
                d0 = d
            elif c == 1:
                d1 = d
            else:
                d2 = d
        short = rows.least[p] - ((d0 + d2) + d1)
        before = force[p]
        if short <= 0.0 or not rows.soft[p] > 0.0:
            if before != 0.0:
                force[p] = 0.0
                for c in range(3):
                    contact[i, c] = contact[j, c] = 0.0
            if rows.closed[p]:
                changed += 1
            continue
        push = short / max(rows.soft[p], 1e-300)
        force[p] = push
        count += 1
        if not rows.closed[p]:
            changed += 1
        for end in range(2):
            node = where[end, p]
            hard = alpha * mass[node] + (eta * damping[node] if damped else 0.0)
            strength = push if end == 1 else -push
            for m in range(len(axes)):
                c = axes[m]
                part = strength * normals[p, c]
                contact[node, c] = part
                if rows.held[end, p]:
                    part *= rows.free[end, p, c]
                u[node, c] += part / hard
    return count, changed


@kernel
def close_rows(at, ends, normals, least, along, counted, slack, force, closed):
    """Return the energy [J] that closing rows lose, see :mod:`pfem_petsc.contact.impact`.

    Parameters
    ----------
    at : (m,) rows whose force begins or ends
    ends : (2, m, 10) position, velocity and acceleration without contact, and mass of their nodes
    normals, least, along, force : of all rows, see :class:`FixedRows`
    counted : (p,) bool, rows whose energy this rank counts
    slack : distance at which a row has opened [m]
    closed : (p,) bool, updated
    """
    energy = 0.0
    parts = np.empty(3)
    for m in range(len(at)):
        p = at[m]
        for k in range(3):
            d0 = normals[p, 0] * (ends[1, m, 3 * k] - ends[0, m, 3 * k])
            d1 = normals[p, 1] * (ends[1, m, 3 * k + 1] - ends[0, m, 3 * k + 1])
            d2 = normals[p, 2] * (ends[1, m, 3 * k + 2] - ends[0, m, 3 * k + 2])
            parts[k] = (d0 + d2) + d1
        distance, speed, pull = parts[0] - least[p], parts[1], parts[2]
        fresh = force[p] > 0.0
        closed[p] = fresh or distance <= slack
        if fresh and speed < 0.0 and counted[p]:
            square = max(speed * speed - 2.0 * pull * max(distance, 0.0), 0.0)
            gives = along[0, p] / ends[0, m, 9] + along[1, p] / ends[1, m, 9]
            energy += 0.5 * square / max(gives, 1e-300)
    return energy

"""Rows over two nodes with a fixed direction, n . (x_2 - x_1) >= least, for compiled loops over many steps.

No node is in two rows, no wall stops a node of a row, and this rank owns all of their nodes. Each row is then a problem
of its own, see :mod:`pfem_petsc.contact.pairs`, and can be solved as soon as the free positions of both nodes are
known. Loops that pass through blocks of nodes solve rows after the block of the later node; a block can be finished
when all rows of its nodes, and all blocks before, are solved.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from ..mechanics.compiled import borrowing, kernel
from ..mesh.ordering import NODE_BLOCK
from .pair_loops import compliances

__all__ = ["FixedRows", "NoRows", "RowLender", "close_rows", "make_rows", "solve_rows"]


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
    normals, soft, least, axes, free, held : see :func:`~pfem_petsc.contact.pair_loops.part_nodes`
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
    """Solve the rows whose later node is in a block, as :func:`~pfem_petsc.contact.pair_loops.part_nodes` does.

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

"""Rows between nodes in the fused loop: blocks of nodes wait for the rows of their nodes before they are finished.

Arguments are those of :mod:`~pfem_petsc.stepping.fused_blocks`; ``rows`` are a
:class:`~pfem_petsc.contact.fixed_rows.FixedRows`. Blocks are finished in their order, so that sums are those of single
steps.
"""

from __future__ import annotations

import numpy as np

from ..contact.fixed_rows import close_rows, solve_rows
from ..contact.impact_loops import unpressed
from ..integrators._leapfrog import centre
from ..mechanics.compiled import borrowing, kernel
from ..mesh.ordering import NODE_BLOCK
from .balance_loops import CONTACT
from .book_loops import LANES
from .fused_blocks import advance_block, finish_block, solve_block
from .node_loops import accelerations

__all__ = ["finish_rows", "pass_block", "sum_rows"]


@borrowing
def pass_block(block, finished, pressing, rows, alone, nodes, shared, f, u, contact):
    """Solve a block and the rows of its nodes whose other node is in it or in a block before; finish all blocks that
    wait for no other rows.

    ``alone`` (blocks,) bool: whether forces alone determine the increments of a block. ``finished`` blocks were
    finished before, ``pressing`` rows have a force. Returns both numbers, and that of rows whose force begins or ends.
    """
    n = len(shared.half)
    if not alone[block]:
        first = NODE_BLOCK * block
        last = min(first + NODE_BLOCK, n)
        solve_block(block, nodes, shared, f, 0, shared.speeds[: 3 * (last - first)], u[first:last].reshape(-1))
    count, changed = solve_rows(
        block, rows, shared.x, shared.h, shared.half, nodes.mass, nodes.damping, shared.alpha, shared.eta, u, contact
    )
    pressing += count
    while finished < len(rows.ready) and rows.ready[finished] <= block:
        if alone[finished]:
            advance_block(finished, nodes, shared, f, 0)
        else:
            first = NODE_BLOCK * finished
            last = min(first + NODE_BLOCK, n)
            finish_block(finished, nodes, shared, f, 0, contact, u[first:last].reshape(-1))
            if pressing > 0:
                _add_pushes(finished, rows, contact, shared.speeds, shared.lanes[CONTACT])
        finished += 1
    return finished, pressing, changed


@borrowing
def _add_pushes(block, rows, contact, speeds, sums):
    """Add the powers of the rows' forces on the nodes of a block with velocities ``speeds`` (3 m,) to ``sums``."""
    first = NODE_BLOCK * block
    for k in range(rows.node_starts[block], rows.node_starts[block + 1]):
        if rows.force[rows.of[k]] > 0.0:
            i = rows.nodes[k]
            at, place = 3 * (i % LANES), 3 * (i - first)
            for c in range(3):
                sums[at + c] += contact[i, c] * speeds[place + c]


@kernel
def sum_rows(rows, pressing):
    """Write the forces on the second nodes of each table to ``rows.totals``, as
    :func:`~pfem_petsc.contact.pair_loops.table_forces` does; ``pressing`` rows have a force."""
    force, normals, place = rows.force, rows.normals, rows.place
    for k in range(len(rows.totals)):
        x = y = z = 0.0
        if pressing > 0:
            for j in range(rows.table_starts[k], rows.table_starts[k + 1]):
                p = place[j]
                x += force[p] * normals[p, 0]
                y += force[p] * normals[p, 1]
                z += force[p] * normals[p, 2]
        rows.totals[k, 0], rows.totals[k, 1], rows.totals[k, 2] = x, y, z


@kernel
def finish_rows(rows, changed, slack, x, half, nodes, alpha, eta, u, v, a, contact):
    """Return the dissipation [J] of rows that close; ``changed`` rows have a force that begins or ends.

    ``v`` and ``a`` are written at their nodes.
    """
    where, force, closed = rows.where, rows.force, rows.closed
    at, count = np.empty(changed, dtype=np.int64), 0
    ends = np.empty((2, changed, 10))
    for p in rows.place:
        if (force[p] > 0.0) != closed[p]:
            at[count] = p
            count += 1
    for end in range(2):
        around = where[end][at]
        for i in around:
            centre(u[i], eta, half[i], v[i])
            accelerations(u[i], alpha, a[i])
        free_v, free_a = unpressed(around, v, a, contact, nodes.mass, nodes.damping, alpha, eta)
        for m in range(count):
            i = around[m]
            ends[end, m, 9] = nodes.mass[i]
            for c in range(3):
                # rows do not change prescribed components
                fixed = rows.free[end, at[m], c] == 0.0
                ends[end, m, c] = x[i, c]
                ends[end, m, 3 + c] = v[i, c] if fixed else free_v[m, c]
                ends[end, m, 6 + c] = a[i, c] if fixed else free_a[m, c]
    counted = np.ones(len(force), dtype=np.bool_)
    return close_rows(at, ends, rows.normals, rows.least, rows.along, counted, slack, force, closed)

"""Compiled loops that sum the coarse matrix of multigrid over boxes, see :mod:`~pfem_petsc.solvers.grid_matrix`."""

from __future__ import annotations

import numpy as np

from ..mechanics.compiled import inlined, kernel
from .grid_kernels import corner_weights

__all__ = ["arrange", "assemble", "neighbours", "stabilise"]


@kernel
def neighbours(corners, starts, elements, ptr, columns):
    """Write the neighbours of each corner in its elements, ascending; return their number."""
    seen = np.full(len(starts) - 1, -1, np.int32)
    count = 0
    for row in range(len(starts) - 1):
        first = count
        for at in range(starts[row], starts[row + 1]):
            for column in corners[elements[at]]:
                if column >= 0 and seen[column] != row:
                    seen[column] = row
                    if len(columns) > 0:
                        columns[count] = column
                    count += 1
        ptr[row + 1] = count
        if len(columns) > 0:
            columns[first:count].sort()
    return count


@inlined
def _add_square(v, factor, n, dense):
    """Add factor v v^T."""
    for i in range(n):
        scaled = factor * v[i]
        if scaled != 0.0:
            for j in range(n):
                dense[i, j] += scaled * v[j]


@inlined
def _flush(corners, element, m, dense, ptr, columns, blocks):
    """Add the dense matrix of an element to the blocks, and clear it."""
    for i in range(m):
        row = corners[element, i]
        low, high = ptr[row], ptr[row + 1]
        for j in range(m):
            at = low + np.searchsorted(columns[low:high], corners[element, j])
            for p in range(3):
                for q in range(3):
                    blocks[at, p, q] += dense[3 * i + p, 3 * j + q]
                    dense[3 * i + p, 3 * j + q] = 0.0


@inlined
def _turned_difference(difference, a, b, direction, place, turned, w, m, v):
    """Write to ``v`` how a component of the end difference of a bar depends on the corners."""
    for i in range(3 * m):
        v[i] = 0.0
    for end in range(2):
        node = b if end else a
        at = place[node]
        for q in range(3):
            part = 0.0
            for p in range(3):
                along = difference[p] if direction == 3 else (1.0 if p == direction else 0.0)
                part += along * (turned[at, p, q] if at >= 0 else (1.0 if p == q else 0.0))
            if end == 0:
                part = -part
            for i in range(m):
                v[3 * i + q] += part * w[end, i]


@inlined
def _add_turned_node(extra, nodal, turn, w, dense):
    """Add the inertia and further stiffness of a node with a matrix."""
    inner = np.zeros((3, 3))
    for p in range(3):
        for q in range(3):
            for i in range(3):
                for j in range(3):
                    inner[p, q] += turn[i, p] * (extra[i, j] + (nodal if i == j else 0.0)) * turn[j, q]
    for i in range(8):
        for j in range(8):
            for p in range(3):
                for q in range(3):
                    dense[3 * i + p, 3 * j + q] += w[i] * w[j] * inner[p, q]


@kernel
def assemble(
    t, base, boxes, corners, bar_order, bar_starts, ends, x, stored, node_order, node_starts, nodal, extra, place,
    turned, ptr, columns, blocks
):  # fmt: skip
    """Add everything to ``blocks``.

    ``place`` (local,): of nodes among those with matrices ``turned`` (k, 3, 3), -1 for others; ``nodal`` (owned,)
    inertia; ``extra`` (k, 3, 3) further stiffness of these nodes.
    """
    dense = np.zeros((48, 48))
    same = np.zeros((16, 16))
    d = np.zeros(16)
    w = np.zeros((2, 16))
    v = np.zeros(48)
    difference = np.zeros(3)
    for element in range(len(boxes)):
        m = 8 if boxes[element, 1] < 0 else 16
        for k in range(bar_starts[element], bar_starts[element + 1]):
            bar = bar_order[k]
            c, g = stored[0, bar], stored[1, bar]
            if c == 0.0 and g == 0.0:
                continue
            a, b = ends[bar, 0], ends[bar, 1]
            w[:] = 0.0
            if m == 8:
                corner_weights(t, a, base, boxes[element, 0], w[0], 0)
                corner_weights(t, b, base, boxes[element, 0], w[1], 0)
            else:
                first = 0 if _is_inside(t, a, base, boxes[element, 0]) else 1
                if first == 0 and not _is_inside(t, b, base, boxes[element, 1]):
                    first = 1
                corner_weights(t, a, base, boxes[element, first], w[0], 8 * first)
                corner_weights(t, b, base, boxes[element, 1 - first], w[1], 8 - 8 * first)
            difference[0] = x[b, 0] - x[a, 0]
            difference[1] = x[b, 1] - x[a, 1]
            difference[2] = x[b, 2] - x[a, 2]
            if place[a] < 0 and place[b] < 0:
                for i in range(m):
                    d[i] = w[1, i] - w[0, i]
                    v[3 * i] = d[i] * difference[0]
                    v[3 * i + 1] = d[i] * difference[1]
                    v[3 * i + 2] = d[i] * difference[2]
                _add_square(v, c, 3 * m, dense)
                if g != 0.0:
                    _add_square(d, g, m, same)
                continue
            # in the three directions of space with g, and along the bar with c
            for direction in range(4):
                _turned_difference(difference, a, b, direction, place, turned, w, m, v)
                _add_square(v, c if direction == 3 else g, 3 * m, dense)
        for k in range(node_starts[element], node_starts[element + 1]):
            node = node_order[k]
            w[:] = 0.0
            corner_weights(t, node, base, boxes[element, 0], w[0], 0)
            if place[node] < 0:
                _add_square(w[0], nodal[node], m, same)
                continue
            _add_turned_node(extra[place[node]], nodal[node], turned[place[node]], w[0], dense)
        for i in range(m):
            for j in range(m):
                for p in range(3):
                    dense[3 * i + p, 3 * j + p] += same[i, j]
                same[i, j] = 0.0
        _flush(corners, element, m, dense, ptr, columns, blocks)


@inlined
def _is_inside(t, node, base, box):
    for i in range(3):
        part = t[node, i] - base[box, i]
        if part < 0.0 or part > 1.0:
            return False
    return True


@kernel
def arrange(blocks, slots, ptr, row_of, values):
    """Write blocks (n, 3, 3) to the values in scalar compressed rows, each at its slot."""
    for k in range(len(slots)):
        slot = slots[k]
        row = row_of[slot]
        width = 3 * (ptr[row + 1] - ptr[row])
        at = 6 * ptr[row] + 3 * slot
        for i in range(3):
            for j in range(3):
                values[at + i * width + j] += blocks[k, i, j]


@kernel
def stabilise(ptr, diagonal, shift, values):
    """Add ``shift`` of the diagonal to it; 1 where it is zero."""
    for row in range(len(diagonal)):
        width = 3 * (ptr[row + 1] - ptr[row])
        for i in range(3):
            at = 6 * ptr[row] + 3 * diagonal[row] + i * (width + 1)
            values[at] = values[at] * (1.0 + shift) if values[at] > 0.0 else 1.0

"""Compiled loops that find the boxes of nodes and bars in a grid, and interpolate in them."""

from __future__ import annotations

import numpy as np

from ..mechanics.compiled import inlined, kernel

__all__ = [
    "bar_boxes",
    "corner_weights",
    "distinct",
    "find",
    "interpolate",
    "node_boxes",
    "pair_keys",
    "restrict",
    "sort_by_count",
]

_RECENT = 8192  # boxes that are remembered while bars are visited, a power of two


@inlined
def corner_weights(t, node, base, box, weights, first):
    """Write the eight weights of a node in a box to ``weights`` from ``first``; z varies fastest."""
    fx = t[node, 0] - base[box, 0]
    fy = t[node, 1] - base[box, 1]
    fz = t[node, 2] - base[box, 2]
    for i in range(8):
        w = fx if i & 4 else 1.0 - fx
        w *= fy if i & 2 else 1.0 - fy
        w *= fz if i & 1 else 1.0 - fz
        weights[first + i] = w


@inlined
def _box(low, shape):
    """Return the number of the box that starts at the planes ``low`` (3,)."""
    return (low[0] * shape[1] + low[1]) * shape[2] + low[2]


@kernel
def node_boxes(t, shape, out):
    """Write the box of each node."""
    low = np.zeros(3, np.int64)
    for k in range(len(t)):
        for i in range(3):
            low[i] = max(min(int(t[k, i]), shape[i] - 2), 0)
        out[k] = _box(low, shape)


@kernel
def bar_boxes(t, shape, bars, start, stop, out):
    """Write the box with all corners that have a weight at either end of each bar, -1 if there is none."""
    low = np.zeros(3, np.int64)
    for k in range(start, stop):
        fits = True
        for i in range(3):
            p, q = t[bars[k, 0], i], t[bars[k, 1], i]
            low[i] = max(min(int(min(p, q)), shape[i] - 2), 0)
            fits &= max(p, q) <= low[i] + 1.0
        out[k] = _box(low, shape) if fits else -1


@kernel
def distinct(values, out):
    """Return the number of values >= 0 without those seen shortly before; write them unless ``out`` is empty."""
    seen = np.full(_RECENT, -1, np.int64)
    count = 0
    for value in values:
        if value >= 0 and seen[value % _RECENT] != value:
            seen[value % _RECENT] = value
            if len(out) > 0:
                out[count] = value
            count += 1
    return count


@kernel
def find(sorted_values, values, out):
    """Write the places of values among sorted ones, -1 for negative values."""
    seen = np.full(_RECENT, -1, np.int64)
    places = np.zeros(_RECENT, np.int64)
    for k in range(len(values)):
        value = values[k]
        if value < 0:
            out[k] = -1
            continue
        at = value % _RECENT
        if seen[at] != value:
            seen[at] = value
            places[at] = np.searchsorted(sorted_values, value)
        out[k] = places[at]


@kernel
def pair_keys(bars, own, boxes, n, out):
    """Write the key of the pair of boxes of each bar that has no own one, else -1."""
    for k in range(len(bars)):
        out[k] = -1
        if own[k] == -1:
            one, other = boxes[bars[k, 0]], boxes[bars[k, 1]]
            out[k] = min(one, other) * n + max(one, other)


@kernel
def sort_by_count(numbers, starts, order):
    """Sort by counting: write the indices of numbers 0, 1, ..., without negative ones, and where each starts."""
    for number in numbers:
        if number >= 0:
            starts[number + 1] += 1
    for k in range(1, len(starts)):
        starts[k] += starts[k - 1]
    for k in range(len(numbers)):
        if numbers[k] >= 0:
            order[starts[numbers[k]]] = k
            starts[numbers[k]] += 1
    for k in range(len(starts) - 1, 0, -1):
        starts[k] = starts[k - 1]
    starts[0] = 0


@kernel
def interpolate(t, box, base, corners, coarse, fine):
    """Write the values (owned, 3) of nodes from those of corners."""
    w = np.zeros(8)
    for k in range(len(fine)):
        corner_weights(t, k, base, box[k], w, 0)
        x = y = z = 0.0
        for i in range(8):
            at = corners[box[k], i]
            x += w[i] * coarse[at, 0]
            y += w[i] * coarse[at, 1]
            z += w[i] * coarse[at, 2]
        fine[k, 0] = x
        fine[k, 1] = y
        fine[k, 2] = z


@kernel
def restrict(t, box, base, corners, fine, coarse):
    """Add the transpose of :func:`interpolate`."""
    w = np.zeros(8)
    for k in range(len(fine)):
        corner_weights(t, k, base, box[k], w, 0)
        for i in range(8):
            at = corners[box[k], i]
            coarse[at, 0] += w[i] * fine[k, 0]
            coarse[at, 1] += w[i] * fine[k, 1]
            coarse[at, 2] += w[i] * fine[k, 2]

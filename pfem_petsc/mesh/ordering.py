"""Orders of nodes and bars in which neighbours in space are neighbours in memory."""

from __future__ import annotations

import numpy as np

__all__ = ["BITS", "bar_order", "hilbert_keys", "node_order"]

BITS = 21
"""Bits of each coordinate in a key: three times this fits in 64 bits."""

# Points are treated in pieces of this many, so that the temporary arrays stay in the cache.
_PIECE = 1 << 15


def hilbert_keys(points: np.ndarray, low: np.ndarray, extent: float) -> np.ndarray:
    """Places of points along the Hilbert curve through the cube that starts at ``low``.

    Parameters
    ----------
    points : (n, 3) float64 [m]
    low : (3,) float64 [m]
        Lowest corner of the points of the whole mesh.
    extent : float [m]
        Edge of the cube: the largest extent of the whole mesh.

    Returns
    -------
    keys : (n,) uint64

    Notes
    -----
    J. Skilling, "Programming the Hilbert curve", AIP Conf. Proc. 707 (2004), 381-387.
    """
    keys = np.empty(len(points), np.uint64)
    # The last cell is closed at its upper end; a mesh of no extent (a single node) is all in one cell.
    scale = ((1 << BITS) - 0.5) / extent if extent > 0.0 else 0.0
    for first in range(0, len(points), _PIECE):
        piece = slice(first, first + _PIECE)
        cells = ((points[piece] - low) * scale).astype(np.uint32)
        keys[piece] = _hilbert([np.ascontiguousarray(cells[:, axis]) for axis in range(3)])
    return keys


def _hilbert(x: list[np.ndarray]) -> np.ndarray:
    """Skilling's transform of cell coordinates (three arrays of uint32, changed in place) to places."""
    for bit in range(BITS - 1, 0, -1):
        q = np.uint32(1 << bit)
        lower = np.uint32((1 << bit) - 1)
        for axis in range(3):
            # Where the bit is set, invert the lower bits of x; elsewhere exchange them with those of this axis.
            is_set = (x[axis] & q) != 0
            exchanged = np.where(is_set, np.uint32(0), (x[0] ^ x[axis]) & lower)
            x[0] ^= np.where(is_set, lower, exchanged)
            x[axis] ^= exchanged
    x[1] ^= x[0]
    x[2] ^= x[1]
    twist = np.zeros_like(x[0])
    for bit in range(BITS - 1, 0, -1):
        twist ^= np.where((x[2] & np.uint32(1 << bit)) != 0, np.uint32((1 << bit) - 1), np.uint32(0))
    keys = np.zeros(len(x[0]), np.uint64)
    for axis in range(3):
        keys |= _spread(x[axis] ^ twist) << np.uint64(2 - axis)
    return keys


def _spread(x: np.ndarray) -> np.ndarray:
    """Put two zero bits between the bits of 21-bit numbers."""
    x = x.astype(np.uint64)
    for shift, mask in (
        (32, 0x001F00000000FFFF),
        (16, 0x001F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        x = (x | (x << np.uint64(shift))) & np.uint64(mask)
    return x


def node_order(keys: np.ndarray, ids: np.ndarray | None = None) -> np.ndarray:
    """The order (indices) of nodes by key; equal keys by mesh number, which ``None`` says to be ascending already."""
    if ids is None:
        return np.argsort(keys, kind="stable")
    return np.lexsort((ids, keys))


def bar_order(bars: np.ndarray, group: np.ndarray | None, n_local: int) -> np.ndarray:
    """The order (indices) of bars by group, then lower local end, then higher local end.

    Parameters
    ----------
    bars : (b, 2) int32
        Local ends.
    group : (b,) small int, or None where all are in one
        What comes before locality: section, counted or not.
    n_local : int
        Number of local nodes.
    """
    key = np.minimum(bars[:, 0], bars[:, 1]).astype(np.uint64)
    key *= np.uint64(n_local)
    key += np.maximum(bars[:, 0], bars[:, 1]).astype(np.uint64)
    if group is None:
        return np.argsort(key, kind="stable")
    if int(group.max(initial=0) + 1) * n_local**2 < 1 << 64:
        key += group.astype(np.uint64) * np.uint64(n_local**2)
        return np.argsort(key, kind="stable")
    return np.lexsort((key, group))

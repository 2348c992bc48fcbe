"""Compiled loops over the ends of bars: lengths, and bars that have passed through zero length."""

from __future__ import annotations

from .compiled import kernel

__all__ = ["bar_lengths", "first_inverted"]


@kernel
def bar_lengths(points, bars, lengths):
    """Write the lengths (b,) of bars (b, 2) between points (n, 3)."""
    for k in range(len(bars)):
        a = bars[k, 0]
        b = bars[k, 1]
        dx = points[b, 0] - points[a, 0]
        dy = points[b, 1] - points[a, 1]
        dz = points[b, 2] - points[a, 2]
        lengths[k] = (dx * dx + dy * dy + dz * dz) ** 0.5


@kernel
def first_inverted(x, before, bars, rest):
    """Return the first shortened bar whose direction has reversed, or -1; those with zero ``rest`` are not checked."""
    for k in range(len(bars)):
        a = bars[k, 0]
        b = bars[k, 1]
        dx = x[b, 0] - x[a, 0]
        dy = x[b, 1] - x[a, 1]
        dz = x[b, 2] - x[a, 2]
        if dx * dx + dy * dy + dz * dz < 0.8 * rest[k] * rest[k]:
            back = dx * (before[b, 0] - before[a, 0])
            back += dy * (before[b, 1] - before[a, 1])
            back += dz * (before[b, 2] - before[a, 2])
            if back < 0.0:
                return k
    return -1

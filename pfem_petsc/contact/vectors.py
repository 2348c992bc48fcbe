"""Vectors of three numbers as tuples, for compiled loops; components may be complex."""

from __future__ import annotations

from ..mechanics.compiled import inlined


@inlined
def vector(x, i):
    """Return the first three columns of row i."""
    return x[i, 0], x[i, 1], x[i, 2]


@inlined
def minus(a, b):
    """Return a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@inlined
def along(a, s, b):
    """Return a + s b."""
    return a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]


@inlined
def times(s, a):
    """Return s a."""
    return s * a[0], s * a[1], s * a[2]


@inlined
def dot(a, b):
    """Return the scalar product, without conjugation."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def cross(a, b):
    """Return the vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inlined
def put(x, i, a):
    """Write a to the first three columns of row i."""
    x[i, 0], x[i, 1], x[i, 2] = a


@inlined
def add_to(x, i, s, a):
    """Add s a to the first three columns of row i."""
    put(x, i, along(vector(x, i), s, a))

"""Loops over the nodes of implicit steps; NumPy takes several times as long for rows of three."""

from __future__ import annotations

import numpy as np

from ..mechanics.compiled import kernel


@kernel
def balance(nodal, u, known, weight, f, g):
    """Write nodal u + known + weight f to ``g``; vectors (owned, 3)."""
    for i in range(len(g)):
        for c in range(3):
            g[i, c] = nodal[i] * u[i, c] + known[i, c] + weight * f[i, c]


@kernel
def squares(mass, v, external, internal):
    """Return the sums of the squares of mass v, of external and of internal forces (owned, 3)."""
    sums = np.zeros((3, 3))
    for i in range(len(mass)):
        for c in range(3):
            sums[0, c] += (mass[i] * v[i, c]) ** 2
            sums[1, c] += external[i, c] ** 2
            sums[2, c] += internal[i, c] ** 2
    return sums.sum(axis=1)


@kernel
def net_force(g, nodal):
    """Return the sums (4,) of forces (owned, 3) and of ``nodal`` (owned,)."""
    x = y = z = total = 0.0
    for i in range(len(nodal)):
        x += g[i, 0]
        y += g[i, 1]
        z += g[i, 2]
        total += nodal[i]
    return np.array([x, y, z, total])


@kernel
def translate(shift, nodal, u, g):
    """Subtract a translation (3,) from increments, and what it changes of the residual, both (owned, 3)."""
    for i in range(len(nodal)):
        for c in range(3):
            u[i, c] -= shift[c]
            g[i, c] -= nodal[i] * shift[c]


@kernel
def largest_distance(one, other):
    """Return the largest distance of nodes between positions (n, 3); NaN if any is not a number."""
    largest = 0.0
    for i in range(len(one)):
        x, y, z = one[i, 0] - other[i, 0], one[i, 1] - other[i, 1], one[i, 2] - other[i, 2]
        square = x * x + y * y + z * z
        if not square <= largest:
            largest = square
            if square != square:
                break
    return np.sqrt(largest)


@kernel
def motion_energy(momentum, v, forces, before, after):
    """Return half of the sum of momentum times velocity, and of the magnitudes of the work of ``forces``, a tuple of
    vectors (owned, 3) that are added, between two positions."""
    first, second, third = forces
    x = y = z = 0.0
    for i in range(len(v)):
        for c in range(3):
            work = (first[i, c] + second[i, c] + third[i, c]) * (after[i, c] - before[i, c])
            part = momentum[i, c] * v[i, c] + abs(work)
            if c == 0:
                x += part
            elif c == 1:
                y += part
            else:
                z += part
    return 0.5 * (x + y + z)


@kernel
def extend(before, after, differences, orders):
    """Replace first and second backward differences (n, 6) of vectors by those at ``after`` (n, 3), and the orders (n,)
    by those that would have predicted it best."""
    for i in range(len(after)):
        first = second = third = 0.0
        for c in range(3):
            one = after[i, c] - before[i, c]
            two = one - differences[i, c]
            three = two - differences[i, 3 + c]
            differences[i, c] = one
            differences[i, 3 + c] = two
            first += one * one
            second += two * two
            third += three * three
        order = 1 if second < first else 0
        if third < min(first, second):
            order = 2
        orders[i] = order


@kernel
def extrapolate(vectors, differences, orders, factor, out):
    """Write vectors (n, 3) expected next, by polynomials of the ``orders`` (n,), times a factor."""
    for i in range(len(out)):
        for c in range(3):
            value = vectors[i, c]
            if orders[i] > 0:
                value += differences[i, c]
            if orders[i] > 1:
                value += differences[i, 3 + c]
            out[i, c] = factor * value

"""Compiled loops of leapfrog schemes, with velocities at half steps: x1 = x0 + h half, half1 = half0 + h a, v = half1 -
h a/2. The solution of the balance is u with a = alpha u and h a/2 = eta u.

The loops run over arrays (3 n,), so that they are vectorised.
"""

from __future__ import annotations

from ..mechanics.compiled import borrowing_apart, kernel

__all__ = [
    "accelerations",
    "advance",
    "advance_loaded",
    "advance_solved",
    "centre",
    "drift",
    "finish",
    "kick",
    "move",
    "solve",
]


@kernel
def drift(x, h, half, moved):
    """Compute ``moved`` = x + h half."""
    for i in range(len(half)):
        moved[i] = x[i] + h * half[i]


@kernel
def move(x, h, half):
    """Add h half to ``x``: :func:`drift` in place, which needs a loop of its own to be vectorised."""
    for i in range(len(half)):
        x[i] += h * half[i]


@kernel
def kick(u, alpha, h, half):
    """Advance the velocities ``half`` by a step with the acceleration of the balance, alpha u."""
    for i in range(len(u)):
        half[i] += h * (alpha * u[i])


@kernel
def centre(u, eta, half, v):
    """Compute velocities ``v`` of the balance from the increments and the velocities half a step later."""
    for i in range(len(u)):
        v[i] = half[i] - eta * u[i]


@kernel
def accelerations(u, alpha, a):
    """Compute ``a`` = alpha u; arrays (3 n,)."""
    for j in range(len(u)):
        a[j] = alpha * u[j]


@kernel
def finish(u, alpha, eta, h, half, v, a):
    """Advance ``half`` by a step, and compute velocities ``v`` and accelerations ``a`` of the balance: :func:`kick` and
    :func:`centre` in one pass."""
    for i in range(len(u)):
        pull = alpha * u[i]
        ahead = half[i] + h * pull
        half[i] = ahead
        v[i] = ahead - eta * u[i]
        a[i] = pull


@kernel
def advance(f, inverse, alpha, eta, h, half, sums):
    """Solve balances u = -f ``inverse``, advance ``half``, and add f . v to ``sums``, one for each number of a part of
    this length: :func:`kick` and :func:`centre` in one pass."""
    wide = len(sums)
    for first in range(0, len(half), wide):
        last = min(first + wide, len(half))
        force, factor, ahead = f[first:last], inverse[first:last], half[first:last]
        for j in range(len(force)):
            u = -force[j] * factor[j]
            ahead[j] += h * (alpha * u)
            sums[j] += force[j] * (ahead[j] - eta * u)


@kernel
def advance_loaded(f, external, inverse, numbers, half, v, sums):
    """As :func:`advance` with external forces, u = (``external`` - f) ``inverse``, and alpha, eta and h as ``numbers``;
    writes ``v``."""
    alpha, eta, h = numbers
    wide = len(sums)
    for first in range(0, len(half), wide):
        last = min(first + wide, len(half))
        force, load, factor, ahead, speed = (
            f[first:last],
            external[first:last],
            inverse[first:last],
            half[first:last],
            v[first:last],
        )
        for j in range(len(force)):
            u = (load[j] - force[j]) * factor[j]
            ahead[j] += h * (alpha * u)
            speed[j] = ahead[j] - eta * u
            sums[j] += force[j] * speed[j]


@borrowing_apart
def solve(inverse, x, h, half, u, free):
    """Multiply forces ``u`` by ``inverse``, and compute the positions that the balance reaches, ``free`` = x + h half +
    u."""
    for j in range(len(u)):
        step = u[j] * inverse[j]
        u[j] = step
        free[j] = x[j] + h * half[j] + step


@borrowing_apart
def advance_solved(u, f, numbers, half, v, sums):
    """As :func:`advance` with the increments ``u`` of a balance; writes ``v``."""
    alpha, eta, h = numbers
    wide = len(sums)
    for first in range(0, len(u), wide):
        last = min(first + wide, len(u))
        step, force, ahead, speed = u[first:last], f[first:last], half[first:last], v[first:last]
        for j in range(len(step)):
            ahead[j] += h * (alpha * step[j])
            speed[j] = ahead[j] - eta * step[j]
            sums[j] += force[j] * speed[j]

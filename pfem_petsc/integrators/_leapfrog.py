"""Compiled loops of leapfrog schemes, with velocities at half steps: x1 = x0 + h half, half1 = half0 + h a, v = half1 -
h a/2. The solution of the balance is u with a = alpha u and h a/2 = eta u. Arrays are (3 n,).
"""

from __future__ import annotations

from ..mechanics.compiled import kernel

__all__ = ["drift", "finish"]


@kernel
def drift(x, h, half, moved):
    """Compute ``moved`` = x + h half."""
    for i in range(len(half)):
        moved[i] = x[i] + h * half[i]


@kernel
def finish(u, alpha, eta, h, half, v, a):
    """Advance ``half`` by a step, and compute velocities ``v`` and accelerations ``a`` of the balance in one pass."""
    for i in range(len(u)):
        pull = alpha * u[i]
        ahead = half[i] + h * pull
        half[i] = ahead
        v[i] = ahead - eta * u[i]
        a[i] = pull

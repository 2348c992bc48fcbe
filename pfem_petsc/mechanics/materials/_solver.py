"""The root of a decreasing function of one unknown, in compiled code: Newton's method within a bracket."""

from __future__ import annotations

import math
from collections.abc import Callable

from ..compiled import inlined

__all__ = ["NOISE", "make_solver"]

NOISE = 4.0 * 2.0**-52
"""Residual relative to its terms below which it is rounding."""

_MOST = 200  # iterations; some six are usual, and bisections alone would take a hundred


def make_solver(residual: Callable) -> Callable:
    """Return a compiled function ``solve(start, high, noise, data)``.

    ``residual(x, data)`` returns a value and its derivative; the value is positive at 0 and not at ``high``. ``solve``
    returns the root of (0, high], from ``start``, as soon as the residual is no larger than ``noise``, after a last
    step of Newton's method. Flow stresses may have any slope, and an infinite one at 0. Where a step of Newton's
    method leaves the bracket, the unknown decreases by powers that are squared each time until the residual is
    positive, and is then the geometric mean of the bounds, so that roots of any magnitude are found in a few steps.
    """

    @inlined
    def solve(start, high, noise, data):
        low, x, shrink = 0.0, start, 0.0625
        for _ in range(_MOST):
            value, slope = residual(x, data)
            if value > 0.0:
                low = x
            else:
                high = x
            new = x - value / slope if slope < 0.0 else -1.0
            if abs(value) <= noise:
                return new if low <= new <= high else x
            if not (low < new < high):
                if low == 0.0:
                    new = high * shrink
                    shrink *= shrink
                elif high > 4.0 * low:
                    new = math.sqrt(low) * math.sqrt(high)
                else:
                    new = 0.5 * (low + high)
            if new == x or new == 0.0:
                return new
            x = new
        return x

    return solve

"""The mean stress of a step from the change of energies, for laws whose energies are functions of the end of a path."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ..compiled import inlined

__all__ = ["SMALL", "mean_of_work"]

SMALL = 1e-6  # change of strain over strain, below which the quotient is rounding, and the trapezoidal rule is exact


def mean_of_work(response: Callable[..., Any]) -> Callable[..., Any]:
    """Return ``mean_stress`` of a law without rate: the change of all its energies over the change of strain.

    The response must not depend on the steps in which a strain is reached: its energies are then the integral of the
    stress over the strain.
    """

    @inlined
    def mean_stress(stress0, strain0, strain, rate, step, temperature, p, q):
        stress, tangent, _, after = response(strain, rate, step, temperature, p, q)
        change = strain - strain0
        if not abs(change) > SMALL * (abs(strain) + abs(strain0)):
            return 0.5 * (stress0 + stress), 0.5 * tangent
        _, _, _, before = response(strain0, 0.0, 0.0, temperature, p, q)
        work = 0.0
        for k in range(len(after)):
            work += after[k] - before[k]
        mean = work / change
        return mean, (stress - mean) / change

    return mean_stress

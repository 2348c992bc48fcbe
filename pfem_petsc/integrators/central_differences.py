"""Central differences in leapfrog form: second order, explicit, stable to omega h = 2 at any damping.

    a0 = (x1 - 2 x0 + x-1)/h^2,   v0 = (x1 - x-1)/(2h),   balance at t0; start v-1/2 = v0 - h a0/2.

The scheme stores velocities at half steps (v+1/2 = v-1/2 + h a0, x1 = x0 + h v+1/2), which conserves momentum to
rounding; three positions would not. The balance at t0 determines x1, so the program moves first and then solves: the
recorded velocity and acceleration belong to the recorded position.
"""

from __future__ import annotations

import numpy as np

from .base import Balance, ExplicitScheme, NoParameters, State, lagged_limit

__all__ = ["Parameters", "Scheme"]

Parameters = NoParameters


class Scheme(ExplicitScheme):
    """Central differences (explicit)."""

    solves_next_position = True
    leapfrog = True
    remembers = ("half_velocity",)

    def limit(self, damping_ratio: float = 0.0, viscous_ratio: float = 0.0) -> float:
        """Return 2 for any damping ratio, because damping is centred; that of viscous bars, whose rate is extrapolated
        from the half steps before, reduces it to the root of Omega^2 + 8 xi Omega = 4, as the method of Chung and
        Lee."""
        return lagged_limit(0.0, 1.0, 1.5, viscous_ratio)

    def start(self, state: State, h: float) -> None:
        state.memory["half_velocity"] = state.v - (0.5 * h) * state.a

    def balance(self, state: State, h: float) -> Balance:
        half = state.memory["half_velocity"]
        return Balance(
            alpha=1.0 / (h * h),
            eta=0.5 / h,
            predictor=state.position + h * half,
            v_hat=half,
            a_hat=None,
            time=state.time + h,
            loads=((1.0, state.time),),
            weight=0.0,
        )

    def finish(self, state: State, balance: Balance, u: np.ndarray, h: float) -> None:
        half = state.memory["half_velocity"]
        state.a = balance.alpha * u
        half += h * state.a
        state.v = half - balance.eta * u

"""What an integrator's own formulas make of a node whose position a wall holds."""

from __future__ import annotations

import numpy as np

from ..integrators.base import Scheme, State

__all__ = ["held_growth"]


def held_growth(scheme: Scheme) -> float:
    """Growth a step of velocity and acceleration of a node that arrives at a wall and is held there; at most 1: stable.

    The scheme itself is run on one node of unit mass and speed with a unit step; the factor is that of its last steps.
    """
    zero = np.zeros((1, 3))
    state = State(zero.copy(), zero + [1.0, 0.0, 0.0], *(zero.copy() for _ in range(5)))
    scheme.start(state, 1.0)
    sizes = []
    for step in range(60):
        if scheme.leads:
            scheme.advance(state, 1.0)
        balance = scheme.balance(state, 1.0)
        scheme.finish(state, balance, zero - balance.predictor, 1.0)
        state.time = step + 1.0
        sizes.append(max(float(np.abs(state.v).max()), float(np.abs(state.a).max())))
    early, late = sizes[29], sizes[-1]
    return (late / early) ** (1.0 / 30.0) if early > 1e-12 else 0.0

"""The external force of a balance, and that at the present state."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..errors import SimulationFailure
from ..integrators.base import Balance

if TYPE_CHECKING:
    from .stepper import Stepper

__all__ = ["load_now", "load_of"]


def load_of(stepper: Stepper, balance: Balance) -> np.ndarray:
    """Return the external force (owned, 3) [N] of a balance that is not solved yet. Collective."""
    external = stepper.model.external
    if not external.active:
        return stepper.zero
    if len(balance.loads) == 1 and balance.loads[0][0] == 1.0:
        total = external.constant()
        if total is not None:
            return total
    total = None
    for weight, time in balance.loads:
        if external.state_forces:
            external.follow(*_expected(stepper, balance, time))
        part = external.at(time, np.empty_like(stepper.state.v))
        if weight != 1.0:
            part *= weight
        total = part if total is None else np.add(total, part, out=total)
    if external.failure is not None:
        _fail(stepper, stepper.when(balance))
    return total


def load_now(stepper: Stepper, time: float) -> np.ndarray:
    """Return the external force (owned, 3) [N] at a time [s] and the present positions and velocities. Collective."""
    external = stepper.model.external
    if external.state_forces:
        external.follow(stepper.state.position, stepper.state.v)
    force = external.at(time, np.empty_like(stepper.state.v))
    if external.failure is not None:
        _fail(stepper, stepper.arrived())
    return force


def _fail(stepper: Stepper, where: str) -> None:
    if stepper.fault is None:
        stepper.fault = SimulationFailure(f"{where}: external_force: the function {stepper.model.external.failure}")


def _expected(stepper: Stepper, balance: Balance, time: float) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and velocities (owned, 3) at a time [s] of a balance that is not solved yet.

    The acceleration is that of the state; nodes in contact, whose acceleration may jump, are predicted without it.
    """
    state = stepper.state
    a = np.where((state.contact != 0.0).any(axis=1)[:, None], 0.0, state.a)
    if stepper.scheme.solves_next_position:  # the velocity of the state is that of the step before
        known = 0.0 if balance.a_hat is None else balance.a_hat
        return state.position, balance.v_hat + (balance.eta / balance.alpha) * (a - known)
    ahead = time - state.time
    return state.position + ahead * (state.v + (0.5 * ahead) * a), state.v + ahead * a

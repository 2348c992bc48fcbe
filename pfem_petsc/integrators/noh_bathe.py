"""Explicit scheme of Noh and Bathe (2013): two substeps, of p h and (1 - p) h = s, that damp the highest frequencies.

    xp = x0 + p h v0 + (p h)^2 a0/2,   balance at tp,   vp = v0 + p h (a0 + ap)/2,
    x1 = xp + s vp + s^2 ap/2,         balance at t1,   v1 = vp + s [q0 a0 + (1/2 + q1) ap + q2 a1],
    q1 = (1 - 2 p)/[2 p (1 - p)],   q2 = 1/2 - p q1,   q0 = 1/2 - q1 - q2.

Second order. The balance at an instant determines the next position, so the program moves first and then solves, and
recorded velocities and accelerations belong to the recorded positions. Damping forces are those of the velocity of the
balance. A step evaluates forces twice, and is stable to nearly twice that of central differences.
"""

from __future__ import annotations

from functools import partial
from typing import Annotated

import numpy as np
from pydantic import Field

from ..case.base import StrictModel
from .base import Balance, ExplicitScheme, State

__all__ = ["Parameters", "Scheme"]


class Parameters(StrictModel):
    """Parameters of the method of Noh and Bathe."""

    p: Annotated[float, Field(gt=0.5, lt=1.0)] = 0.54
    """share p of the first substep; near 1/2: hardly any damping"""


class Scheme(ExplicitScheme):
    """Method of Noh and Bathe (explicit, two substeps).

    The memory has the mean velocity until the next instant, and the known part of the velocity there: that of the
    balance at tp or of the one at t1.
    """

    solves_next_position = True
    jumps_known = False  # which of the two velocities jumps, and when, is not known
    remembers = ("half_velocity", "first_known", "second_known")

    def set_coefficients(self) -> None:
        """Set shares of the substeps and weights from the parameter."""
        p = self.parameters.p
        q1 = (1.0 - 2.0 * p) / (2.0 * p * (1.0 - p))
        self.last_weight = 0.5 - p * q1
        self.weights = 0.5 - q1 - self.last_weight, 0.5 + q1
        self.substeps = ((p, p), (1.0 - p, 1.0))

    def limit(self, damping_ratio: float = 0.0, viscous_ratio: float = 0.0) -> float:
        """Return the least Omega beyond which an oscillator grows, to four digits."""
        grows = partial(self._grows, damping_ratio, viscous_ratio)
        low, high = 0.0, 0.01
        while not grows(high) and high < 8.0:
            low, high = high, high + 0.01
        while high - low > 1e-4 * high:
            middle = 0.5 * (low + high)
            low, high = (low, middle) if grows(middle) else (middle, high)
        return low

    def _grows(self, damping_ratio: float, viscous_ratio: float, frequency: float) -> bool:
        """Return whether steps of 1 s of an oscillator of frequency (rad/s) amplify any state."""
        # rows: unit vectors of position, velocity, acceleration and strain rate, each moved by one step
        unit = np.eye(4)
        state = State(unit[:, :1].copy(), unit[:, 1:2], unit[:, 2:3], *np.zeros((4, 4, 1)))
        rate, p = unit[:, 3:], self.parameters.p
        state.memory = {"first_known": state.v + 0.5 * p * state.a, "half_velocity": state.v + 0.5 * p * state.a}
        for share, _ in self.substeps:
            before, known = state.position.copy(), rate
            self.advance(state, share)
            rate = (state.position - before) / share
            balance = self.balance(state, share)
            force = -(frequency**2) * state.position - 2.0 * damping_ratio * frequency * balance.v_hat
            # extrapolated from this substep and the one before, of the other share
            force -= 2.0 * viscous_ratio * frequency * (rate + share * (rate - known))
            u = force / (balance.alpha + 2.0 * damping_ratio * frequency * balance.eta)
            self.finish(state, balance, u, share)
        after = np.hstack([state.position, state.v, state.a, rate])
        return bool(np.abs(np.linalg.eigvals(after)).max() > 1.0 + 1e-9)

    def start(self, state: State, h: float) -> None:
        """See :class:`Scheme`; ``h``: of the second substep, as whose end the start is taken."""
        state.memory["second_known"] = state.v - (self.last_weight * h) * state.a
        state.memory["half_velocity"] = state.v - (0.5 * h) * state.a

    def restart(self, state: State, nodes: np.ndarray | tuple[np.ndarray, np.ndarray], h: float) -> None:
        """See :class:`Scheme`; the next position stays where it was solved to be."""
        first, following = self._substeps(state.memory, h, made=True)
        v, a = state.v[nodes], state.a[nodes]
        name, share = ("first_known", 0.5) if first else ("second_known", sum(self.weights))
        state.memory[name][nodes] = v + (share * following) * a

    def _substeps(self, memory: dict[str, np.ndarray], h: float, made: bool = False) -> tuple[bool, float]:
        """Return whether the balance, or after one that is ``made`` the next, is at tp, and the size [s] of the substep
        that follows one of the size ``h``."""
        p, first = self.parameters.p, "first_known" in memory
        return first, h * (p / (1.0 - p) if first == made else (1.0 - p) / p)

    def balance(self, state: State, h: float) -> Balance:
        first, following = self._substeps(state.memory, h)
        known = state.memory["first_known" if first else "second_known"]
        share = (0.5 if first else self.last_weight) * h
        gain = following * (share + 0.5 * following)
        return Balance(
            alpha=1.0 / gain,
            eta=share / gain,
            predictor=state.position + following * known,
            v_hat=known,
            a_hat=None,
            time=state.time + following,
            loads=((1.0, state.time),),
            weight=0.0,
        )

    def finish(self, state: State, balance: Balance, u: np.ndarray, h: float) -> None:
        first, following = self._substeps(state.memory, h)
        a = balance.alpha * u
        v = balance.v_hat + balance.eta * u
        memory = {"half_velocity": v + (0.5 * following) * a}
        if first:
            memory["second_known"] = v + following * (self.weights[0] * state.a + self.weights[1] * a)
        else:
            memory["first_known"] = v + (0.5 * following) * a
        for name in self.remembers:
            state.memory.pop(name, None)
        state.memory |= memory
        state.v, state.a = v, a

"""Composite scheme of Bathe and Baig (2005) in the form of Noh and Bathe (2019), with the spectral radius rho_inf at
infinite frequency: the trapezoidal rule over g h, then with two known instants

    v1 = v0 + h (q0 a0 + q1 ag + q2 a1),   x1 = x0 + h (q0 v0 + q1 vg + q2 v1),   balance at t1,
    q1 = (rho + 1)/[2 g (rho - 1) + 4],   q2 = 1/2 - g q1,   q0 = 1 - q1 - q2,
    g = [2 - sqrt(2 + 2 rho)]/(1 - rho)   (1/2 at rho = 1),

where both balances have the same stiffness, since 2/g = 1/q2. Second order, unconditionally stable (linear). rho = 0 is
the three-point backward difference, which removes the highest frequencies in one step. A step solves two balances, so
compare it with others of half its size.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from ..case.base import StrictModel
from .base import Balance, State
from .base import Scheme as Base

__all__ = ["Parameters", "Scheme"]


class Parameters(StrictModel):
    """Parameters of Bathe's composite scheme."""

    rho_inf: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    """spectral radius at infinite frequency; 1: no damping"""


_MEMORY = ("first_way", "first_velocity", "first_acceleration")


class Scheme(Base):
    """Bathe's composite scheme (implicit, two substeps).

    Between the substeps the memory has the way of the first one, and velocities and accelerations at its start.
    """

    remembers = _MEMORY

    def set_coefficients(self) -> None:
        """Set shares of the substeps and weights from the parameter."""
        rho = self.parameters.rho_inf
        first = 0.5 if rho == 1.0 else (2.0 - np.sqrt(2.0 + 2.0 * rho)) / (1.0 - rho)
        q1 = (rho + 1.0) / (2.0 * first * (rho - 1.0) + 4.0)
        q2 = 0.5 - first * q1
        self.first, self.weights = first, (1.0 - q1 - q2, q1, q2)
        self.substeps = ((first, first), (1.0 - first, 1.0))

    def step_changed(self, state: State) -> None:
        for name in _MEMORY:
            state.memory.pop(name, None)

    def restart(self, state: State, nodes: np.ndarray | tuple[np.ndarray, np.ndarray], h: float) -> None:
        """Between the substeps, give changed nodes a start of the step from which they have moved at their present
        acceleration; ``h``: of the substep."""
        if _MEMORY[0] in state.memory:
            v, a = state.v[nodes], state.a[nodes]
            for name, values in zip(_MEMORY, (h * v - (0.5 * h * h) * a, v - h * a, a), strict=True):
                state.memory[name][nodes] = values

    def balance(self, state: State, h: float) -> Balance:
        common = {"a_hat": None, "time": state.time + h, "loads": ((1.0, state.time + h),), "weight": 1.0}
        if _MEMORY[0] not in state.memory:
            return Balance(
                alpha=4.0 / (h * h),
                eta=2.0 / h,
                predictor=state.position + h * state.v + (0.25 * h * h) * state.a,
                v_hat=state.v + (0.5 * h) * state.a,
                **common,
            )
        q0, q1, q2 = (q * h / (1.0 - self.first) for q in self.weights)
        way, v0, a0 = (state.memory[name] for name in _MEMORY)
        v_hat = v0 + q0 * a0 + q1 * state.a
        return Balance(
            alpha=1.0 / (q2 * q2),
            eta=1.0 / q2,
            predictor=(state.position - way) + (q0 * v0 + q1 * state.v + q2 * v_hat),
            v_hat=v_hat,
            **common,
        )

    def finish(self, state: State, balance: Balance, u: np.ndarray, h: float) -> None:
        if _MEMORY[0] in state.memory:
            self.step_changed(state)
        else:
            way = h * state.v + (0.25 * h * h) * state.a + u
            state.memory |= dict(zip(_MEMORY, (way, state.v, state.a), strict=True))
        super().finish(state, balance, u, h)

"""Central differences with contact nodes that are massless along their walls' normals."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..errors import SimulationFailure
from ..integrators.base import Balance
from ..tolerances import BEYOND
from .solution import Solution
from .stepper import Stepper

if TYPE_CHECKING:
    from ..integrators.base import Scheme
    from .model import Model

__all__ = ["RedistributedStepper"]


class RedistributedStepper(Stepper):
    """Advances nodes with mass by the balance at t_n; massless nodes are in equilibrium along the normal at x_{n+1}.

    Each step needs a few additional evaluations of the bars, because the equilibrium of each contact node is found by a
    secant method.
    """

    def __init__(self, model: Model, scheme: Scheme, h: float) -> None:
        super().__init__(model, scheme, h)
        moved = model.inertia.redistribution
        self.moved = moved
        self._inverse = moved.inverse(model.inertia.mass, model.supports.fixed)
        self._trial = np.zeros_like(self.state.x)

    def accelerate(self, load: np.ndarray) -> np.ndarray:
        a = load / self.model.inertia.mass[:, None]
        a[self.moved.touched] = np.einsum("kij,kj->ki", self._inverse, load[self.moved.touched])
        a[self.model.supports.fixed] = 0.0
        return a

    def solve(self, balance: Balance) -> Solution:
        model, state, moved = self.model, self.state, self.moved
        supports, owned = model.supports, model.mesh.n_owned
        load = state.external - state.f[:owned]
        state.contact, walls = self.massless.press(state.position, load, state.time)
        pull = load + state.contact
        if supports.any:
            at = (supports.nodes, supports.components)
            held = np.zeros_like(load)
            held[at] = supports.positions(balance.time) - balance.predictor[at]
            # a mass matrix couples the free components to prescribed ones
            carried = balance.alpha * held
            if balance.a_hat is not None:  # the acceleration of moving supports
                carried += balance.a_hat
            pull[moved.touched] -= np.einsum("kij,kj->ki", moved.tensors, carried[moved.touched])
        u = self.accelerate(pull) / balance.alpha
        if supports.any:
            u[at] = held[at]
        self._equilibrium(balance, u)
        state.support = np.zeros_like(u)
        if supports.any:
            a = balance.alpha * u if balance.a_hat is None else balance.alpha * u + balance.a_hat
            inertia = model.inertia.mass_times(a, np.empty_like(u))
            state.support[at] = (inertia - load - state.contact)[at]
        return Solution(u, state.f, walls, contacts=int(walls.touching.sum()))

    def _equilibrium(self, balance: Balance, u: np.ndarray) -> None:
        """Move the contact nodes along their normals until they are in equilibrium or on the wall. Collective."""
        model, nodes = self.model, self.moved.nodes
        x = self._trial
        x[: model.mesh.n_owned] = balance.predictor + u
        largest = self.massless.settle(x, balance.time, self.state.time)
        if not largest <= BEYOND * model.size and self.fault is None:
            self.fault = SimulationFailure(
                f"{self.when(balance)}: contact nodes without mass found no equilibrium (last move {largest:.3g} "
                "m); reduce time.step or use another contact.treatment"
            )
        u[nodes] = x[nodes] - balance.predictor[nodes]

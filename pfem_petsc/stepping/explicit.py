"""Explicit steps with lumped mass: every node on its own, contact by exact projection."""

from __future__ import annotations

import numpy as np

from ..errors import SimulationFailure
from ..integrators.base import Balance
from .stepper import Solution, Stepper

__all__ = ["ExplicitStepper"]


class ExplicitStepper(Stepper):
    """Solves (alpha m + eta c) u = f_ext - f_int - m a_hat - c v_hat node by node."""

    def accelerate(self, load: np.ndarray) -> np.ndarray:
        a = load / self.model.inertia.mass[:, None]
        a[self.model.supports.fixed] = 0.0
        return a

    def solve(self, balance: Balance) -> Solution:
        model, state = self.model, self.state
        inertia, owned = model.inertia, model.mesh.n_owned
        load = state.external - state.f[:owned]
        if balance.a_hat is not None:
            load -= inertia.mass[:, None] * balance.a_hat
        if inertia.damped and balance.v_hat is not None:
            load -= inertia.damping[:, None] * balance.v_hat
        stiffness = balance.alpha * inertia.mass
        if inertia.damped and balance.eta:
            stiffness = stiffness + balance.eta * inertia.damping
        u = load / stiffness[:, None]
        supports = model.supports
        state.contact = np.zeros_like(u)
        if supports.any:
            at = (supports.nodes, supports.components)
            u[at] = supports.positions(balance.time) - balance.predictor[at]
        walls, contacts = model.contact.none(), 0
        if model.contact.any:
            try:
                nodes, correction, force, walls = model.contact.explicit(
                    balance.predictor + u, stiffness, balance.time, 1e-13 * model.length
                )
                u[nodes] += correction
                state.contact[nodes] = force
                contacts = len(nodes)
            except SimulationFailure as failure:
                if self.fault is None:
                    self.fault = SimulationFailure(f"step {state.step}: {failure}")
        if supports.any:
            state.support = np.zeros_like(u)
            state.support[at] = stiffness[supports.nodes] * u[at] - load[at] - state.contact[at]
        return Solution(u, state.f, walls, contacts=contacts)

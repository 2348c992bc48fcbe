"""Explicit steps with lumped mass: nodes are solved independently, contact by exact projection."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np

from ..errors import SimulationFailure
from ..integrators.base import Balance
from ..tolerances import PROJECTED
from .node_loops import explicit_increments, hold, react
from .solution import Solution
from .stepper import Stepper

if TYPE_CHECKING:
    from ..integrators.base import Scheme
    from .model import Model

__all__ = ["ExplicitStepper"]


class ExplicitStepper(Stepper):
    """Solves (alpha m + eta c) u = f_ext - f_int - m a_hat - c v_hat node by node.

    Attributes
    ----------
    other_force : (local, 3) internal force before the last evaluation [N], overwritten by the next one; None after
        fused steps, which keep one force
    """

    renews_forces = True
    steady = True

    def __init__(self, model: Model, scheme: Scheme, h: float) -> None:
        super().__init__(model, scheme, h)
        self._none = np.empty((0, 3))
        self._nobody = np.empty(0, dtype=np.int64)
        self.other_force: np.ndarray | None = None
        self._stiffness, self._stiffness_of = np.empty(0), (0.0, 0.0, self._none)

    def evaluate(self, commit: bool) -> None:
        other = np.empty_like(self.state.f) if self.other_force is None else self.other_force
        self.state.f, self.other_force = other, self.state.f
        super().evaluate(commit)

    def accelerate(self, load: np.ndarray) -> np.ndarray:
        a = load / self.model.inertia.mass[:, None]
        self.model.supports.clear(a)
        return a

    @contextmanager
    def _faults(self, balance: Balance) -> Iterator[None]:
        """Record the first failure of this rank until ranks synchronise."""
        try:
            yield
        except SimulationFailure as failure:
            if self.fault is None:
                self.fault = SimulationFailure(f"{self.when(balance)}: {failure}")

    def _stiffness_for(self, balance: Balance) -> np.ndarray:
        """Return the array (owned,) for alpha m + eta c: another one if it changes, on all ranks in the same step."""
        alpha, eta, damping = self._stiffness_of
        inertia = self.model.inertia
        if (alpha, eta) != (balance.alpha, balance.eta) or damping is not inertia.damping:
            self._stiffness_of = balance.alpha, balance.eta, inertia.damping
            self._stiffness = np.empty_like(inertia.mass)
        return self._stiffness

    def solve(self, balance: Balance) -> Solution:
        model, state = self.model, self.state
        inertia = model.inertia
        u, stiffness = np.empty_like(state.v), self._stiffness_for(balance)
        explicit_increments(
            state.external if model.external.active else self._none,
            state.f,
            inertia.mass,
            inertia.damping,
            balance.alpha,
            balance.eta,
            balance.a_hat if balance.a_hat is not None else self._none,
            balance.v_hat if inertia.damped else self._none,
            stiffness,
            u,
        )
        supports = model.supports
        state.contact = self.zero
        if supports.any:
            load = np.empty(len(supports.nodes))
            if supports.inclined is not None:
                others = self._hold(balance, stiffness, u)
            positions = supports.positions(balance.time)[: len(supports.nodes)]
            hold(0, len(load), 0, supports.nodes, supports.components, positions, balance.predictor, stiffness, u, load)
        walls, held, tolerance = model.contact.nothing, self._nobody, PROJECTED * model.size
        with self._faults(balance):
            state.contact = model.links.explicit(balance, state, u, stiffness, self.zero, tolerance)
        if model.contact.any:
            # also after a failure of links: with walls with mass this call is collective
            with self._faults(balance):
                arguments = balance.predictor, u, stiffness, balance.time, tolerance, balance.acting
                nodes, force, walls = model.contact.explicit(*arguments)
                if len(nodes):
                    if state.contact is self.zero:
                        state.contact = np.zeros_like(u)
                    state.contact[nodes] += force
                held = nodes
        if supports.any:
            state.support = np.zeros_like(u)
            react(
                0, len(load), 0, supports.nodes, supports.components, load, state.contact, stiffness, u, state.support
            )
            if supports.inclined is not None:
                state.support[supports.inclined.nodes] = others - supports.inclined.part(state.contact)
        return Solution(u, state.f, walls, contacts=model.links.count_held(held, len(u)))

    def _hold(self, balance: Balance, stiffness: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Set components of ``u`` (owned, 3) along directions to their values; return the forces (m, 3) that do so."""
        supports = self.model.supports
        inclined = supports.inclined
        before = u[inclined.nodes]
        inclined.clear(u)
        inclined.add(u, supports.lacking(balance.predictor, balance.time)[len(supports.nodes) :])
        return stiffness[inclined.nodes, None] * (u[inclined.nodes] - before)

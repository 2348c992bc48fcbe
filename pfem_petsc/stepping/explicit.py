"""Explicit steps with lumped mass: nodes are solved independently, contact by exact projection."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from ..errors import SimulationFailure
from ..integrators.base import Balance
from ..parallel.agreement import is_alone
from ..tolerances import BEYOND
from .compiled_steps import CompiledSteps
from .stepper import Solution, Stepper

if TYPE_CHECKING:
    from ..integrators.base import Scheme
    from .model import Model


class ExplicitStepper(Stepper):
    """Solves (alpha m + eta c) u = f_ext - f_int - m a_hat - c v_hat node by node; steps that nothing interrupts are
    made in compiled calls where these apply."""

    def __init__(self, model: Model, scheme: Scheme, h: float) -> None:
        super().__init__(model, scheme, h)
        self._nobody = np.empty(0, dtype=np.int64)
        self._compiled: CompiledSteps | None = None
        self._serves: bool | None = None  # whether compiled steps apply; None until it is known

    def steps(self, most: int) -> None:
        """See :class:`~pfem_petsc.stepping.stepper.Stepper`. The first step is made alone: the start may have stopped
        nodes."""
        ledger, state = self.ledger, self.state
        if self._serves is None:
            self._serves = ledger is not None and CompiledSteps.serves(self)
        if not self._serves or ledger.powers is None:
            if ledger is not None and ledger.powers is not None:
                ledger.end_compiled()
            self.step()
            if self._serves:
                ledger.begin_compiled()
            return
        if self._compiled is None:
            self._compiled = CompiledSteps(self)
        self._compiled.make(most, self.removals.steps_left(state.time, self.h))
        self.leave()
        state.step += 1

    def supports_changed(self) -> None:
        super().supports_changed()
        if self.model.supports.moves and self.ledger is not None and self.ledger.powers is not None:
            self.ledger.end_compiled()  # works of components that no longer move are over the ways between positions
        self.load_ended()

    def load_ended(self) -> None:
        self._compiled, self._serves = None, None

    @contextmanager
    def _faults(self, balance: Balance) -> Iterator[None]:
        """Record the first failure of this rank until ranks synchronise."""
        try:
            yield
        except SimulationFailure as failure:
            if is_alone():
                raise
            self.fault = SimulationFailure(f"{self.when(balance)}: {failure}")

    def solve(self, balance: Balance) -> Solution:
        model, state = self.model, self.state
        inertia, supports = model.inertia, model.supports
        stiffness, load = balance.alpha * inertia.mass, state.external - state.f[: len(state.v)]
        if balance.a_hat is not None:
            load -= inertia.mass[:, None] * balance.a_hat
        if inertia.damped:
            stiffness += balance.eta * inertia.damping
            load -= inertia.damping[:, None] * balance.v_hat
        u, state.contact = load / stiffness[:, None], self.zero
        if model.self_contact is not None:
            model.contact.pushes = model.self_contact.pushes(state.x, 0.0)
        if supports.any:
            supports.put(u, supports.lacking(balance.predictor, balance.time))
        walls, held, bodies = model.contact.nothing, self._nobody, model.contact.motion.bodies
        with self._faults(balance):
            model.links.find_explicit(balance, u)
            if bodies.any and model.links.walled:
                place = partial(self._place_coupled, balance, u, stiffness)
                model.contact.push_walls(place, stiffness, balance, coupled=True)
        with self._faults(balance):
            pushes = model.links.explicit(balance, state, u, stiffness)
            if pushes is not None:
                state.contact = state.contact.copy()
                model.links.push(pushes, stiffness, u, state.contact)
        if model.contact.any:
            # also after a failure of links: with walls with mass this is collective
            with self._faults(balance):
                pushing = balance if bodies.any and not model.links.walled else None
                arguments = balance.predictor, u, stiffness, balance.time, balance.acting, pushing
                held, force, walls = model.contact.explicit(*arguments)
                if len(held):
                    if state.contact is self.zero:
                        state.contact = np.zeros_like(u)
                    state.contact[held] += force
        if model.self_contact is not None:
            walls = model.self_contact.with_walls(walls, state.x, 0.0)
        if supports.any:
            state.support = supports.part(stiffness[:, None] * u - load - state.contact)
        return Solution(u, state.f, walls, contacts=model.links.count_held(held))

    def _place_coupled(self, balance: Balance, u: np.ndarray, stiffness: np.ndarray) -> np.ndarray:
        """Return the positions (owned, 3) that rows leave nodes with increments (owned, 3) at, with walls where they
        are. Collective."""
        links, moved = self.model.links, u.copy()
        before = links.state
        try:
            pushes = links.explicit(balance, self.state, u, stiffness)
        finally:
            links.state = before
        if pushes is not None:
            links.push(pushes, stiffness, moved, np.zeros_like(u))
        return balance.predictor + moved


class RedistributedStepper(Stepper):
    """Advances nodes with mass by the balance at t_n; massless nodes are in equilibrium along the normal at x_{n+1}.

    Each step needs a few additional evaluations of the bars, because the equilibrium of each contact node is found by a
    secant method.
    """

    def __init__(self, model: Model, scheme: Scheme, h: float) -> None:
        super().__init__(model, scheme, h)
        self.moved = model.inertia.redistribution
        self._trial = np.zeros_like(self.state.x)

    def solve(self, balance: Balance) -> Solution:
        model, state, moved = self.model, self.state, self.moved
        supports, owned = model.supports, model.mesh.n_owned
        load = state.external - state.f[:owned]
        state.contact, walls = self.massless.press(model, state.position, load, state.time)
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
        largest = self.massless.settle(model, x, balance.time, self.state.time)
        if not largest <= BEYOND * model.size:
            self.fault = SimulationFailure(
                f"{self.when(balance)}: contact nodes without mass found no equilibrium (last move {largest:.3g} "
                "m); reduce time.step or use another contact.treatment"
            )
        u[nodes] = x[nodes] - balance.predictor[nodes]

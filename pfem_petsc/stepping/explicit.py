"""Explicit steps with lumped mass: nodes are solved independently, contact by exact projection."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np

from ..errors import SimulationFailure
from ..integrators.base import Balance
from ..mechanics.compiled import kernel
from ..tolerances import BEYOND, PROJECTED
from .batch import Batch
from .stepper import Solution, Stepper

if TYPE_CHECKING:
    from ..integrators.base import Scheme
    from .model import Model


@kernel
def explicit_increments(forces, inertia, factors, known, stiffness, u):
    """Solve (alpha m + eta c) u = f_ext - f_int - m a_hat - c v_hat for every node.

    ``forces``: f_ext and f_int; ``inertia``: m and c (owned,); ``factors``: alpha and eta; ``known``: a_hat and v_hat.
    The first, a_hat and v_hat are (owned, 3), or (0, 3) for zero; ``stiffness`` (owned,) and ``u`` (owned, 3) are
    written.
    """
    external, f = forces
    mass, damping = inertia
    alpha, eta = factors
    a_hat, v_hat = known
    loaded = len(external) > 0
    carried = len(a_hat) > 0
    damped = len(v_hat) > 0
    for i in range(len(u)):
        stiffness[i] = alpha * mass[i] + (eta * damping[i] if damped else 0.0)
    if not (loaded or carried or damped):  # apart, because only loops without conditions are vectorised
        for i in range(len(u)):
            inverse = 1.0 / stiffness[i]
            u[i, 0] = -f[i, 0] * inverse
            u[i, 1] = -f[i, 1] * inverse
            u[i, 2] = -f[i, 2] * inverse
        return
    if not (carried or damped):
        for i in range(len(u)):
            inverse = 1.0 / stiffness[i]
            u[i, 0] = (external[i, 0] - f[i, 0]) * inverse
            u[i, 1] = (external[i, 1] - f[i, 1]) * inverse
            u[i, 2] = (external[i, 2] - f[i, 2]) * inverse
        return
    for i in range(len(u)):
        inverse = 1.0 / stiffness[i]
        for c in range(3):
            load = -f[i, c]
            if loaded:
                load += external[i, c]
            if carried:
                load -= mass[i] * a_hat[i, c]
            if damped:
                load -= damping[i] * v_hat[i, c]
            u[i, c] = load * inverse


@kernel
def hold(supports, predictor, stiffness, u, load):
    """Set prescribed components of ``u`` (owned, 3) to their values; ``load`` (k,) output: force that would move them
    [N]. ``supports``: nodes, components and positions (k,)."""
    nodes, components, positions = supports
    for k in range(len(nodes)):
        i, c = nodes[k], components[k]
        load[k] = stiffness[i] * u[i, c]
        u[i, c] = positions[k] - predictor[i, c]


@kernel
def react(supports, load, contact, stiffness, u, support):
    """Write support forces into ``support`` (owned, 3) [N], from the loads that :func:`hold` computed."""
    nodes, components, _ = supports
    for k in range(len(nodes)):
        i, c = nodes[k], components[k]
        support[i, c] = stiffness[i] * u[i, c] - load[k] - contact[i, c]


class ExplicitStepper(Stepper):
    """Solves (alpha m + eta c) u = f_ext - f_int - m a_hat - c v_hat node by node; steps that nothing interrupts are
    made in batches where these apply."""

    def __init__(self, model: Model, scheme: Scheme, h: float) -> None:
        super().__init__(model, scheme, h)
        self._none = np.empty((0, 3))
        self._nobody = np.empty(0, dtype=np.int64)
        self._batch: Batch | None = None
        self._batched: bool | None = None  # whether batches apply; None until it is known
        self._stiffness = np.empty_like(model.inertia.mass)

    def steps(self, most: int) -> None:
        """See :class:`~pfem_petsc.stepping.stepper.Stepper`. The first step is made alone: the start may have stopped
        nodes."""
        ledger, state = self.ledger, self.state
        if self._batched is None:
            self._batched = ledger is not None and Batch.serves(self)
        if not self._batched or ledger.powers is None:
            if ledger is not None and ledger.powers is not None:
                ledger.end_batches()
            self.step()
            if self._batched:
                ledger.begin_batches()
            return
        if self._batch is None:
            self._batch = Batch(self)
        self._batch.make(min(most, self.removals.steps_left(state.time, self.h)))
        self.leave()
        state.step += 1

    def supports_changed(self) -> None:
        super().supports_changed()
        self._batch, self._batched = None, None

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

    def solve(self, balance: Balance) -> Solution:
        model, state = self.model, self.state
        inertia = model.inertia
        u, stiffness = np.empty_like(state.v), self._stiffness
        forces = state.external if model.external.active else self._none, state.f
        known = (
            balance.a_hat if balance.a_hat is not None else self._none,
            balance.v_hat if inertia.damped else self._none,
        )
        factors = balance.alpha, balance.eta
        explicit_increments(forces, (inertia.mass, inertia.damping), factors, known, stiffness, u)
        supports = model.supports
        state.contact = self.zero
        if supports.any:
            load = np.empty(len(supports.nodes))
            if supports.inclined is not None:
                others = self._hold(balance, stiffness, u)
            positions = supports.positions(balance.time)[: len(supports.nodes)]
            held_at = supports.nodes, supports.components, positions
            hold(held_at, balance.predictor, stiffness, u, load)
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
            react(held_at, load, state.contact, stiffness, u, state.support)
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

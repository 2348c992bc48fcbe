"""Central differences with contact nodes that have no mass along their walls' normals."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from ..errors import SimulationFailure
from ..integrators.base import Balance
from .stepper import Solution, Stepper

__all__ = ["RedistributedStepper"]

_ITERATIONS = 200
_SOFTEST = 1e-4  # secant stiffness over the elastic one, or the other way round, that is taken for more than rounding


class RedistributedStepper(Stepper):
    """Nodes with mass step by the balance at t_n; those without are in equilibrium along the normal at x_{n+1} as well.

    Each step costs a few evaluations of the bars more than one without: the equilibrium of the contact nodes is found
    by each one's own secants.
    """

    def __init__(self, model, scheme, h: float) -> None:
        super().__init__(model, scheme, h)
        moved = model.inertia.redistribution
        self.moved = moved
        self._inverse = moved.inverse(model.inertia.mass, model.supports.fixed)
        self._trial = np.zeros_like(self.state.x)
        self._trial_force = np.zeros_like(self.state.f)

    def accelerate(self, load: np.ndarray) -> np.ndarray:
        a = load / self.model.inertia.mass[:, None]
        a[self.moved.touched] = np.einsum("kij,kj->ki", self._inverse, load[self.moved.touched])
        a[self.model.supports.fixed] = 0.0
        return a

    def solve(self, balance: Balance) -> Solution:
        model, state, moved = self.model, self.state, self.moved
        supports, owned = model.supports, model.mesh.n_owned
        load = state.external - state.f[:owned]
        # a node without mass that is in equilibrium feels its wall alone
        n, nodes = moved.normals, moved.nodes
        strength = -np.einsum("mi,mi->m", load[nodes], n)
        touching = self._gaps(state.position, state.time) <= 1e-12 * model.length
        strength = np.where(touching, np.maximum(strength, 0.0), 0.0) / moved.across
        full = model.contact.normals[moved.walls]
        state.contact = np.zeros_like(load)
        state.contact[nodes] = strength[:, None] * full
        pull = load + state.contact
        if supports.any:
            at = (supports.nodes, supports.components)
            held = np.zeros_like(load)
            held[at] = supports.positions(balance.time) - balance.predictor[at]
            # mass that is a matrix couples the free components to those that supports move
            pull[moved.touched] -= balance.alpha * np.einsum("kij,kj->ki", moved.tensors, held[moved.touched])
        u = self.accelerate(pull) / balance.alpha
        if supports.any:
            u[at] = held[at]
        self._equilibrium(balance, u)
        state.support = np.zeros_like(u)
        if supports.any:
            inertia = model.inertia.mass_times(balance.alpha * u, np.empty_like(u))
            state.support[at] = (inertia - load - state.contact)[at]
        walls = model.contact.nothing
        if len(nodes):
            touched = np.zeros((len(nodes), len(model.contact.names)), dtype=bool)
            touched[np.arange(len(nodes)), moved.walls] = strength > 0.0
            force = touched[:, :, None] * (strength[:, None] * full)[:, None, :]
            walls = model.contact.sums(nodes, force, state.position[nodes], touched)
        return Solution(u, state.f, walls, contacts=int((strength > 0.0).sum()))

    def _gaps(self, x: np.ndarray, time: float) -> np.ndarray:
        """How far the contact nodes (m,) can move along their vectors until they are on the wall [m]."""
        gaps = self.model.contact.gaps(x[self.moved.nodes], time, self.moved.nodes)
        return gaps[np.arange(len(gaps)), self.moved.walls] / self.moved.across

    def _equilibrium(self, balance: Balance, u: np.ndarray) -> None:
        """Move the contact nodes along their normals until they are in equilibrium or on the wall. Collective."""
        model, moved = self.model, self.moved
        owned, nodes, n = model.mesh.n_owned, moved.nodes, moved.normals
        external = np.zeros_like(u)
        if model.external.active:
            model.external.at(balance.time, external)
        elastic = self._stiffness()
        stiffness, force, step = elastic, np.full(len(nodes), np.nan), np.zeros(len(nodes))
        x = self._trial
        x[:owned] = balance.predictor + u
        for _ in range(_ITERATIONS):
            gap = self._gaps(x[:owned], balance.time)
            x[nodes] -= np.minimum(gap, 0.0)[:, None] * n
            model.mesh.update_ghosts(x)
            model.bars.forces(x, self._trial_force, commit=False)
            last, force = force, np.einsum("mi,mi->m", external[nodes] - self._trial_force[nodes], n)
            with np.errstate(invalid="ignore", divide="ignore"):
                secant = (last - force) / step
            # where bars yield or turn, the elastic stiffness would take hundreds of moves
            stiffness = np.where((secant > _SOFTEST * elastic) & (secant < elastic / _SOFTEST), secant, elastic)
            step = np.maximum(force / stiffness, -np.maximum(gap, 0.0))
            x[nodes] += step[:, None] * n
            largest = model.comm.allreduce(float(np.abs(step).max(initial=0.0)), op=MPI.MAX)
            if largest <= 1e-14 * model.length:
                break
        else:
            if not largest <= 1e-9 * model.length and self.fault is None:
                self.fault = SimulationFailure(
                    f"{self.when(balance)}: contact nodes without mass found no equilibrium (last move {largest:.3g} "
                    "m); take a smaller time.step or another contact.treatment"
                )
        u[nodes] = x[nodes] - balance.predictor[nodes]

    def _stiffness(self) -> np.ndarray:
        """Stiffness (m,) of the contact nodes along their normals, their neighbours at rest [N/m]."""
        mesh, model = self.model.mesh, self.model
        x = self.state.x
        a, b = mesh.bars.T
        total = np.zeros(mesh.n_local)
        normal = np.zeros((mesh.n_local, 3))
        normal[self.moved.nodes] = self.moved.normals
        way = x[b] - x[a]
        length = np.linalg.norm(way, axis=1)
        axial = np.concatenate(
            [np.full(k.stop - k.start, k.area * k.parameters[0]) for k in model.bars.blocks] or [np.zeros(0)]
        )
        for end in (a, b):
            along = np.einsum("bi,bi->b", way, normal[end]) / length
            np.add.at(total, end, axial / model.bars.rest * along * along)
        return total[self.moved.nodes]

"""The velocity update of Laursen and Love (2002): contact does no work, step by step.

The normal velocity of a node in contact is changed such that it cancels the work W of contact: m (v+^2 - v^2)/2 = -W,
away from the wall. Its acceleration is the one without contact, so that this contact force does not affect the next
step. If W is positive and exceeds the energy of the node, the remainder is cancelled in later steps. For a contact pair
the same holds with the relative velocity and reduced mass of its nodes; the remainder is stored at its second node. For
schemes whose balance holds at x_{n+1}.
"""

from __future__ import annotations

import numpy as np

from ...integrators.base import Scheme
from ...registry import choices, lookup
from .base import Treatment as Base

INTEGRATORS = "pfem_petsc.integrators"


class Treatment(Base):
    """Sets the velocity of nodes in contact such that contact does no work."""

    elastic = True

    @classmethod
    def refuses(cls, scheme: Scheme) -> str | None:
        """See :class:`~pfem_petsc.contact.treatments.base.Treatment`."""
        if scheme.force_acts_once:
            return None
        schemes = {name: lookup(INTEGRATORS, name, "").Scheme for name in choices(INTEGRATORS)}
        suited = ", ".join(name for name, one in schemes.items() if one.force_acts_once)
        return f"it is compatible with the integrators {suited} only; choose one of them, or another treatment"

    def before(self) -> None:
        """Record the initial positions of nodes and the forces there."""
        state = self.stepper.state
        self._start = state.position.copy()
        change = state.memory.get("contact_change")
        self._force = state.contact if change is None else state.contact + change

    def after(self) -> None:
        """See :class:`~pfem_petsc.contact.treatments.base.Treatment`."""
        self.clear()
        state = self.stepper.state
        debt = state.memory.setdefault("contact_debt", np.zeros_like(state.v))
        nodes, v, a = self._off_walls(debt)
        if self.stepper.model.links.any_pressed():
            ends, apart, free = self._apart(debt)
            nodes, v, a = np.append(nodes, ends), np.vstack([v, apart]), np.vstack([a, free])
        if len(nodes):
            self.set(nodes, v, a)

    def _work(self, nodes: np.ndarray, way: np.ndarray | float = 0.0) -> np.ndarray:
        """Return the work (m,) [J] of contact on nodes (m,) in this part of the step, beyond that of walls that move by
        ``way`` (m, 3) [m]: what moving walls give is transferred, not lost."""
        state = self.stepper.state
        force = state.contact[nodes]
        if self.stepper.scheme.balance_at_endpoints:
            force = 0.5 * (force + self._force[nodes])
        return np.einsum("mi,mi->m", force, state.position[nodes] - self._start[nodes] - way)

    def _accelerations(self, nodes: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """Return accelerations (m, 3), without contact along the range of projections (m, 3, 3)."""
        state = self.stepper.state
        free = (state.external - state.f[: len(state.a)])[nodes] / self.stepper.model.inertia.mass[nodes, None]
        free = np.where(self.stepper.model.supports.fixed[nodes], state.a[nodes], free)
        return state.a[nodes] + np.einsum("mij,mj->mi", normal, free - state.a[nodes])

    def _off_walls(self, debt: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return nodes in contact with walls (m,), their velocities and accelerations (m, 3)."""
        stepper, state = self.stepper, self.stepper.state
        nodes, normal, speed = self.held()
        if len(nodes) == 0:  # there may be no wall at all
            return nodes, speed, speed
        mass = stepper.model.inertia.mass[nodes]
        # forces act along other normals than those at the end; several walls move a node along all of theirs
        rates = stepper.model.contact.rates(state.position[nodes], state.time)
        first = rates[np.arange(len(nodes)), stepper.touching[nodes].argmax(axis=1)]
        carried = first + speed - np.einsum("mij,mj->mi", normal, first)
        work = self._work(nodes, stepper.part * carried) + debt[nodes, 0]
        push = np.einsum("mij,mj->mi", normal, state.contact[nodes])
        out = push / np.maximum(np.linalg.norm(push, axis=1), 1e-300)[:, None]
        v = state.v[nodes]
        across = v - np.einsum("mij,mj->mi", normal, v)
        relative = np.einsum("mij,mj->mi", normal, v) - speed
        square = (relative * relative).sum(axis=1) - 2.0 * work / mass
        debt[nodes, 0] = np.where(square < 0.0, -0.5 * mass * square, 0.0)
        v = across + speed + np.sqrt(np.maximum(square, 0.0))[:, None] * out
        return nodes, v, self._accelerations(nodes, normal)

    def _apart(self, debt: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return nodes in contact through pairs (m,), their velocities and accelerations (m, 3). Collective."""
        state, links, mass = self.stepper.state, self.stepper.model.links, self.stepper.model.inertia.mass
        two = links.two
        nodes, normals = two.pressed(links.force)
        work = np.zeros(len(state.v))
        work[nodes] = self._work(nodes)
        ends = two.gather(np.column_stack([state.v, work, debt[:, 0]]))
        reduced = two.reduced_mass(mass)
        square = two.apart(ends[:, :, :3]) ** 2
        square -= 2.0 * (ends[0, :, 3] + ends[1, :, 3] + ends[1, :, 4]) / reduced
        mine = two.counted & (links.force > 0.0)
        debt[two.nodes[1, mine], 0] = np.where(square < 0.0, -0.5 * reduced * square, 0.0)[mine]
        v = two.together(state.v, mass, links.force > 0.0, np.sqrt(np.maximum(square, 0.0)))[nodes]
        return nodes, v, self._accelerations(nodes, normals[:, :, None] * normals[:, None, :])

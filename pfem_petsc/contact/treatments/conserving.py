"""The velocity update of Laursen and Love (2002): contact does no work, step by step.

The normal velocity of a held node takes back the work W that contact did on it: m (v+^2 - v^2)/2 = -W, away from the
wall. Its acceleration is the one without contact, so that the next step knows nothing of this contact force. Where W is
positive and more than the node's energy, what is left is taken back in the steps to come. For schemes whose balance
holds at x_{n+1}.
"""

from __future__ import annotations

import numpy as np

from .base import Treatment as Base

__all__ = ["Treatment"]


class Treatment(Base):
    """Velocity of held nodes such that contact does no work."""

    def before(self) -> None:
        """Keep where nodes start, and the forces there."""
        state = self.stepper.state
        self._start = state.position.copy()
        change = state.memory.get("contact_change")
        self._force = state.contact if change is None else state.contact + change

    def after(self) -> None:
        """See :class:`~pfem_petsc.contact.treatments.base.Treatment`."""
        self.clear()
        stepper, state, inertia = self.stepper, self.stepper.state, self.stepper.model.inertia
        debt = state.memory.setdefault("contact_debt", np.zeros_like(state.v))
        nodes, normal, speed = self.held()
        held = np.zeros(len(state.v), dtype=bool)
        held[nodes] = True
        owing = np.flatnonzero((debt[:, 0] != 0.0) & ~held)
        if len(nodes) == 0 and len(owing) == 0:
            return
        mass = inertia.mass[nodes]
        way = state.position[nodes] - self._start[nodes]
        if stepper.scheme.at_ends:
            work = 0.5 * np.einsum("mi,mi->m", state.contact[nodes] + self._force[nodes], way)
        else:
            work = np.einsum("mi,mi->m", state.contact[nodes], way)
        # work on a wall that moves is work done, not lost
        work -= np.einsum("mi,mi->m", state.contact[nodes], speed) * stepper.part
        work += debt[nodes, 0]
        push = np.einsum("mij,mj->mi", normal, state.contact[nodes])
        out = push / np.maximum(np.linalg.norm(push, axis=1), 1e-300)[:, None]
        v = state.v[nodes]
        across = v - np.einsum("mij,mj->mi", normal, v)
        relative = np.einsum("mij,mj->mi", normal, v) - speed
        square = (relative * relative).sum(axis=1) - 2.0 * work / mass
        debt[nodes, 0] = np.where(square < 0.0, -0.5 * mass * square, 0.0)
        v = across + speed + np.sqrt(np.maximum(square, 0.0))[:, None] * out
        owned = stepper.model.mesh.n_owned
        free = (state.external[nodes] - state.f[:owned][nodes]) / mass[:, None]
        a = state.a[nodes]
        a = a + np.einsum("mij,mj->mi", normal, free - a)
        self.set(nodes, v, a)

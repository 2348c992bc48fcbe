"""Restitution by a jump of velocity, for schemes whose state at the end of a step holds its position and velocity.

A node that touches a wall in this step and did not in the one before has closed: its normal velocity relative to the
wall becomes -e times that at the impact, and its acceleration the one without contact, so that it leaves. The impact
happened within the step: with the velocity v and acceleration a towards the wall at its start, at a distance d, it had
sqrt(v^2 + 2 a d), which keeps the energy of a falling node whatever the step. One that is pressed for longer has the
wall's velocity and no acceleration, as with ``stick``. The energy that is lost, (1 - e^2) of that of the approach, is
work of contact.

This is the treatment of walls with restitution where the others are left to the scheme.
"""

from __future__ import annotations

import numpy as np

from .base import Treatment as Base

__all__ = ["Treatment"]

_STILL = 1e-13  # of the model's length: a slip that is rounding


class Treatment(Base):
    """Nodes that close against walls with restitution leave them."""

    def before(self) -> None:
        """Keep who touches what, and how nodes move."""
        self._touched = self.stepper.touching.copy()
        contact, state = self.stepper.model.contact, self.stepper.state
        if contact.rough or contact.restitution.any():
            self._time, self._place = state.time, state.position.copy()
        if not contact.restitution.any():
            return
        self._speed = state.v
        self._free = self._without_contact(np.arange(len(state.v)))

    def _without_contact(self, nodes: np.ndarray) -> np.ndarray:
        """Accelerations (m, 3) of nodes by all forces but those of contact [m/s2]."""
        state, inertia = self.stepper.state, self.stepper.model.inertia
        load = state.external[nodes] - state.f[nodes]
        if inertia.damped:
            load -= inertia.damping[nodes, None] * state.v[nodes]
        return load / inertia.mass[nodes, None]

    def after(self) -> None:
        """See :class:`~pfem_petsc.contact.treatments.base.Treatment`."""
        self.clear()
        nodes, v, a = self.on_walls(self.stepper.model.contact.restitution > 0.0)
        if len(nodes):
            self.set(nodes, v, a)

    def leaving(self, nodes: np.ndarray, touching: np.ndarray, normals: np.ndarray, rates: np.ndarray) -> np.ndarray:
        """See :class:`~pfem_petsc.contact.treatments.base.Treatment`."""
        contact = self.stepper.model.contact
        if not contact.restitution.any():
            return np.zeros(touching.shape)
        moved = self._moved(nodes)
        speed = np.einsum("mwi,mwi->mw", normals, self._speed[nodes][:, None, :] - rates)
        distance = np.maximum(-np.einsum("mwi,mwi->mw", normals, moved), 0.0)
        towards = -np.einsum("mwi,mi->mw", normals, self._free[nodes])
        impact = np.sqrt(np.maximum(speed * speed + 2.0 * towards * distance, 0.0))
        fresh = touching & ~self._touched[nodes]
        return np.where(fresh & (speed < 0.0), contact.restitution * impact, 0.0)

    def sticking(self, nodes: np.ndarray, touching: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """See :class:`~pfem_petsc.contact.treatments.base.Treatment`."""
        model = self.stepper.model
        if not model.contact.rough:
            return np.zeros(touching.shape, dtype=bool)
        slip = self._moved(nodes)
        slip -= np.einsum("mwi,mwi->mw", slip, normals)[:, :, None] * normals
        still = np.linalg.norm(slip, axis=2) <= _STILL * model.length
        return touching & still & (model.contact.static_friction > 0.0)

    def _moved(self, nodes: np.ndarray) -> np.ndarray:
        """How nodes (m,) moved in this step relative to the walls (m, w, 3) [m]."""
        contact, state = self.stepper.model.contact, self.stepper.state
        way = contact.motion.shifts(state.time) - contact.motion.shifts(self._time)
        return (state.position[nodes] - self._place[nodes])[:, None, :] - way

    def on_walls(self, concerned: np.ndarray | bool = True) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Nodes that walls hold (m,), and velocities and accelerations (m, 3) that they get [m/s], [m/s2]."""
        state, model = self.stepper.state, self.stepper.model
        nodes, normal, speed = self.held(concerned)
        v, a = state.v[nodes], state.a[nodes]
        v = v - np.einsum("mij,mj->mi", normal, v) + speed
        a = a - np.einsum("mij,mj->mi", normal, a)
        if not model.contact.restitution.any():
            return nodes, v, a
        touching = np.zeros_like(self._touched)
        touching[self.stepper.solution.walls.nodes] = self.stepper.solution.walls.touching
        closed = touching & ~self._touched & (model.contact.restitution > 0.0)
        leaves = closed[nodes].any(axis=1)
        if leaves.any():
            a[leaves] += np.einsum("mij,mj->mi", normal[leaves], self._without_contact(nodes[leaves]))
        return nodes, v, a

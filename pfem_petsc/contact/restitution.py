"""Restitution by a velocity jump, for schemes whose state at the end of a step contains its position and velocity.

A node that touches a wall in this step and did not in the one before has closed. Its normal velocity relative to the
wall becomes -e times that at the impact, and its acceleration the one without contact, so that it leaves. The impact
happens within the step: with the velocity v towards the wall at the start of the step and the distance d, the impact
velocity is sqrt(v^2 + (a0 + a1) d), where a0 and a1 are the accelerations without the wall at both ends of the step.
The added term is the work of the forces, so a falling node conserves energy for any step, and no energy appears that
the bars have not released. For explicit schemes see :mod:`~pfem_petsc.contact.rebound`. A node in contact for more than
one step has the velocity of the wall and no acceleration, as with ``stick``. The energy lost, (1 - e^2) of that of the
approach, is work of contact.

This treatment applies to walls with restitution when other walls are left to the scheme.
"""

from __future__ import annotations

import numpy as np

from .rebound import impact_square, rebound_way
from .treatments.base import Treatment as Base

__all__ = ["STILL", "Treatment"]

STILL = 1e-13  # of the model's length: a slip that is rounding
_NONE = 1e-9  # of a force: what of it is rounding, and of the tolerance of the solve


class Treatment(Base):
    """Makes nodes that close on walls with restitution leave them.

    ``everywhere`` : whether the treatment applies to walls without restitution too.
    """

    everywhere = False

    def before(self) -> None:
        """Record contacts and the motion of nodes."""
        self._touched = self.stepper.touching.copy()
        contact, state = self.stepper.model.contact, self.stepper.state
        scheme = self.stepper.scheme
        # nodes in whose first free step the old wall force still does work
        self._frees = scheme.balance_at_endpoints and not scheme.solves_next_position
        if self._frees or contact.has_friction or contact.restitution.any():
            self._time, self._place = state.time, state.position.copy()
        if self._frees:
            mine = self._touched if self.everywhere else self._touched & (contact.restitution > 0.0)
            self._held = np.flatnonzero(mine.any(axis=1))
            change = state.memory.get("contact_change")
            pressed = state.contact[self._held]
            self._force = pressed + (0.0 if change is None else change[self._held])
            # a node that leaves by restitution has had its force removed up to rounding
            none = np.linalg.norm(self._force, axis=1) <= _NONE * np.linalg.norm(pressed, axis=1)
            self._force[none] = 0.0
        if not contact.restitution.any():
            return
        self._speed = state.v
        if not scheme.explicit:
            self._free = self._without_contact(np.arange(len(state.v)))

    def _without_contact(self, nodes: np.ndarray) -> np.ndarray:
        """Return accelerations (m, 3) of nodes without contact forces [m/s2], zero in prescribed components."""
        state, inertia = self.stepper.state, self.stepper.model.inertia
        load = state.external[nodes] - state.f[nodes]
        if inertia.damped:
            load -= inertia.damping[nodes, None] * state.v[nodes]
        load[self.stepper.model.supports.fixed[nodes]] = 0.0
        return load / inertia.mass[nodes, None]

    def after(self) -> None:
        """See :class:`~pfem_petsc.contact.treatments.base.Treatment`."""
        self.clear()
        nodes, v, a = self.on_walls(self.stepper.model.contact.restitution > 0.0)
        self.put(nodes, v, a)

    def put(self, nodes: np.ndarray, v: np.ndarray, a: np.ndarray) -> None:
        """Set velocities and accelerations (m, 3) of nodes (m,) in contact and of those just released."""
        gone, slower = self._let_go()
        if len(gone):
            nodes, v, a = np.append(nodes, gone), np.vstack([v, slower]), np.vstack([a, self.stepper.state.a[gone]])
        if len(nodes):
            self.set(nodes, v, a)

    def _let_go(self) -> tuple[np.ndarray, np.ndarray]:
        """Return nodes (m,) of this treatment that walls released in this step, and their velocities (m, 3).

        With schemes whose forces do work by the trapezoidal rule, the contact force at the start of the step would do
        work on the released node. This work is removed from the velocity away from the wall.
        """
        state, stepper = self.stepper.state, self.stepper
        if not self._frees or not len(self._held):
            return np.empty(0, dtype=np.int64), np.empty((0, 3))
        left = ~stepper.touching[self._held].any(axis=1)
        gone, force = self._held[left], self._force[left]
        walls = self._touched[gone].argmax(axis=1)
        motion = stepper.model.contact.motion
        way = (motion.displacements(state.time) - motion.displacements(self._time))[walls]
        rate = motion.rates(state.time)[walls]
        work = 0.5 * np.einsum("mi,mi->m", force, state.position[gone] - self._place[gone] - way)
        away = force / np.maximum(np.linalg.norm(force, axis=1), 1e-300)[:, None]
        speed = np.einsum("mi,mi->m", away, state.v[gone] - rate)
        left = (work > 0.0) & (speed > 0.0)
        gone, away, speed, work = gone[left], away[left], speed[left], work[left]
        slower = np.sqrt(np.maximum(speed * speed - 2.0 * work / stepper.model.inertia.mass[gone], 0.0))
        return gone, state.v[gone] + (slower - speed)[:, None] * away

    def leaving(self, nodes: np.ndarray, touching: np.ndarray, normals: np.ndarray, rates: np.ndarray) -> np.ndarray:
        """See :class:`~pfem_petsc.contact.treatments.base.Treatment`."""
        contact = self.stepper.model.contact
        if not contact.restitution.any():
            return np.zeros(touching.shape)
        distance = np.maximum(-np.einsum("mwi,mwi->mw", normals, self._moved(nodes)), 0.0)
        fresh = touching & ~self._touched[nodes]
        if self.stepper.scheme.explicit:
            return np.where(fresh, self._explicit_rebound(nodes, distance, normals), 0.0)
        speed = np.einsum("mwi,mwi->mw", normals, self._speed[nodes][:, None, :] - rates)
        towards = -np.einsum("mwi,mi->mw", normals, self._free[nodes] + self._without_contact(nodes))
        impact = np.sqrt(np.maximum(speed * speed + towards * distance, 0.0))
        return np.where(fresh & (speed < 0.0), contact.restitution * impact, 0.0)

    def _explicit_rebound(self, nodes: np.ndarray, distance: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Return velocities (m, w) at which nodes leave walls hit after a distance (m, w); see :meth:`leaving`.

        The displacements without walls follow from the balance of the step.
        """
        stepper, state, h = self.stepper, self.stepper.state, self.stepper.part
        contact, balance, mass = stepper.model.contact, stepper.balance, stepper.model.inertia.mass[nodes, None]
        push = np.where(stepper.model.supports.fixed[nodes], 0.0, state.contact[nodes]) / mass
        way = contact.motion.displacements(state.time) - contact.motion.displacements(self._time)
        moved = (state.position[nodes] - self._place[nodes] - push / balance.alpha)[:, None, :] - way
        known = 0.0 if balance.a_hat is None else balance.a_hat[nodes]
        free = balance.alpha * stepper.solution.u[nodes] + known - push
        approach, before, after = (
            -np.einsum("mwi,mwi->mw", normals, array)
            for array in (moved, h * h * free[:, None, :], h * h * self._without_contact(nodes)[:, None, :])
        )
        return rebound_way(contact.restitution, impact_square(approach, distance, before), distance, after) / h

    def sticking(self, nodes: np.ndarray, touching: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """See :class:`~pfem_petsc.contact.treatments.base.Treatment`."""
        model = self.stepper.model
        if not model.contact.has_friction:
            return np.zeros(touching.shape, dtype=bool)
        slip = self._moved(nodes)
        slip -= np.einsum("mwi,mwi->mw", slip, normals)[:, :, None] * normals
        still = np.linalg.norm(slip, axis=2) <= STILL * model.size
        return touching & still & (model.contact.static_friction > 0.0)

    def _moved(self, nodes: np.ndarray) -> np.ndarray:
        """Return displacements of nodes (m,) in this step relative to the walls (m, w, 3) [m]."""
        contact, state = self.stepper.model.contact, self.stepper.state
        way = contact.motion.displacements(state.time) - contact.motion.displacements(self._time)
        return (state.position[nodes] - self._place[nodes])[:, None, :] - way

    def on_walls(self, applicable: np.ndarray | bool = True) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return nodes in contact with walls (m,), and their new velocities and accelerations (m, 3) [m/s], [m/s2]."""
        state, model = self.stepper.state, self.stepper.model
        nodes, normal, speed = self.held(applicable)
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

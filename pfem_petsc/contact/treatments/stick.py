"""Nodes in contact move with the wall: their normal velocity is the wall's, and their normal acceleration is zero.

For nodes that stick by friction, and for tied nodes, this holds in all directions. The nodes of a contact pair in
contact move together, with the normal velocity that conserves their momentum.

On closure a node loses the kinetic energy of its approach, m v_n^2/2, an O(element length) part of the total. On
release it starts from rest, and the wall does no work on it. At a wall with restitution e a node that closes leaves
with e times the velocity of its approach and loses (1 - e^2) of that energy; see
:mod:`~pfem_petsc.contact.restitution`.
"""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from ..restitution import Treatment as Restitution

__all__ = ["Treatment"]


class Treatment(Restitution):
    """Sets velocity and acceleration of nodes in contact to those of the wall."""

    everywhere = True
    serves = ("tied", "friction", "restitution")

    def before(self) -> None:
        """Also record the positions and forces of pairs in contact."""
        super().before()
        state, pairs = self.stepper.state, self.stepper.model.pairs
        self._pressed = None
        if self._frees and pairs is not None and pairs.any_pressed():
            change = state.memory.get("contact_change", 0.0)
            ends = pairs.gather(np.concatenate([state.contact + change, state.position], axis=1))
            force = 0.5 * pairs.distances(ends[:, :, :3])  # half the relative force between the ends
            self._pressed = pairs.force > 0.0, force, pairs.distances(ends[:, :, 3:])

    def after(self) -> None:
        """See :class:`~pfem_petsc.contact.treatments.base.Treatment`."""
        self.clear()
        state = self.stepper.state
        nodes, v, a = self.on_walls()
        pairs, mass = self.stepper.model.pairs, self.stepper.model.inertia.mass
        if pairs is not None and pairs.any_pressed():
            ends, _ = pairs.pressed()
            nodes = np.append(nodes, ends)
            v = np.vstack([v, pairs.together(state.v, mass)[ends]])
            a = np.vstack([a, pairs.together(state.a, mass)[ends]])
        if self._pressed is not None:
            ends, slower = self._pairs_let_go()
            nodes, v, a = np.append(nodes, ends), np.vstack([v, slower]), np.vstack([a, state.a[ends]])
        self.put(nodes, v, a)

    def _pairs_let_go(self) -> tuple[np.ndarray, np.ndarray]:
        """Return ends (m,) of pairs that opened in this step, and their velocities (m, 3); see :meth:`_let_go`.

        Collective.
        """
        state, pairs, mass = self.stepper.state, self.stepper.model.pairs, self.stepper.model.inertia.mass
        pressed, force, before = self._pressed
        gone = pressed & ~(pairs.force > 0.0)
        if not self.stepper.model.comm.allreduce(bool(gone.any()), op=MPI.LOR):
            return np.empty(0, dtype=np.int64), np.empty((0, 3))
        ends = pairs.gather(np.concatenate([state.position, state.v], axis=1))
        work = 0.5 * force * (pairs.distances(ends[:, :, :3]) - before)
        speed = pairs.distances(ends[:, :, 3:])
        gone &= (work > 0.0) & (speed > 0.0)
        slower = np.sqrt(np.maximum(speed * speed - 2.0 * work / pairs.reduced_mass(mass), 0.0))
        ends = pairs.local[pairs.mine & gone]
        return ends, pairs.together(state.v, mass, slower, gone)[ends]

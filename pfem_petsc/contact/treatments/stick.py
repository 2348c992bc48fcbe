"""Held nodes move with the wall: their normal velocity is the wall's, and they are not accelerated.

Where friction keeps them from slipping, or a tied wall, that holds in all directions.

The nodes of a pressed contact pair move on together: their normal velocity is the one that keeps their momentum.

On closure a node loses the kinetic energy of its approach, m v_n^2/2, an O(element length) part of the whole; on
release it starts from rest, and the wall does no work on it. At a wall with restitution e a node that closes leaves
with e times the velocity of its approach, and loses (1 - e^2) of that energy: see
:mod:`~pfem_petsc.contact.treatments.restitution`.
"""

from __future__ import annotations

import numpy as np

from .restitution import Treatment as Restitution

__all__ = ["Treatment"]


class Treatment(Restitution):
    """Velocity and acceleration of held nodes as those of the wall."""

    everywhere = True

    def after(self) -> None:
        """See :class:`~pfem_petsc.contact.treatments.base.Treatment`."""
        self.clear()
        state = self.stepper.state
        nodes, v, a = self.on_walls()
        pairs, mass = self.stepper.model.pairs, self.stepper.model.inertia.mass
        if pairs is not None and pairs.force.any():
            ends, _ = pairs.pressed()
            nodes = np.append(nodes, ends)
            v = np.vstack([v, pairs.together(state.v, mass)[ends]])
            a = np.vstack([a, pairs.together(state.a, mass)[ends]])
        self.put(nodes, v, a)

"""Held nodes have the mean normal velocity of the step, and no normal acceleration.

A node that reaches its wall within a step has the velocity (x1 - x0)/h at its end, and that of the wall one step later.
"""

from __future__ import annotations

import numpy as np

from pfem_petsc.contact.treatments.base import Treatment as Base

__all__ = ["Treatment"]


class Treatment(Base):
    """Normal velocity of held nodes from their displacement in the step."""

    def before(self) -> None:
        """Keep where nodes start."""
        self._start = self.stepper.state.position.copy()

    def after(self) -> None:
        """See :class:`~pfem_petsc.contact.treatments.base.Treatment`."""
        self.clear()
        state = self.stepper.state
        nodes, normal, _ = self.held()
        if len(nodes):
            mean = (state.position[nodes] - self._start[nodes]) / self.stepper.part
            v = state.v[nodes] + np.einsum("mij,mj->mi", normal, mean - state.v[nodes])
            a = state.a[nodes] - np.einsum("mij,mj->mi", normal, state.a[nodes])
            self.set(nodes, v, a)

"""The energy ledger of central differences, whose works are sums over balances.

With equal steps h a node moves by dx = h v - h^2 a/2 before a balance and by h v + h^2 a/2 after it. The trapezoidal
work of forces g over the steps from 0 to n is then a sum over balances, h g . v, in which the last one counts by
g . dx/2 alone; this needs the forces of one instant at a time. The work of inertia is the change of m v . v/2 less that
of h^2/8 m a . a. So the numerical dissipation of steps 0 to n is

    sum of h f . v + f . dx/2 (internal forces) - change of the energies of the bars
        - change of h^2/8 m a . a - works of contact in excess of its losses,

the terms of :mod:`~pfem_petsc.stepping.ledger` in another order. The fused loop, which makes many steps in one call,
computes the same sums in the same order. It applies where scheme and contact alone move the nodes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from ..output.sums import HEAD
from .balance_loops import DAMPING, EXTERNAL, INERTIAL, book_balance, book_row, new_sums
from .book_loops import WORKS, new_lanes
from .ledger import Ledger
from .moment import Moment, moment_of
from .sum_loops import add_totals, fill_works

if TYPE_CHECKING:
    from .stepper import Stepper

__all__ = ["LeapfrogLedger", "make_ledger"]

_EXTERNAL, _DAMPING = HEAD.first("external_work"), HEAD.first("damping_dissipation")
_IMPACT, _NUMERICAL = HEAD.first("impact_dissipation"), HEAD.first("numerical_dissipation")
_KINETIC = HEAD.first("kinetic_energy")
_NOTHING = np.empty((0, 3))


def make_ledger(stepper: Stepper) -> Ledger:
    """Return the ledger for the steps of a run or stage, after the start of the stepper. Collective."""
    leapfrog = stepper.scheme.leapfrog and stepper.steady and stepper.treatment is None
    same = stepper.model.comm.allreduce(leapfrog and stepper.model.constant, op=MPI.LAND)
    return (LeapfrogLedger if same else Ledger)(stepper)


class LeapfrogLedger(Ledger):
    """Accumulates works balance by balance, from the second step on.

    Attributes
    ----------
    powers : (5,) works of all balances up to the present one, in the order of ``WORKS`` [J]; at the place of inertia is
        the constant that continues the numerical dissipation of what came before
    """

    def __init__(self, stepper: Stepper) -> None:
        self.powers = np.zeros(len(WORKS))
        self.begun = False
        super().__init__(stepper)
        self._ends = np.zeros(len(WORKS))
        self._lanes, self._room = new_sums(), new_lanes()
        self._complete = True
        # bars that are removed after a step change the forces of its end
        self._at_once = bool(stepper.model.case.remove)

    def update(self) -> None:
        """Add the last step."""
        stepper = self.stepper
        if not self.begun:  # the start may have stopped nodes
            super().update()
            self._sum_row(self._before)
            self._begin()
            self._sum_balance(self._before)
            return
        before, self._before = self._before, moment_of(stepper)
        self._works[:] = self.powers
        self._sum_balance(self._before)
        self.impulses.step(self._totals[3:])
        impact, _ = self._dissipated(before)
        self.sums[_IMPACT] += impact
        self._complete = False
        if self._at_once:
            self.complete()

    def complete(self) -> None:
        """Compute what only rows and checkpoints need of the last step."""
        if self._complete:
            return
        present, self._complete = self._before, True
        self.sums[_KINETIC] = present.kinetic = self._sum_row(present)
        add_totals(self.sums, self._totals)
        self.impulses.fill(self.sums)
        fill_works(self.sums, self._works, self._ends, present.energy.total)

    def _sum_row(self, present: Moment) -> float:
        """Return the kinetic energy [J]; compute totals and the works of half a step."""
        state, model = self.stepper.state, self.model
        external, contact = self._one(present.external), self._one(present.contact)
        loads = (present.internal, external, self._damping, contact)
        room = (self._lanes, self._room, self._totals, self._ends)
        return book_row(state.position, model.inertia.mass, state.v, state.a, *loads, self.stepper.h, *room)

    def _sum_balance(self, present: Moment) -> None:
        """Add the works of the present balance."""
        external, support, contact = (self._one(of) for of in (present.external, present.support, present.contact))
        loads = (present.internal, external, self._damping, support, contact)
        book_balance(*loads, self.stepper.state.v, self.stepper.h, self._totals, self.powers)

    def _one(self, array: np.ndarray) -> np.ndarray:
        """Return an array, or the placeholder for an array of zeros."""
        return _NOTHING if array is self.stepper.zero else array

    def _begin(self) -> None:
        """Continue the works of the steps before."""
        sums, ends = self.sums, self._ends
        self.powers[:] = -ends
        self.powers[EXTERNAL] += sums[_EXTERNAL]
        self.powers[DAMPING] += sums[_DAMPING]
        self.begun = True
        self.powers[INERTIAL] = sums[_NUMERICAL] + ends[INERTIAL] + self.stepper.energy.total + sums[_IMPACT]

    def follow_removal(self) -> None:
        """Take account of the energy of bars that were removed."""
        self.powers[INERTIAL] += self.stepper.energy.total - self._before.energy.total
        super().follow_removal()

    def resume(self, kinetic: float) -> None:
        """See :class:`~pfem_petsc.stepping.ledger.Ledger`."""
        super().resume(kinetic)
        self._complete = True

    def kept(self) -> dict[str, Any]:
        """Return this rank's share for a checkpoint: numbers that can be summed over ranks."""
        self.complete()
        return super().kept() | ({"powers": self.powers.tolist()} if self.begun else {})

    def load_state(self, kept: dict[str, Any]) -> None:
        """Restore this rank's share from a checkpoint, after the state."""
        super().load_state(kept)
        self.begun = "powers" in kept
        if self.begun:
            self.powers[:] = kept["powers"]

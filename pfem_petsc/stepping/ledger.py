"""The energy ledger: every term by its own formula, so that their balance is a check and not a definition.

For a scheme whose balance holds at the ends of steps (``at_ends``), works follow the trapezoidal rule: with
dx = x1 - x0, external work = (e0 + e1) dx/2, contact work (r0 + r1) dx/2, damping dissipation (C v0 + C v1) dx/2, and
the numerical dissipation is what inertia and internal force work beyond the change of their energies:
(M a0 + M a1) dx/2 - dT + (f0 + f1) dx/2 - dU - dD + dH, with the work dH of changing temperatures. For the others the
forces of the one balance work over the whole step.
The sum of all changes is then the work of the residual, zero up to the solver's tolerance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..mechanics.bars import StrainEnergy
from .node_loops import book_nodes

__all__ = ["TERMS", "Ledger", "Moment"]

TERMS = ("external_work", "contact_work", "damping_dissipation", "numerical_dissipation", "thermal_work")
_NOTHING = np.empty((0, 3))


@dataclass
class Moment:
    """What the ledger needs of a moment; arrays (owned, 3).

    Where the mass is lumped, ``momentum``, ``a`` and ``v`` are velocity, acceleration and velocity; where it is
    consistent, M v [kg m/s], M a and C v [N].
    """

    momentum: np.ndarray
    a: np.ndarray
    v: np.ndarray
    internal: np.ndarray
    external: np.ndarray
    support: np.ndarray
    contact: np.ndarray
    kinetic: float = 0.0
    energy: StrainEnergy = StrainEnergy(0.0, 0.0, 0.0, -1)


class Ledger:
    """Accumulates this rank's share of works and dissipations.

    Attributes
    ----------
    work : (5,) sums since the start [J]: external (supports included), contact, damping, numerical, thermal
    totals : (12,) of this rank's nodes at the present state: momentum [kg m/s], angular momentum [kg m2/s], mass times
        position [kg m], support force [N]
    sums : (17,) both, one after the other
    """

    def __init__(self, stepper) -> None:
        self.stepper = stepper
        self.model = stepper.model
        self.sums = np.zeros(len(TERMS) + 12)
        self.work, self.totals = self.sums[: len(TERMS)], self.sums[len(TERMS) :]
        inertia = self.model.inertia
        ones = np.ones_like(inertia.mass)
        # the loops multiply by these: lumped values, or one where the products with the matrices are given
        self._mass = ones if inertia.products else inertia.mass
        self._damping = ones if inertia.products else inertia.damping
        self._damping = self._damping if inertia.damped else np.empty(0)
        self._works = np.zeros(5)
        self._before = self._moment()
        self._book(self._before, self._before, self._before, self.stepper.state.position)
        self._thermal_before()

    def update(self) -> None:
        """Book the step just made."""
        stepper, owned = self.stepper, self.model.mesh.n_owned
        present = after = self._moment()
        before, self._before = self._before, after
        jumped = 0.0
        if stepper.treatment is not None and stepper.treatment.jump is not None:
            after, jumped = self._before_jump(after)
        first, second = (before, after) if stepper.scheme.at_ends else 2 * (self._balanced(before),)
        self._book(present, first, second, stepper.before[:owned])
        stored = present.kinetic - jumped - before.kinetic + sum(present.energy[:3]) - sum(before.energy[:3])
        heating = self._heating()
        external, contact, damping, inertial, internal = self._works.tolist()
        self.work += (external, contact + jumped, damping, inertial + internal + heating - stored, heating)

    def _book(self, present: Moment, first: Moment, second: Moment, start: np.ndarray) -> None:
        """Kinetic energy and totals of the present, and the works from positions ``start`` (owned, 3)."""
        state, inertia = self.stepper.state, self.model.inertia
        present.kinetic = book_nodes(
            start,
            state.position,
            inertia.mass,
            self._mass,
            state.v,
            present.momentum,
            state.support,
            self._damping,
            first.a,
            second.a,
            first.v,
            second.v,
            first.internal,
            second.internal,
            *self._pair(first.external, second.external),
            *self._pair(first.support, second.support),
            *self._pair(first.contact, second.contact),
            self.totals,
            self._works,
        )

    def _pair(self, first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Two arrays, or what stands for two of zeros."""
        zero = self.stepper.zero
        return (_NOTHING, _NOTHING) if first is zero and second is zero else (first, second)

    def _before_jump(self, after: Moment) -> tuple[Moment, float]:
        """The end of the step before contact changed velocities, and the energy that it gave [J]: work of contact."""
        jump = self.stepper.treatment.jump
        a, v = after.a.copy(), after.v.copy()
        a[jump.nodes], v[jump.nodes] = jump.a, jump.v
        return replace(after, a=a, v=v, contact=self.stepper.state.contact), jump.energy

    def resume(self, kinetic: float) -> None:
        """Go on from the present state, with its kinetic energy [J], after steps that others booked in :attr:`sums`."""
        self._before = self._moment()
        self._before.kinetic = kinetic

    @property
    def kinetic(self) -> float:
        """Kinetic energy of this rank's nodes [J]."""
        return self._before.kinetic

    def _moment(self) -> Moment:
        state, inertia = self.stepper.state, self.model.inertia
        owned = self.model.mesh.n_owned
        a, v, momentum = state.a, state.v, state.v
        contact = state.contact
        if "contact_change" in state.memory:  # what a treatment of impact made of the accelerations
            contact = contact + state.memory["contact_change"]
        if inertia.products:
            momentum = inertia.mass_times(state.v, np.empty_like(state.v))
            a = inertia.mass_times(state.a, np.empty_like(state.a))
            v = inertia.damping_times(state.v, np.empty_like(state.v))
        internal = state.f[:owned]
        return Moment(
            momentum=momentum,
            a=a,
            v=v,
            internal=internal if self.stepper.renews_forces else internal.copy(),
            external=state.external,
            support=state.support,
            contact=contact,
            energy=self.stepper.energy,
        )

    def _balanced(self, before: Moment) -> Moment:
        """The forces of the last balance, where it does not hold at the ends of steps."""
        stepper, inertia, balance = self.stepper, self.model.inertia, self.stepper.balance
        state, u = stepper.state, stepper.solution.u
        owned = self.model.mesh.n_owned
        a = balance.alpha * u
        if balance.a_hat is not None:
            a += balance.a_hat
        v = balance.eta * u + balance.v_hat if inertia.damped else u
        if inertia.products:
            a = inertia.mass_times(a, np.empty_like(a))
            v = inertia.damping_times(v, np.empty_like(v))
        internal = before.internal
        if balance.weight == 1.0:
            internal = stepper.solution.internal[:owned]
        elif balance.weight:
            internal = (1.0 - balance.weight) * internal + balance.weight * stepper.solution.internal[:owned]
        return Moment(before.momentum, a, v, internal, state.external, state.support, state.contact)

    def _thermal_before(self) -> None:
        if self.model.temperatures.varying:
            self._stress = self.model.bars.fields(self.stepper.state.x)["stress"]
            self._thermal = self.model.bars.thermal.copy()

    def _heating(self) -> float:
        """Work that a changing temperature does on the counted bars: -A l0 (s0 + s1)/2 (change of thermal strain)."""
        model = self.model
        if not model.temperatures.varying:
            return 0.0
        stress, thermal = self._stress, self._thermal
        self._thermal_before()
        total = 0.0
        for block in model.bars.blocks:
            part = slice(block.start, block.counted)
            mean = 0.5 * (stress[part] + self._stress[part])
            change = self._thermal[part] - thermal[part]
            total -= block.area * float((model.bars.rest[part] * mean * change).sum())
        return total

"""The energy ledger: every term by its own formula, so that their balance is a check and not a definition.

For a scheme whose balance holds at the ends of steps (``at_ends``), works follow the trapezoidal rule: with
dx = x1 - x0, external work = (e0 + e1) dx/2, contact work (r0 + r1) dx/2, damping dissipation (C v0 + C v1) dx/2, and
the numerical dissipation is what inertia and internal force work beyond the change of their energies:
(M a0 + M a1) dx/2 - dT + (f0 + f1) dx/2 - dU - dD + dH, with the work dH of changing temperatures. For the others the
forces of the one balance work over the whole step, and damping takes C dx . dx/h.
The sum of all changes is then the work of the residual, zero up to the solver's tolerance.

What contact does is told apart by formulas that are the same for all schemes and treatments: ``contact_work`` is the
work of the walls' motion, F . dX by the rule above and J . V for jumps J of momentum; ``friction_dissipation`` that of
the drag on the slip which it was found with; ``impact_dissipation`` is that of :mod:`pfem_petsc.contact.impact`. The
rest of the contact forces' work on the nodes is what the scheme makes of impact: it belongs to the numerical
dissipation. Walls with mass are part of the balance: their kinetic energy, and the work of their weight.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..contact.impact import Impacts
from ..energies import ENERGIES
from ..mechanics.bars import StrainEnergy
from ..output.sums import HEAD
from .impulses import Impulses, wall_shares
from .node_loops import WORKS, book_nodes

__all__ = ["Ledger", "Moment"]

_NOTHING = np.empty((0, 3))
_AT = {energy.name: HEAD.first(energy.name) for energy in ENERGIES if energy.source != "derived"}
_TOTALS = slice(HEAD.first("momentum"), HEAD["support_force"].stop)


@dataclass
class Moment:
    """What the ledger needs of a moment; arrays (owned, 3).

    Where the mass is lumped, ``momentum``, ``a`` and ``v`` are velocity, acceleration and velocity; where it is
    consistent, M v [kg m/s], M a and C v [N].
    ``velocity`` and ``acceleration`` are these in any case.
    """

    momentum: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    a: np.ndarray
    v: np.ndarray
    internal: np.ndarray
    external: np.ndarray
    support: np.ndarray
    contact: np.ndarray
    kinetic: float = 0.0
    energy: StrainEnergy = StrainEnergy()


class Ledger:
    """Accumulates this rank's share of works, dissipations and impulses.

    Attributes
    ----------
    sums : of a row, in the layout of :data:`~pfem_petsc.output.sums.HEAD`: works and dissipations since the start [J],
        and totals of this rank's nodes at the present state
    impulses : Impulses
    impacts : Impacts
    """

    def __init__(self, stepper) -> None:
        self.stepper = stepper
        self.model = stepper.model
        self.sums = np.zeros(HEAD.width)
        inertia = self.model.inertia
        ones = np.ones_like(inertia.mass)
        # the loops multiply by these: lumped values, or one where the products with the matrices are given
        self._mass = ones if inertia.products else inertia.mass
        self._damping = ones if inertia.products else inertia.damping
        self._damping = self._damping if inertia.damped else np.empty(0)
        self._works = np.zeros(len(WORKS))
        self._totals = np.zeros((6, 3))
        self._before = self._moment()
        self._book(self._before, self._before, self._before, self.stepper.state.position)
        self._thermal_before()
        self._walls_before()
        self.impacts, self.impulses = Impacts(stepper), Impulses(stepper)
        self._pending = [0.0, 0.0]  # what impact and friction take in the step that a scheme has solved in advance
        if stepper.totals_at_start is not None:
            self.impulses.start(stepper.totals_at_start)
            if stepper.scheme.leads:
                self.impulses.step(stepper.totals_solved)
                self.impulses.state.v[:] = 0.0  # as the velocities of nodes, which have not jumped yet
                self._pending = [self._impact(self._before, started=True), stepper.solution.walls.friction]
                if inertia.damped:  # nodes that walls stop at once are damped as if they were stopped already
                    v = stepper.velocity_solved
                    self._before.v = inertia.damping_times(v, np.empty_like(v)) if inertia.products else v

    def update(self) -> None:
        """Book the step just made."""
        stepper, owned, at = self.stepper, self.model.mesh.n_owned, _AT
        present = after = self._moment()
        before, self._before = self._before, after
        jumped = 0.0
        jump = stepper.treatment.jump if stepper.treatment is not None else None
        if jump is not None and not self.model.inertia.products:  # where nodes lack mass, none of it jumps
            after, jumped = self._before_jump(after)
        first, second = (before, after) if stepper.scheme.at_ends else 2 * (self._balanced(before),)
        self._book(present, first, second, stepper.before[:owned])
        self.impulses.step(self._totals[3:])
        if jump is not None:
            self.impulses.jump()
        self.impulses.fill(self.sums)
        stepper.step_changed = False
        impact, friction = self._dissipated(before)
        stored = present.kinetic - jumped - before.kinetic + present.energy.total - before.energy.total
        heating = self._heating()
        external, contact, damping, inertial, internal = self._works.tolist()
        work, given, weight, lost = self._work_of_walls(before)
        if self.model.inertia.damped and not stepper.scheme.at_ends:
            inertial += damping
            damping = self._damped()
            inertial -= damping
        self.sums[at["external_work"]] += external + weight
        self.sums[at["contact_work"]] += work
        self.sums[at["damping_dissipation"]] += damping
        self.sums[at["thermal_work"]] += heating
        self.sums[at["friction_dissipation"]] += friction
        self.sums[at["impact_dissipation"]] += impact
        # what contact did to nodes beyond the work of walls and the losses of friction and impact
        left = contact + jumped - work - given + friction
        self.sums[at["numerical_dissipation"]] += inertial + internal + heating - stored - left - impact + lost

    def _damped(self) -> float:
        """What damping takes in the step just made, C dx . dx / h [J]: never negative.

        The velocity of a balance within the step, or beyond its end, may point against the way of the step: what the
        damping force of the balance works otherwise is the scheme's.
        """
        stepper = self.stepper
        way = stepper.state.position - stepper.before[: self.model.mesh.n_owned]
        drag = self.model.inertia.damping_times(way, np.zeros_like(way))
        return float((drag * way).sum()) / stepper.part

    def _dissipated(self, before: Moment) -> tuple[float, float]:
        """What impact and friction take in the step just made [J]."""
        stepper = self.stepper
        impact, friction = self._impact(before), stepper.solution.walls.friction
        if not stepper.scheme.leads:
            if not stepper.scheme.solves_end:  # the slip of friction is that to the place solved for
                friction *= stepper.part / (stepper.balance.time - (stepper.state.time - stepper.part))
            return impact, friction
        pending, self._pending = self._pending, [0.0, friction]
        return impact + pending[0], pending[1]

    def _impact(self, before: Moment, started: bool = False) -> float:
        """What closing contacts take [J], those of the next step where the scheme has solved it in advance."""
        stepper, state = self.stepper, self.stepper.state
        if stepper.scheme.leads and not started:
            shifts = self.model.contact.motion.shifts(state.time)
            free = self._before_contact(before) if self.impacts.active else (state.v, state.a)
            return self.impacts.step(state.position, free, None, state.time, shifts)
        load = before.external - before.internal if self.impacts.active else None
        x, time = (state.x, state.time) if started else (stepper.before, state.time - stepper.part)
        motion = (before.velocity, before.acceleration)
        return self.impacts.step(x[: len(state.v)], motion, load, time, self._shifts)

    def _before_contact(self, before: Moment) -> tuple[np.ndarray, np.ndarray]:
        """Velocity and acceleration (owned, 3) of a balance solved in advance, less what a treatment made of them;
        where a force changes more than its own node's, they go on as before."""
        state, balance, jump = self.stepper.state, self.stepper.balance, None
        if self.stepper.treatment is not None:
            jump = self.stepper.treatment.jump
        v, a = state.v, state.a
        if jump is not None:
            v, a = v.copy(), a.copy()
            v[jump.nodes], a[jump.nodes] = jump.v, jump.a
        if self.model.inertia.products:
            earlier = before.acceleration
            return v + (balance.eta / balance.alpha) * (earlier - a), earlier
        return v, a

    def _walls_before(self) -> None:
        """Keep what the next step must know of walls that move."""
        contact = self.model.contact
        self._shifts = contact.motion.shifts(self.stepper.state.time)
        if not contact.moving.any():
            return
        self._push = self.stepper.solution.walls.force.copy()
        change = self.stepper.state.memory.get("contact_change")
        if change is not None:
            nodes = np.flatnonzero(change.any(axis=1))
            self._push += wall_shares(self.stepper, nodes, change[nodes]).sum(axis=0)
        bodies = contact.motion.bodies
        self._bodies_a, self._bodies_kinetic = bodies.state.a, bodies.kinetic
        self.sums[_AT["wall_kinetic_energy"]] = bodies.kinetic if self.model.comm.rank == 0 else 0.0

    def _work_of_walls(self, before: Moment) -> tuple[float, float, float, float]:
        """Work on the truss of walls whose motion is prescribed and of walls with mass, work of the weight of these,
        and their numerical dissipation [J]: this rank's share."""
        stepper, contact = self.stepper, self.model.contact
        if not contact.moving.any():
            return 0.0, 0.0, 0.0, 0.0
        shifts, push, ends = self._shifts, self._push, stepper.scheme.at_ends
        force = stepper.solution.walls.force
        rule = 0.5 * (push + force) if ends else force
        bodies = contact.motion.bodies
        accelerated, kinetic = self._bodies_a, self._bodies_kinetic
        self._walls_before()
        way = self._shifts - shifts
        works = (rule * way).sum(axis=1)
        jump = stepper.treatment.jump if stepper.treatment is not None else None
        if jump is not None and not self.model.inertia.products:
            momentum = self.model.inertia.mass[jump.nodes, None] * (stepper.state.v[jump.nodes] - jump.v)
            pushed = wall_shares(stepper, jump.nodes, momentum).sum(axis=0)
            works += (pushed * contact.motion.rates(stepper.state.time)).sum(axis=1)
        given = float(works[bodies.at].sum())
        work = float(works.sum()) - given
        if self.model.comm.rank:
            return work, given, 0.0, 0.0
        way = way[bodies.at]
        a = 0.5 * (accelerated + bodies.state.a) if ends else bodies.balanced
        lost = float((bodies.mass[:, None] * a * way).sum()) - (self._bodies_kinetic - kinetic)
        return work, given, float((bodies.weight * way).sum()), lost

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
            self._totals,
            self._works,
        )
        self.sums[_AT["kinetic_energy"]] = present.kinetic
        self.sums[_TOTALS] = self._totals[:4].ravel()

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

    def take_pending(self) -> None:
        """Book what a step solved in advance takes, before steps that others book."""
        self.sums[_AT["impact_dissipation"]] += self._pending[0]
        self.sums[_AT["numerical_dissipation"]] -= self._pending[0]
        self._pending = [0.0, 0.0]

    def kept(self) -> dict[str, Any]:
        """This rank's share, for a checkpoint: numbers that may be summed over ranks."""
        return {"sums": self.sums.tolist(), "pending": list(self._pending), "impulses": self.impulses.kept()}

    def put_back(self, kept: dict[str, Any]) -> None:
        """Take the share from a checkpoint; the present state is that of it already."""
        present = self.sums[_TOTALS].copy()
        self.sums[:] = kept["sums"]
        self.sums[_TOTALS] = present
        self.sums[_AT["kinetic_energy"]] = self._before.kinetic
        self._pending = [float(value) for value in kept["pending"]]
        self.impulses.put_back(kept["impulses"])
        if self.model.contact.moving.any():
            self._walls_before()

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
            velocity=state.v,
            acceleration=state.a,
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
        return Moment(
            before.momentum,
            before.velocity,
            before.acceleration,
            a,
            v,
            internal,
            state.external,
            state.support,
            state.contact,
        )

    def _thermal_before(self) -> None:
        if self.model.temperatures.varying:
            bars = self.model.bars
            self._stress = bars.fields(self.stepper.state.x)["stress"]
            self._variables = [block.history[: len(block.law.internal)].copy() for block in bars.blocks]
            self._thermal = bars.heat[0].copy()

    def _heating(self) -> float:
        """Work that a changing temperature does on the counted bars: -A l0 S (change of thermal strain), with the mean
        stress S of :mod:`~pfem_petsc.mechanics.conserving`, (s0 + s1)/2 with the law's correction."""
        model = self.model
        if not model.temperatures.varying:
            return 0.0
        stress, variables, thermal = self._stress, self._variables, self._thermal
        self._thermal_before()
        total = 0.0
        for block, before, after in zip(model.bars.blocks, variables, self._variables, strict=True):
            part = slice(block.start, block.counted)
            mean = 0.5 * (stress[part] + self._stress[part])
            if block.law.mean_correction is not None:
                counted = slice(block.counted - block.start)
                change = self._stress[part] - stress[part]
                mean += block.law.mean_correction(block.parameters, change, before[:, counted], after[:, counted])
            change = self._thermal[part] - thermal[part]
            total -= block.area * float((model.bars.rest[part] * mean * change).sum())
        return total

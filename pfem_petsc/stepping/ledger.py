"""The energy ledger: every term has its own formula, so that their balance is a check and not a definition.

For a scheme whose balance holds at the ends of steps (``balance_at_endpoints``), works follow the trapezoidal rule.
With dx = x1 - x0, the external work is (e0 + e1) dx/2 and the contact work (r0 + r1) dx/2. The numerical dissipation is
the work of inertia and internal forces in excess of the change of their energies:
(M a0 + M a1) dx/2 - dT + (f0 + f1) dx/2 - dU - dD + dH, with the work dH of changing temperatures and rest lengths
(:mod:`~pfem_petsc.stepping.bar_changes`). For other schemes the forces of the single balance act over the whole step.
Damping dissipates C dx . dx/h, which is never negative, and (C v0 + C v1) dx/2 with explicit schemes whose balance
holds at the ends. The sum of all changes is then the work of the residual, which is zero up to the tolerance of the
solver.

The work of contact is split by formulas that are the same for all schemes and treatments. ``contact_work`` is the work
of moving walls, F . dX by the rule above and J . V for jumps J of momentum. ``friction_dissipation`` is the work of
friction forces on the slip used to determine them. ``impact_dissipation`` is given by :mod:`pfem_petsc.contact.impact`.
The remaining work of contact forces on nodes is an effect of the scheme in impact and belongs to the numerical
dissipation. Walls with mass are part of the balance, with their kinetic energy and the work of their weight.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..contact.impact import Impacts
from ..energies import ENERGIES
from ..output.sums import HEAD
from .bar_changes import BarChanges
from .book_loops import TOTALS, WORKS, book_nodes
from .impulses import Impulses, NoImpulses, wall_shares
from .moment import Moment, balanced, moment_of
from .sum_loops import add_totals, add_works

if TYPE_CHECKING:
    from .stepper import Stepper

__all__ = ["Ledger"]

_NOTHING = np.empty((0, 3))
_AT = {energy.name: HEAD.first(energy.name) for energy in ENERGIES if energy.source != "derived"}
_SUPPORT = TOTALS.index("support")
_TOTALS = slice(HEAD.first("momentum"), HEAD["support_force"].stop)


class Ledger:
    """Accumulates this rank's share of works, dissipations and impulses.

    Attributes
    ----------
    sums : of a row, in the layout of :data:`~pfem_petsc.output.sums.HEAD`: works and dissipations since the start [J],
        and totals of this rank's nodes at the present state; valid after :meth:`complete`
    impulses : Impulses
    impacts : Impacts
    begun : whether the works of the steps before are continued; false until the first step, and after a restart from a
        checkpoint of another ledger, where a ledger needs steps of its own
    """

    begun = True

    def __init__(self, stepper: Stepper) -> None:
        self.stepper = stepper
        self.model = stepper.model
        self.sums = np.zeros(HEAD.width)
        inertia = self.model.inertia
        ones = np.ones_like(inertia.mass)
        # factors in the loops: lumped values, or one if products with the matrices are given
        self._mass = ones if inertia.products else inertia.mass
        self._damping = ones if inertia.products or inertia.varies else inertia.damping
        self._damping = self._damping if inertia.damped else np.empty(0)
        self._works = np.zeros(len(WORKS))
        self._totals = np.zeros((6, 3))
        self._before = moment_of(self.stepper)
        self._book(self._before, self._before, self._before, self.stepper.state.position)
        self._changes = BarChanges(stepper)
        self._walls_before()
        self.impacts = Impacts(stepper)
        self.impulses = (Impulses if stepper.scheme.inertial else NoImpulses)(stepper)
        self._pending = [0.0, 0.0]  # what impact and friction take in the step that a scheme has solved in advance
        if stepper.totals_at_start is not None:
            self.impulses.start(stepper.totals_at_start)
            if stepper.scheme.solves_next_position:
                self.impulses.step(stepper.totals_solved)
                self.impulses.state.v[:] = 0.0  # like the nodal velocities, which have not jumped yet
                self._pending = [self._impact(self._before, started=True), stepper.solution.walls.friction]
                if inertia.damped:  # damping treats nodes that walls stop at the start as already stopped
                    v = stepper.velocity_solved
                    given = inertia.products or inertia.varies
                    self._before.v = inertia.damping_times(v, np.empty_like(v)) if given else v

    def update(self) -> None:
        """Add the last step."""
        stepper, owned = self.stepper, self.model.mesh.n_owned
        present = after = moment_of(self.stepper)
        before, self._before = self._before, after
        jumped = 0.0
        jump = stepper.treatment.jump if stepper.treatment is not None else None
        if jump is not None and not self.model.inertia.products:  # massless nodes carry no momentum that jumps
            after, jumped = self._before_jump(after)
        first, second = (before, after) if stepper.scheme.balance_at_endpoints else 2 * (balanced(stepper, before),)
        self._book(present, first, second, stepper.before[:owned])
        self.impulses.step(self._totals[3:])
        if jump is not None:
            self.impulses.jump()
        self.impulses.fill(self.sums)
        stepper.step_changed = False
        impact, friction = self._dissipated(before)
        if jump is not None:
            friction += jump.friction
        stored = present.kinetic - jumped - before.kinetic + present.energy.total - before.energy.total
        heating, stressing = self._changes.works()
        work, given, weight, lost = self._work_of_walls(before)
        # velocities at the ends of explicit steps are those of the steps beside
        follows = stepper.scheme.explicit and stepper.scheme.balance_at_endpoints
        if self.model.inertia.damped and not follows:
            damping = self._damped()
            of, by = WORKS.index("inertial"), WORKS.index("damping")
            self._works[of] = self._works[of] + self._works[by] - damping
            self._works[by] = damping
        add_works(self.sums, self._works, stored, heating, impact, friction, work, given, weight, lost, jumped)
        self.sums[_AT["prestress_work"]] += stressing
        self.sums[_AT["numerical_dissipation"]] += stressing

    def complete(self) -> None:
        """Complete :attr:`sums` for a row; nothing is left to do where each step does it."""

    def _damped(self) -> float:
        """Return the damping dissipation of the last step, C dx . dx / h [J]; never negative.

        The velocity of a balance, at the ends of the step, within it or beyond, may point against the way of the step:
        what the damping force of the balance works otherwise is the scheme's.
        """
        stepper = self.stepper
        way = stepper.state.position - stepper.before[: self.model.mesh.n_owned]
        drag = self.model.inertia.damping_times(way, np.zeros_like(way))
        return float((drag * way).sum()) / stepper.part

    def _dissipated(self, before: Moment) -> tuple[float, float]:
        """Return the impact and friction dissipation of the last step [J]."""
        stepper = self.stepper
        impact, friction = self._impact(before), stepper.solution.walls.friction
        if not stepper.scheme.solves_next_position:
            if not stepper.scheme.solves_end:  # friction is determined with the slip to the position solved for
                friction *= stepper.part / (stepper.balance.time - (stepper.state.time - stepper.part))
            return impact, friction
        pending, self._pending = self._pending, [0.0, friction]
        return impact + pending[0], pending[1]

    def _impact(self, before: Moment, started: bool = False) -> float:
        """Return the dissipation of closing contacts [J], of the next step if the scheme has solved it in advance."""
        stepper, state = self.stepper, self.stepper.state
        if stepper.scheme.solves_next_position and not started:
            displacements = self.model.contact.motion.displacements(state.time)
            free = self._before_contact(before) if self.impacts.active else (state.v, state.a)
            return self.impacts.step(state.position, free, None, state.time, displacements)
        load = before.external - before.internal if self.impacts.active else None
        x, time = (state.x, state.time) if started else (stepper.before, state.time - stepper.part)
        motion = (before.velocity, before.acceleration)
        return self.impacts.step(x[: len(state.v)], motion, load, time, self._displacements)

    def _before_contact(self, before: Moment) -> tuple[np.ndarray, np.ndarray]:
        """Return velocity and acceleration (owned, 3) of a balance solved in advance, without changes by a treatment.

        With a consistent mass, where a force accelerates other nodes too, the acceleration is that before the step.
        """
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
        """Store the state of moving walls for the next step."""
        contact = self.model.contact
        self._displacements = contact.motion.displacements(self.stepper.state.time)
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
        """Return this rank's share of the work on the truss by walls with prescribed motion and by walls with mass, the
        work of the weight of the latter, and their numerical dissipation [J]."""
        stepper, contact = self.stepper, self.model.contact
        if not contact.moving.any():
            return 0.0, 0.0, 0.0, 0.0
        displacements, push, ends = self._displacements, self._push, stepper.scheme.balance_at_endpoints
        force = stepper.solution.walls.force
        rule = 0.5 * (push + force) if ends else force
        bodies = contact.motion.bodies
        accelerated, kinetic = self._bodies_a, self._bodies_kinetic
        self._walls_before()
        way = self._displacements - displacements
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
        """Add kinetic energy and totals at the present state, and the works from positions ``start`` (owned, 3)."""
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
        if self.model.bars.springs is not None:  # reactions of the ground: the forces of bars cancel in the sum
            self._totals[_SUPPORT] -= second.internal.sum(axis=0)
        add_totals(self.sums, self._totals)

    def _pair(self, first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return two arrays, or the placeholder for two arrays of zeros."""
        zero = self.stepper.zero
        return (_NOTHING, _NOTHING) if first is zero and second is zero else (first, second)

    def _before_jump(self, after: Moment) -> tuple[Moment, float]:
        """Return the end of the step before velocity jumps, and the energy of the jumps [J], a work of contact."""
        jump = self.stepper.treatment.jump
        a, v = after.a.copy(), after.v.copy()
        a[jump.nodes], v[jump.nodes] = jump.a, jump.v
        if self.model.inertia.varies:
            v[jump.nodes] *= self.model.inertia.damping[jump.nodes, None]
        return replace(after, a=a, v=v, contact=self.stepper.state.contact), jump.energy

    def follow_removal(self) -> None:
        """Start the next step from the energies and stresses of the bars after some were removed, as a restart does."""
        self._before.energy = self.stepper.energy
        self._changes.keep()

    def resume(self, kinetic: float) -> None:
        """Continue from the present state with its kinetic energy [J] after the fused loop updated :attr:`sums`."""
        self._before = moment_of(self.stepper)
        self._before.kinetic = kinetic

    def kept(self) -> dict[str, Any]:
        """Return this rank's share for a checkpoint: numbers that can be summed over ranks."""
        return {"sums": self.sums.tolist(), "pending": list(self._pending), "impulses": self.impulses.kept()}

    def load_state(self, kept: dict[str, Any]) -> None:
        """Restore this rank's share from a checkpoint, after the state."""
        present = self.sums[_TOTALS].copy()
        self.sums[:] = kept["sums"]
        self.sums[_TOTALS] = present
        self.sums[_AT["kinetic_energy"]] = self._before.kinetic
        self._pending = [float(value) for value in kept["pending"]]
        self.impulses.load_state(kept["impulses"])
        if self.model.contact.moving.any():
            self._walls_before()

    @property
    def kinetic(self) -> float:
        """Kinetic energy of this rank's nodes [J]."""
        return self._before.kinetic

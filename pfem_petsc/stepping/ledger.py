"""The energy ledger: every term has its own formula, so that their balance is a check and not an identity."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..columns import BAR_ENERGIES, COUNTS, ENERGIES, HEAD
from ..mechanics.bars import StrainEnergy, state_before_rupture
from ..mechanics.elements import MEASURES
from ..mechanics.materials.base import SMALL
from .impact import Impacts
from .impulses import Impulses, NoImpulses
from .phases import CONTACT, DAMPING, EXTERNAL, INERTIAL, INTERNAL, WORKS, numerical_dissipation, power, sum_momenta

if TYPE_CHECKING:
    from ..contact.free_walls import BodyMotion
    from ..mechanics.bars import BarBlock
    from .stepper import Stepper


@dataclass
class Moment:
    """Data of the ledger at an instant; vectors (owned, 3).

    ``momentum`` M v [kg m/s], ``inertial`` M a and ``damping`` C v [N] with the mass and damping matrices, the forces
    in the balance [N], and the energies of nodes and bars [J].
    """

    velocity: np.ndarray
    acceleration: np.ndarray
    momentum: np.ndarray
    inertial: np.ndarray
    damping: np.ndarray
    internal: np.ndarray
    external: np.ndarray
    support: np.ndarray
    contact: np.ndarray
    kinetic: float = 0.0
    energy: StrainEnergy = StrainEnergy()


def moment_of(stepper: Stepper) -> Moment:
    """Return the data at the present state of a stepper."""
    state, inertia = stepper.state, stepper.model.inertia
    contact = state.contact
    if "contact_change" in state.memory:  # changes of accelerations by a treatment of impact
        contact = contact + state.memory["contact_change"]
    return Moment(
        velocity=state.v,
        acceleration=state.a,
        momentum=inertia.mass_times(state.v, np.empty_like(state.v)),
        inertial=inertia.mass_times(state.a, np.empty_like(state.a)),
        damping=damping_force(stepper, state.v),
        internal=state.f[: stepper.model.mesh.n_owned].copy(),
        external=state.external,
        support=state.support,
        contact=contact,
        energy=stepper.energy,
    )


def damping_force(stepper: Stepper, v: np.ndarray) -> np.ndarray:
    """Return C v (owned, 3) [N]; the stepper's zeros without damping."""
    inertia = stepper.model.inertia
    return inertia.damping_times(v, np.empty_like(v)) if inertia.damped else stepper.zero


def balanced(stepper: Stepper, before: Moment) -> Moment:
    """Return the forces of the last balance, for schemes whose balance does not hold at the ends of steps."""
    inertia, balance = stepper.model.inertia, stepper.balance
    state, u = stepper.state, stepper.solution.u
    a = balance.alpha * u
    if balance.a_hat is not None:
        a += balance.a_hat
    damping = damping_force(stepper, balance.eta * u + balance.v_hat) if inertia.damped else stepper.zero
    internal, solved = before.internal, stepper.solution.internal[: len(u)]
    if balance.weight == 1.0:
        internal = solved
    elif balance.weight:
        internal = (1.0 - balance.weight) * internal + balance.weight * solved
    return replace(
        before,
        inertial=inertia.mass_times(a, np.empty_like(a)),
        damping=damping,
        internal=internal,
        external=state.external,
        support=state.support,
        contact=state.contact,
    )


_STRAINS = {  # of arrays of stretches
    MEASURES["engineering"]: lambda s: s - 1.0,
    MEASURES["green"]: lambda s: 0.5 * (s * s - 1.0),
    MEASURES["logarithmic"]: np.log,
}


class BarChanges:
    """Stores the state of the bars before a step and computes the works in it."""

    def __init__(self, stepper: Stepper) -> None:
        self.stepper, self.model = stepper, stepper.model
        self.keep()

    def keep(self) -> None:
        """Store the current stresses, internal variables, thermal strains, and with them lengths and energies."""
        if not self.model.bars_vary:
            return
        bars, x = self.model.bars, self.stepper.state.x
        self._stress = bars.fields(x)["stress"]
        self._variables = [block.history[: len(block.law.rows)].copy() for block in bars.blocks]
        self._thermal, self._warmth = bars.heat[0].copy(), bars.heat[1].copy()
        self._state = bars.rupture() if bars.can_break else np.empty(0)
        if self.model.rest_lengths.varying or any(block.law.mean_of_work for block in bars.blocks):
            self._rest, self._lengths, self._densities = bars.rest.copy(), bars.lengths(x), bars.densities(x)

    def works(self) -> tuple[float, float, np.ndarray | float]:
        """Return the works of changing temperatures and of changing rest lengths on the counted bars in the last step,
        and by how much these have scaled what the bars had dissipated, (number of BAR_ENERGIES,) [J]."""
        model, scaled = self.model, 0.0
        if not model.bars_vary:
            return 0.0, 0.0, scaled
        before = dict(vars(self))
        self.keep()
        heating = stressing = 0.0
        if model.rest_lengths.varying:
            scaled = model.bars.scaled_dissipation(before["_densities"], self._rest - before["_rest"])
        for k, block in enumerate(model.bars.blocks):
            part = slice(block.start, block.counted)
            first, last, viscous = self._ends(before, k, block)
            mean = 0.5 * (first + last) + viscous
            if block.law.mean_of_work:
                mean = self._mean_of_work(before, block, mean)
            rest = model.bars.rest[part]
            if model.rest_lengths.varying:
                rest = 0.5 * (before["_rest"][part] + rest)
                stressing += self._stressing(before, block, mean, rest)
            if model.temperatures.varying:
                change = self._thermal[part] - before["_thermal"][part]
                heating -= float((block.counted_area * rest * mean * change).sum())
                if block.law.modulus is not None:
                    heating += float((block.counted_area * rest * self._softening(before, block, first * last)).sum())
        return heating, stressing, scaled

    def _mean_of_work(self, before: dict, block: BarBlock, mean: np.ndarray) -> np.ndarray:
        """Return the change of energies over that of strains of the counted bars of a block [Pa]; ``mean`` where these
        hardly change."""
        part, strain = slice(block.start, block.counted), _STRAINS[block.measure]
        first, last = (
            strain(of["_lengths"][part] / of["_rest"][part]) - (of["_thermal"][part] if len(of["_thermal"]) else 0.0)
            for of in (before, vars(self))
        )
        change, work = last - first, (self._densities[:, part] - before["_densities"][:, part]).sum(axis=0)
        large = np.abs(change) > SMALL * (np.abs(first) + np.abs(last))
        return np.divide(work, change, out=mean, where=large)

    def _ends(self, before: dict, k: int, block: BarBlock) -> tuple[np.ndarray, np.ndarray, np.ndarray | float]:
        """Return the stresses of the counted bars of a block at start and end of the step, without the viscous stress
        of ``stiffness_damping``, and the mean of the latter [Pa]."""
        part = slice(block.start, block.counted)
        first, last = before["_stress"][part], self._stress[part]
        if block.law.rupture >= 0:
            last = self._with_bars(before["_state"][part], part, last)
        if block.law.known_rate < 0:
            return first, last, 0.0
        left = 1.0 - np.abs(before["_state"][part]) if block.law.rupture >= 0 else 1.0
        rows, row, strain = slice(block.counted - block.start), block.law.known_rate - 2, len(block.law.internal)
        begun, ended = before["_variables"][k][:, rows], self._variables[k][:, rows]
        viscous = 0.5 * left * (begun[row + 1] + ended[row + 1])
        change, lost = ended[strain] - begun[strain], left * (ended[row] - begun[row])
        large = np.abs(change) > SMALL * (np.abs(begun[strain]) + np.abs(ended[strain]))
        np.divide(lost, change, out=viscous, where=large)
        return first - left * begun[row + 1], last - left * ended[row + 1], viscous

    def _softening(self, before: dict, block: BarBlock, square: np.ndarray) -> np.ndarray:
        """Return the work per volume [J/m3] that temperatures do by changing the modulus of the counted bars;
        ``square``: product of the stresses before and after [Pa2]."""
        part = slice(block.start, block.counted)
        moduli = (block.law.modulus(block.parameters, at[part]) for at in (before["_warmth"], self._warmth))
        product = square * (1.0 / next(moduli) - 1.0 / next(moduli))
        if block.law.rupture >= 0:  # stresses are those of the share that is left
            left = 1.0 - np.abs(before["_state"][part])
            product = np.divide(product, left, out=np.zeros_like(product), where=left > 0.0)
        return 0.5 * product

    def _with_bars(self, state: np.ndarray, part: slice, stress: np.ndarray) -> np.ndarray:
        """Return stresses at the end of the step [Pa] of bars that broke there as they were before."""
        stress = stress.copy()
        for k in np.flatnonzero(self._state[part] != state):
            whole = state_before_rupture(self.model.bars, self.stepper.state.x, part.start + int(k))[2]
            stress[k] = (1.0 - abs(state[k])) * whole
        return stress

    def _stressing(self, before: dict, block: BarBlock, mean: np.ndarray, rest: np.ndarray) -> float:
        """Return the work of changing rest lengths on the counted bars of a block [J]; ``rest``: their means [m]."""
        part, strain = slice(block.start, block.counted), _STRAINS[block.measure]
        first, last = before["_lengths"][part], self._lengths[part]
        rest0, rest1 = before["_rest"][part], self._rest[part]
        whole = strain(last / rest1) - strain(first / rest0)
        moved = strain(last / rest) - strain(first / rest)
        density = 0.5 * (before["_densities"][:, part] + self._densities[:, part]).sum(axis=0)
        return float((block.counted_area * (rest * mean * (whole - moved) + density * (rest1 - rest0))).sum())


_AT = {energy.name: HEAD.first(energy.name) for energy in ENERGIES if energy.source != "derived"}
_BARS = HEAD.indices(BAR_ENERGIES)
_AT_STATE = HEAD.indices((*BAR_ENERGIES, *(one.name for one in COUNTS), "alarm"))
_TOTALS = slice(HEAD.first("momentum"), HEAD["support_force"].stop)


class Ledger:
    """Accumulates this rank's share of works, dissipations and impulses: step by step, or, of compiled steps, balance
    by balance.

    Attributes
    ----------
    sums : of a row, in the layout of :data:`~pfem_petsc.columns.HEAD`: works and dissipations since the start [J],
        totals of this rank's nodes at the present state, and of the energies of bars what is added to those of their
        rest volumes, so that rest lengths that change do not scale what was dissipated before
    impulses : Impulses
    impacts : Impacts
    powers : (5,) works of all balances of a leapfrog scheme up to the present one, in the order of ``WORKS`` [J]; at
        the place of inertia is the constant that continues the numerical dissipation of what came before. None if the
        last step was not a compiled one
    """

    def __init__(self, stepper: Stepper) -> None:
        self.stepper = stepper
        self.model = stepper.model
        self.sums = np.zeros(HEAD.width)
        self.powers: np.ndarray | None = None
        self._before = moment_of(self.stepper)
        self._sum_state(self._before, self._before)
        self._changes = BarChanges(stepper)
        self._walls_before()
        self.impacts = Impacts(stepper)
        self.impulses = (Impulses if stepper.scheme.inertial else NoImpulses)(stepper)
        self._pending = [0.0, 0.0]  # what impact and friction take in the step that a scheme has solved in advance
        if stepper.totals_at_start is not None:
            self.impulses.start(stepper.totals_at_start)
            if stepper.scheme.solves_next_position:
                self.impulses.step(stepper.totals_solved, stepper.part_before_start)
                self.impulses.state.v[:] = 0.0  # like the nodal velocities, which have not jumped yet
                self._pending = [self._impact(self._before, started=True), self._friction()]
                # damping treats nodes that walls stop at the start as already stopped
                self._before.damping = damping_force(stepper, stepper.velocity_solved)

    def update(self) -> None:
        """Add the last step."""
        stepper, owned = self.stepper, self.model.mesh.n_owned
        present = after = moment_of(self.stepper)
        before, self._before = self._before, after
        self.powers = None
        jump, jumped = stepper.jump, 0.0
        if jump is not None:  # a work of contact
            v, a = self._before_jump()
            inertial, damping = self.model.inertia.mass_times(a, np.empty_like(a)), damping_force(stepper, v)
            after = replace(present, inertial=inertial, damping=damping, contact=stepper.state.contact)
            jumped = jump.energy
        first, second = (before, after) if stepper.scheme.balance_at_endpoints else 2 * (balanced(stepper, before),)
        works = self._works(0.5 * (stepper.state.position - stepper.before[:owned]), first, second)
        self.impulses.step(self._sum_state(present, second), stepper.part)
        if jump is not None:
            self.impulses.jump()
        stepper.step_changed = False
        impact, friction = self._dissipated(before)
        if jump is not None:
            friction += jump.friction
        stored = present.kinetic - jumped - before.kinetic + present.energy.total - before.energy.total
        heating, stressing, scaled = self._changes.works()
        work, given, weight, lost = self._work_of_walls()
        # velocities at the ends of explicit steps are those of the steps beside
        follows = stepper.scheme.explicit and stepper.scheme.balance_at_endpoints
        if self.model.inertia.damped and not follows:
            damping = self._damped()
            works[INERTIAL] += works[DAMPING] - damping
            works[DAMPING] = damping
        excess = works[CONTACT] + jumped - work - given
        internal = works[INTERNAL] + heating
        numerical = numerical_dissipation(works[INERTIAL], internal, stored, excess, friction + impact) + lost
        for name, value in (
            ("external_work", works[EXTERNAL] + weight),
            ("contact_work", work),
            ("damping_dissipation", works[DAMPING]),
            ("thermal_work", heating),
            ("friction_dissipation", friction),
            ("impact_dissipation", impact),
            ("numerical_dissipation", numerical),
            ("prestress_work", stressing - np.sum(scaled)),
        ):
            self.sums[_AT[name]] += value
        self.sums[_BARS] -= scaled
        self.sums[_AT["numerical_dissipation"]] += stressing

    def _works(self, way: np.ndarray, first: Moment, second: Moment) -> np.ndarray:
        """Return the works (5,) [J] of two sets of forces, each over the displacements ``way`` (owned, 3) [m]."""
        zero = self.stepper.zero
        works = np.zeros(len(WORKS))
        for k, name in (*enumerate(WORKS), (EXTERNAL, "support")):
            one, other = getattr(first, name), getattr(second, name)
            if one is not zero or other is not zero:
                works[k] += power(one + other, way)
        return works

    def _sum_state(self, present: Moment, second: Moment) -> np.ndarray:
        """Set the kinetic energy at the present state, and its totals in the sums; return the sums (3, 3) of support,
        external and damping forces of a set of forces [N]."""
        state, zero, sums = self.stepper.state, self.stepper.zero, np.zeros((3, 3))
        present.kinetic = 0.5 * power(present.momentum, present.velocity)
        self.sums[_AT["kinetic_energy"]] = present.kinetic
        for k, force in enumerate((state.support, second.external, second.damping)):
            if force is not zero:
                sums[k] = force.sum(axis=0)
        sums[2] *= -1.0
        if self.model.bars.springs is not None:  # reactions of the ground: the forces of bars cancel in the sum
            sums[0] -= second.internal.sum(axis=0)
        momenta = sum_momenta(state.position, self.model.inertia.mass, present.momentum)
        self.sums[_TOTALS] = np.concatenate([momenta, sums[:1]]).reshape(-1)
        return sums

    def begin_compiled(self) -> None:
        """Continue the works balance by balance, after a step."""
        stepper, present, h, sums = self.stepper, self._before, self.stepper.h, self.sums
        a, supports = present.acceleration, self.model.supports
        ahead = (0.5 * h) * stepper.state.memory["half_velocity"]  # the way of the second half of the balance
        self.powers = np.zeros(len(WORKS))
        for k in (EXTERNAL, CONTACT, DAMPING, INTERNAL):
            self.powers[k] = power(getattr(present, WORKS[k]), ahead)
        inertial = 0.125 * h * h * power(present.inertial, a)
        if supports.moves:  # works are over the ways between positions, and inertia is that of the motion
            mass, speed, rate = (
                self.model.inertia.mass[supports.every_node],
                supports.get(present.velocity),
                supports.get(a),
            )
            kinetic = 0.5 * speed * speed - 0.125 * h * h * rate * rate
            inertial += float((mass * (kinetic + rate * supports.get(ahead))).sum())
            self.powers[EXTERNAL] += power(present.support, ahead)
        self.powers[EXTERNAL] += sums[_AT["external_work"]]
        self.powers[DAMPING] += sums[_AT["damping_dissipation"]]
        impact, numerical = sums[_AT["impact_dissipation"]], sums[_AT["numerical_dissipation"]]
        rubbed = sums[_AT["friction_dissipation"]] - sums[_AT["contact_work"]]
        self.powers[INERTIAL] = numerical + inertial + present.energy.total + impact + rubbed
        self._release()

    def _release(self) -> None:
        """Keep of the moment before only what compiled steps need, which have their own arrays."""
        self._before = Moment(*9 * (self.stepper.zero,), self._before.kinetic, self._before.energy)

    @property
    def bar_energies(self) -> np.ndarray:
        """What :attr:`sums` adds to the energies of this rank's bars (number of BAR_ENERGIES,) [J]."""
        return self.sums[_BARS]

    @property
    def friction_ahead(self) -> float:
        """Energy that friction dissipates in the next step, which the last balance has determined [J]."""
        return self._pending[1]

    def follow_compiled(self, sums: np.ndarray, friction: float) -> None:
        """Take the sums (width of HEAD,) at the end of a call of compiled steps, and :attr:`friction_ahead`."""
        self._pending = [0.0, friction]
        self.sums[:] = sums
        self.sums[_AT_STATE] = 0.0
        self._before.energy = self.stepper.energy

    def end_compiled(self) -> None:
        """Keep the present state, from which a single step goes on."""
        self._before = moment_of(self.stepper)
        self._before.kinetic = self.sums[_AT["kinetic_energy"]]
        self._walls_before()
        self.powers = None

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
        impact, friction = self._impact(before), self._friction()
        if not stepper.scheme.solves_next_position:
            if not stepper.scheme.solves_end:  # friction is determined with the slip to the position solved for
                friction *= stepper.part / (stepper.balance.time - (stepper.state.time - stepper.part))
            return impact, friction
        pending, self._pending = self._pending, [0.0, friction]
        return impact + pending[0], pending[1]

    def _friction(self) -> float:
        """Return the energy that friction at walls and of rows dissipates in the step solved for [J]."""
        return self.stepper.solution.walls.friction + self.model.links.friction

    def _impact(self, before: Moment, started: bool = False) -> float:
        """Return the dissipation of closing contacts [J], of the next step if the scheme has solved it in advance."""
        stepper, state = self.stepper, self.stepper.state
        if stepper.scheme.solves_next_position and not started:
            poses = self.model.contact.motion.poses(state.time)
            free = self._before_contact(before) if self.impacts.active else (state.v, state.a)
            return self.impacts.step(state.position, free, None, state.time, poses)
        load = before.external - before.internal if self.impacts.active else None
        x, time = (state.x, state.time) if started else (stepper.before, state.time - stepper.part)
        motion = (before.velocity, before.acceleration)
        return self.impacts.step(x[: len(state.v)], motion, load, time, self._poses)

    def _before_contact(self, before: Moment) -> tuple[np.ndarray, np.ndarray]:
        """Return velocity and acceleration (owned, 3) of a balance solved in advance, without changes by a treatment.

        With a consistent mass, where a force accelerates other nodes too, the acceleration is that before the step.
        """
        balance, (v, a), earlier = self.stepper.balance, self._before_jump(), before.acceleration
        if self.model.inertia.products:
            return v + (balance.eta / balance.alpha) * (earlier - a), earlier
        return v, a

    def _before_jump(self) -> tuple[np.ndarray, np.ndarray]:
        """Return velocity and acceleration (owned, 3) before velocity jumps of the last step."""
        jump, v, a = self.stepper.jump, self.stepper.state.v, self.stepper.state.a
        if jump is not None:
            v, a = v.copy(), a.copy()
            v[jump.nodes], a[jump.nodes] = jump.v, jump.a
        return v, a

    def _walls_before(self) -> None:
        """Store the state of moving walls for the next step."""
        contact, time = self.model.contact, self.stepper.state.time
        self._poses, self._displacements = contact.motion.poses(time), contact.motion.displacements(time)
        if not contact.moving.any():
            return
        self._angles = contact.motion.angles(time)
        self._keep_bodies()

    def _work_of_walls(self) -> tuple[float, float, float, float]:
        """Return this rank's share of the work on the truss by walls with prescribed motion and by walls with mass, the
        work of the weight of the latter, and their numerical dissipation [J].

        Walls do work by all the momentum that they give in the step, by forces and by velocity jumps: the mean force
        times the displacement of the wall, and the mean moment about its axis times the angle by which it turns. A wall
        with mass is a particle of the same scheme, so its kinetic energy changes by that momentum, and by that of its
        weight, times the mean of its velocities before and after; of its rotation, see
        :meth:`~pfem_petsc.contact.free_walls.FreeWalls.works`.
        """
        contact = self.model.contact
        if not contact.moving.any():
            return 0.0, 0.0, 0.0, 0.0
        before, angles, bodies = self._displacements, self._angles, contact.motion.bodies
        (push, torques), earlier = self.impulses.mean_pushes(), self._bodies
        self._walls_before()
        works = (push * (self._displacements - before)).sum(axis=1)
        works[bodies.at] = 0.0
        work = float(works.sum())
        if len(torques):
            work += float((torques * (self._angles - angles)).sum())
        return work, *self._work_of_bodies(push, earlier)

    def _work_of_bodies(self, push: np.ndarray, before: BodyMotion) -> tuple[float, float, float]:
        """Return this rank's share of the work of walls with mass on the truss by mean forces (walls, 3) [N] since a
        motion, the work of their weight, and their numerical dissipation [J]."""
        bodies, part = self.model.contact.motion.bodies, self.stepper.part
        ways = part * 0.5 * (before.velocity + self._bodies.velocity)
        given = float((push[bodies.at] * ways).sum())
        if self.model.comm.rank:
            return given, 0.0, 0.0
        turning, weight, lost = bodies.works(before, self._bodies, part)
        return given + turning, weight, lost

    def follow_bodies(self, push: np.ndarray) -> None:
        """Add the works of walls with mass in a compiled step with mean forces (walls, 3) [N]."""
        before = self._bodies
        self._keep_bodies()
        given, weight, lost = self._work_of_bodies(push, before)
        self.powers[CONTACT] -= given
        self.powers[EXTERNAL] += weight
        self.powers[INERTIAL] += lost

    def _keep_bodies(self) -> None:
        """Store the motion of walls with mass."""
        bodies = self.model.contact.motion.bodies
        self._bodies = bodies.motion
        self.sums[_AT["wall_kinetic_energy"]] = bodies.kinetic if self.model.comm.rank == 0 else 0.0

    def follow_removal(self) -> None:
        """Start the next step from the energies and stresses of the bars after some were removed, as a restart does."""
        if self.powers is not None:
            self.powers[INERTIAL] += self.stepper.energy.total - self._before.energy.total
        self._before.energy = self.stepper.energy
        self._changes.keep()

    def kept(self) -> dict[str, Any]:
        """Return this rank's share for a checkpoint: numbers that can be summed over ranks."""
        kept = {"sums": self.sums.tolist(), "pending": list(self._pending), "impulses": self.impulses.kept()}
        return kept | ({} if self.powers is None else {"powers": self.powers.tolist()})

    def load_state(self, kept: dict[str, Any]) -> None:
        """Restore this rank's share from a checkpoint, after the state."""
        self.sums[:] = kept["sums"]  # those of a batch are added in another order than here
        self._pending = [float(value) for value in kept["pending"]]
        self.impulses.load_state(kept["impulses"])
        if "powers" in kept:
            self.powers = np.array(kept["powers"])
            self._release()

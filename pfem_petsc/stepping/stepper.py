"""One step of a scheme: phases, loads, prescribed motion, the solve for the position increment, and the update of
the state.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..contact.active_set import start_at_rest
from ..contact.contact import CarriedNodes
from ..contact.free_walls import TurnsTooFarError
from ..contact.node_walls import WallForces
from ..errors import SimulationFailure
from ..integrators.base import Balance, Scheme, State
from ..mechanics.bars import StrainEnergy, release
from ..output.units import LOAD_FACTOR, Axis
from ..output.units import TIME as AXIS
from ..tolerances import BEYOND, ON_BOUND, TIME
from .bar_events import Collapse, Removals, Ruptures, collapse_message

if TYPE_CHECKING:
    from .model import Model


class Instants(NamedTuple):
    """What rows of the history need of the ends of m steps.

    Attributes
    ----------
    number, place : (m,) numbers of the steps, and times in the results, over all stages [s]
    time : (m,) from the start of the stage [s]
    shares : (m, width) of this rank, see :class:`~pfem_petsc.columns.Share`
    noted : (m,) number of steps after each of which the contact log had noted the walls that were touched
    """

    number: np.ndarray
    place: np.ndarray
    time: np.ndarray
    shares: np.ndarray
    noted: np.ndarray


class Step(NamedTuple):
    """Report of a finished step.

    Attributes
    ----------
    step, time : number and time [s] of the state after the step
    newton, linear : numbers of iterations
    row : of the history, None if the step has none
    """

    step: int
    time: float
    newton: int
    linear: int
    row: dict[str, Any] | None


class PrescribedMotion:
    """Sets prescribed components in the balances and the state of a stepper. Supports in balances without inertia
    prescribe positions alone, which are part of the guess.

    Attributes
    ----------
    change : sums over this rank's nodes (3,) of the mass times the changes of velocity, acceleration and scheme memory
        of prescribed components relative to those of the scheme in the last step, by name; empty without moving
        supports
    """

    def __init__(self, stepper: Stepper) -> None:
        self.stepper, self.supports = stepper, stepper.model.supports
        self.moving = self.supports.moving and stepper.scheme.inertial
        self.change: dict[str, np.ndarray] = {}

    def place(self, end: float) -> None:
        """Set prescribed components of the positions to their values at a time [s]."""
        self.supports.place(self.stepper.state.position, self.supports.positions(end))

    def prescribe(self, balance: Balance) -> None:
        """Set exact positions, velocities and accelerations of prescribed components in a balance; their increments are
        zero. The scheme's own formulas would derive velocities and accelerations from positions and oscillate."""
        supports, stepper = self.supports, self.stepper
        v, a = supports.rates(sum(weight * time for weight, time in balance.loads), stepper.part)
        # what the scheme would make of these accelerations, by the rule by which forces become impulses
        known = {name: getattr(balance, name) for name in ("predictor", "v_hat", "a_hat")}
        own = replace(
            balance, **{name: None if each is None else supports.get(each)[:, None] for name, each in known.items()}
        )
        self._ruled = self._along()
        u = (a[:, None] if own.a_hat is None else a[:, None] - own.a_hat) / own.alpha
        stepper.scheme.finish(self._ruled, own, u, stepper.part)
        balance.predictor, balance.v_hat = balance.predictor.copy(), balance.v_hat.copy()
        balance.a_hat = np.zeros_like(balance.v_hat) if balance.a_hat is None else balance.a_hat.copy()
        supports.place(balance.predictor, supports.positions(balance.time))
        supports.put(balance.v_hat, v)
        supports.put(balance.a_hat, a)

    def take_rates(self, time: float) -> None:
        """Set velocity, acceleration and scheme memory of prescribed components at a time [s]."""
        supports, state = self.supports, self.stepper.state
        for array, values in zip((state.v, state.a), supports.rates(time, self.stepper.part), strict=True):
            supports.put(array, values)
        along = self._along()
        self.stepper.scheme.restart(along, np.arange(supports.number), self.stepper.part)
        for name, values in along.memory.items():
            supports.put(state.memory[name], values[:, 0])
        if self.stepper.scheme.solves_next_position:
            end = self.stepper.balance.time
            way = supports.positions(end) - supports.positions(time)
            supports.put(state.memory["half_velocity"], way / (end - time))
        self.change = {}  # the scheme may have no memory at the end of this balance
        for name, array in self._ruled.rates.items():
            change = np.zeros_like(state.v)
            supports.put(change, supports.get(state.rates[name]) - array[:, 0])
            self.change[name] = self.stepper.model.inertia.mass_times(change, np.empty_like(change)).sum(axis=0)

    def _along(self) -> State:
        """Return the state (k, 1) of the prescribed components."""
        stepper, memory = self.stepper, self.stepper.state.memory
        names = [name for name in stepper.scheme.remembers if name in memory]
        arrays = stepper.state.position, stepper.state.v, stepper.state.a, *(memory[name] for name in names)
        x, v, a, *kept = (self.supports.get(array)[:, None] for array in arrays)
        return State(x, v, a, *np.zeros((4, *x.shape)), memory=dict(zip(names, kept, strict=True)))


@dataclass
class Solution:
    """Result of solving one balance.

    Attributes
    ----------
    u : (owned, 3) increment from the predictor [m]
    internal : (local, 3) internal force in the balance [N]
    walls : forces per wall, this rank's share
    newton, linear : numbers of iterations
    contacts : number of this rank's nodes in contact with walls
    """

    u: np.ndarray
    internal: np.ndarray
    walls: WallForces
    newton: int = 0
    linear: int = 0
    contacts: int = 0


class AttributeOf:
    """An attribute of a part of a stepper, by its path, that checkpoints keep as one of the stepper. Of a part that is
    None, it is ``absent`` and nothing is set: a restart may have other settings."""

    def __init__(self, path: str, absent: Any = None) -> None:
        part, _, self._name = path.rpartition(".")
        self._part, self._absent = attrgetter(part), absent

    def __get__(self, stepper: Stepper, owner: type | None = None) -> Any:
        part = self._part(stepper)
        return self._absent if part is None else getattr(part, self._name)

    def __set__(self, stepper: Stepper, value: Any) -> None:
        part = self._part(stepper)
        if part is not None:
            setattr(part, self._name, value)


class Stepper(ABC):
    """Advances the state by the scheme; subclasses solve the balance.

    Examples are explicit and implicit time steps and static paths, whose time is the load factor. Recording,
    checkpoints, requests to stop and progress use :attr:`plan`, :attr:`last_step`, :meth:`start`, :meth:`leave`,
    :meth:`obstacle`, :meth:`advance` and :meth:`destroy`, and do not depend on the analysis.

    Attributes
    ----------
    plan : resolved settings of the run: ``end``, ``steps``, ``linear``, ``entries``, ``beyond``, ``record``
    state : State
    energy : StrainEnergy of this rank's bars at the state's positions
    solution : of the last balance
    balance : the last balance
    fault : a failure that only this rank knows; the earliest is raised on all ranks at the next synchronisation
    fault_step : number of the last finished step when the fault was found
    h : the case's time step [s]; ``part`` the size of the current part, ``smallest`` the smallest part of the last step
    treatment : of impact, None for the scheme's own formulas
    ledger : :class:`~pfem_petsc.stepping.ledger.Ledger`, which accumulates each part of a step; None for steps that
        nothing records
    iterations : numbers of Newton and linear iterations since the last row of the history
    before : (local, 3) positions at the start of the last part, with ghosts [m]
    touching, closed : (owned, slots) bool, contacts of nodes with walls after the last step; nodes that have touched a
        wall and not left it since
    massless : MasslessNodes if contact nodes are massless along their walls' normals, else None
    prescribed : PrescribedMotion of supports
    ruptures : Ruptures, which counts broken bars
    removals : Removals of bars and supports
    carried : CarriedNodes, which supports may carry through rectangles
    support_changes : how often components have ceased or begun to be prescribed
    step_changed : whether the scheme was notified of another step size since the ledger's last update
    totals_at_start, totals_solved : (3, 3) this rank's sums of support, external and damping force [N] at the start,
        and of the balance solved there by a scheme that solves for the next position; None after a restart
    velocity_solved : (owned, 3) velocity of that balance if there is damping, whose force depends on it [m/s]
    walls_at_start, links_at_start : WallForces, and forces of tables of links (tables, 3) [N], at the start
    kept_numbers, kept_arrays, kept_bars : names of attributes that, with the state, determine what comes: numbers,
        arrays with a row for each owned node, and for each local bar
    columns : names of attributes, numbers, that are columns of the history
    remedy : what the user can do against steps that are too large
    row_every : steps between rows of the history, which compiled steps collect in ``instants``; 0: none
    probed : nodes whose motion and forces these have
    instants : of the last call, until they are recorded, the same on all ranks; None without
    event_columns : columns of events and their types; empty for steppers without events
    events : found with the last step and not recorded yet, the same on all ranks; each has ``row()`` and a text
    """

    plan: Any
    kept_numbers: tuple[str, ...] = ("part", "smallest", "removal_times", "removed_supports")
    kept_arrays: tuple[str, ...] = ("touching", "closed", "removed_reactions")
    kept_bars: tuple[str, ...] = ()
    columns: tuple[str, ...] = ()
    remedy = "reduce time.step"
    touching, closed = AttributeOf("model.contact.log.touching"), AttributeOf("model.contact.log.closed")
    removal_times, removed_supports = AttributeOf("removals.times"), AttributeOf("removals.gone")
    removed_reactions = AttributeOf("removals.released")
    event_columns: Mapping[str, Any] = {}
    events: Sequence[Any] = ()

    def __init__(self, model: Model, scheme: Scheme, h: float) -> None:
        self.model = model
        self.scheme = scheme
        self.h = self.part = self.smallest = h
        self.treatment = None  # of impact; see pfem_petsc.contact.treatments
        self.ledger: Any = None
        self.iterations = [0, 0]
        self.row_every, self.probed = 0, np.empty(0, dtype=np.int64)
        self.instants: Instants | None = None
        mesh = model.mesh
        owned = mesh.n_owned
        self.energy = StrainEnergy()
        self._fault: SimulationFailure | None = None
        self.fault_step = 0
        self.balance: Balance | None = None
        self.zero = np.zeros((owned, 3))  # read-only placeholder for absent forces
        self.state = State(
            x=mesh.points.copy(),
            v=self.zero,
            a=self.zero,
            f=np.zeros((mesh.n_local, 3)),
            external=self.zero,
            contact=self.zero,
            support=self.zero,
        )
        self.before = mesh.points.copy()
        model.contact.state = self.state
        moved = model.inertia.redistribution
        self.massless = None if moved is None else moved.massless(model)
        self.step_changed = False
        self.support_changes = 0
        self.prescribed = PrescribedMotion(self)
        self.ruptures = Ruptures(model.bars, mesh)
        self.removals = Removals(model)
        self.carried = CarriedNodes(model.contact)
        self.totals_at_start: np.ndarray | None = None
        self.totals_solved: np.ndarray | None = None
        self.velocity_solved = self.zero
        self.walls_at_start = model.contact.nothing
        self.links_at_start = model.links.totals()
        self.solution = Solution(self.zero, self.state.f, model.contact.nothing)

    @property
    def fault(self) -> SimulationFailure | None:
        """The first failure that only this rank knows; setting it stores the number of the last finished step."""
        return self._fault

    @fault.setter
    def fault(self, fault: SimulationFailure | None) -> None:
        if self._fault is None:
            self._fault, self.fault_step = fault, self.number

    def start(self) -> None:
        """Initialise velocity, internal force and acceleration of the state. Collective."""
        state, model = self.state, self.model
        velocity = model.initial_velocity()
        state.v = velocity if model.start is None else state.v + velocity
        supports = model.supports
        supports.place(state.position, supports.positions(0.0))
        supports.put(state.v, supports.rates(0.0, 0.0)[0])
        if self.massless is not None and self.massless.settle(state.x, 0.0, 0.0) > BEYOND * model.size:
            self.fault = SimulationFailure(
                "step 0, t = 0 s: contact nodes without mass found no equilibrium; use another contact.treatment"
            )
        self.evaluate(commit=True)
        if model.external.active:
            state.external = self.load_now(0.0)
        load = state.external - state.f[: model.mesh.n_owned]
        if model.inertia.damped:
            load -= model.inertia.damping_times(state.v, np.zeros_like(load))
        state.a = self._acceleration_for(load)
        if model.can_touch and model.inertia.redistribution is None:
            still = ON_BOUND * model.wave_speed
            walls = start_at_rest(model.links, model.inertia, state, self._acceleration_for, load, still)
            if walls is not None:
                held = model.links.count_held(walls.nodes[walls.touching.any(axis=1)])
                self.solution.walls, self.solution.contacts = walls, held
        if self.massless is not None:
            state.contact, self.solution.walls = self.massless.press(state.position, load, 0.0)
            self.solution.contacts = int(self.solution.walls.touching.sum())
        if supports.any:
            inertial = model.inertia.mass_times(state.a, np.empty_like(state.a))
            state.support = supports.part(inertial - load - state.contact)
        self.totals_at_start = self.totals()
        self.walls_at_start = self.solution.walls
        self.links_at_start = model.links.totals()
        self.part = self.part_before_start
        self.scheme.start(state, self.part)
        if model.bars.viscous and self.scheme.solves_next_position:  # the rate half a step before, to extrapolate from
            half = self.on_all(state.memory["half_velocity"])
            before = self.part / (self.part + self.scheme.substeps[0][0] * self.h)
            model.bars.set_rates(state.x, state.x - (0.5 * self.part) * half, -before * half, 0.0)
        bodies = model.contact.motion.bodies
        bodies.start(self.part)
        if self.scheme.solves_next_position:
            v, speeds = state.v, bodies.state.v
            with self.turns_named():
                self._make_balance(state.time)
            self.totals_solved = self.totals()
            if model.inertia.damped:
                self.velocity_solved = state.v
            # nodes on a wall have not lost their velocity yet; the scheme continues from its own memory
            state.v = v
            bodies.state.v = speeds
        self.part = self.h

    @property
    def part_before_start(self) -> float:
        """Size of a substep that ends where the first step starts [s]."""
        return self.scheme.substeps[-1][0] * self.h

    def start_without_motion(self) -> None:
        """Initialise positions, internal forces and loads at time zero, where nothing moves. Collective."""
        state, model = self.state, self.model
        state.v = np.zeros_like(self.zero)
        state.a = np.zeros_like(self.zero)
        model.supports.place(state.position, model.supports.positions(0.0))
        self.evaluate(commit=True)
        if model.external.active:
            state.external = model.external.at(0.0, np.empty_like(state.v))

    def _acceleration_for(self, load: np.ndarray) -> np.ndarray:
        """Return the acceleration (owned, 3) with M a = load [N], prescribed values included. Collective."""
        supports = self.model.supports
        if not supports.moving:
            return self.accelerate(load)
        carried = np.zeros_like(load)
        supports.put(carried, supports.rates(self.state.time, 0.0)[1])
        a = self.accelerate(load - self.model.inertia.mass_times(carried, np.empty_like(load)))
        supports.put(a, supports.get(carried))
        return a

    def acceleration(self) -> np.ndarray:
        """Acceleration (owned, 3) to record [m/s2], see :meth:`recorded`. Collective."""
        return self.recorded()[0]

    def recorded(self) -> tuple[np.ndarray, np.ndarray]:
        """Return acceleration [m/s2] and forces of supports [N] to record, (owned, 3). Collective.

        If the balance holds at the ends of steps, they are those of the scheme. For other schemes these are of first
        order or hold at another time, so free nodes get the acceleration by the forces at the end of the step, and
        supports the forces that the balance requires there.
        """
        state, model, scheme = self.state, self.model, self.scheme
        if scheme.balance_at_endpoints or state.time == 0.0:
            return state.a, state.support
        load = -state.f[: len(state.a)]
        if model.external.active:
            load += self.load_now(state.time)
        model.inertia.change(state.time)
        if model.inertia.damped:
            load -= model.inertia.damping_times(state.v, np.empty_like(load))
        held = load + state.contact
        touched = (state.contact != 0.0).any(axis=1)[:, None]
        known = np.where(touched, state.a, model.supports.part(state.a))
        if model.inertia.consistent:
            load += state.contact - model.inertia.mass_times(known, np.empty_like(load))
        a = self.accelerate(load)
        model.supports.put(a, model.supports.get(known))
        a = np.where(touched, state.a, a)
        if not model.supports.any:
            return a, state.support
        return a, model.supports.part(model.inertia.mass_times(a, np.empty_like(a)) - held)

    def held_by_contact(self) -> tuple[np.ndarray, float] | None:
        """Return the positions (owned, 3) [m] and the time [s] at which contact holds; None if they are not known, as
        at the start or right after a restart."""
        if self.scheme.solves_end:
            return self.state.position, self.state.time
        if self.balance is None:
            return None
        return self.balance.predictor + self.solution.u, self.balance.time

    def totals(self) -> np.ndarray:
        """Return this rank's sums (3, 3) of support, external and damping force [N] at the state."""
        state, inertia = self.state, self.model.inertia
        damping = -inertia.damping_times(state.v, np.empty_like(state.v))
        return np.array([self.support_force(state.support), state.external.sum(axis=0), damping.sum(axis=0)])

    def support_force(self, support: np.ndarray) -> np.ndarray:
        """Return this rank's sum (3,) of forces of supports (owned, 3) and of springs to the ground [N]."""
        total = support.sum(axis=0)
        if self.model.bars.springs is not None:  # the forces of bars cancel in the sum over all ranks
            total -= self.state.f[: len(support)].sum(axis=0)
        return total

    def arrived(self) -> str:
        """The step whose end the state is at, complete or not, and its time, for messages."""
        # the step is counted when it is complete, its time is set on arrival
        step = self.state.step + (self.state.time > (self.state.step + TIME) * self.h)
        return self.at(step, self.state.time)

    def at(self, step: int, time: float) -> str:
        """A step and a time of the stage as they are counted in the results, for messages."""
        place = AXIS.exact(self.model.origin + time) if self.scheme.inertial else LOAD_FACTOR.exact(time)
        return f"step {self.model.first_step + step}, {place}"

    @property
    def jump(self) -> Any:
        """Velocity jumps of the treatment in the last part, see :mod:`~pfem_petsc.contact.treatments.base`; None if
        there were none."""
        return None if self.treatment is None else self.treatment.jump

    @property
    def number(self) -> int:
        """Number of the last step, over all stages."""
        return self.model.first_step + self.state.step

    @property
    def place(self) -> float:
        """Time of the state in the results, over all stages."""
        return self.model.origin + self.clock

    @property
    def axis(self) -> Axis:
        """What :attr:`place` is in this stage: load factors and points of a path are counted from its start."""
        axis = self.plan.axis
        return axis if axis.unit else axis._replace(start=self.model.origin)

    @property
    def clock(self) -> float:
        """Time of the state in the results, from the start of the stage; increases from step to step."""
        return self.state.time

    @property
    def last_step(self) -> int:
        """Number of the last step; larger than any step while it is unknown."""
        return self.plan.steps

    def obstacle(self) -> str:
        """Return why no step can be made, as far as it is known before the first; empty otherwise. Collective."""
        return ""

    def advance(self, most: int = 1) -> Step:
        """Make one step, or up to ``most`` if nothing needs Python between them, and return the last one; its ``row``
        is None, because rows are made by recording. Collective.

        Raises
        ------
        SimulationFailure
            On all ranks; the state is the last complete one, or undefined.
        """
        self.steps(min(most, self.last_step - self.state.step))
        return Step(self.number, self.place, self.solution.newton, self.solution.linear, None)

    def steps(self, most: int) -> None:
        """Make at least one step, and at most ``most`` if nothing needs Python between them. Collective."""
        self.step()

    def step(self) -> None:
        """Advance from t_n to t_{n+1}; the state is complete at both. Collective if the solve is."""
        self._make_substeps((self.state.step + 1) * self.h)
        self.leave()
        self.state.step += 1

    def _make_substeps(self, end: float) -> None:
        """Advance by ``part`` to a time [s], balance by balance of the scheme."""
        begun, part = self.state.time, self.part
        try:
            before, made = self.part_before_start, []
            for share, place in self.scheme.substeps:
                self.part = share * part
                if self.model.bars.viscous and self.part != before and self.scheme.solves_next_position:
                    self.model.bars.extrapolate_rates(self.part / before)
                before = self.part
                self._make_part(end if place == 1.0 else begun + place * part)
                made.append((share, self.solution))
            if len(made) > 1:  # rows have the mean forces of walls in the step
                walls = [each.walls for _, each in made]
                force, moment = (
                    sum(share * getattr(each.walls, name) for share, each in made) for name in ("force", "moment")
                )
                contacts = np.maximum.reduce([each.contacts for each in walls])
                self.solution = replace(
                    self.solution,
                    walls=replace(walls[-1], force=force, moment=moment, contacts=contacts),
                    contacts=max(each.contacts for _, each in made),
                )
        finally:
            self.part = part

    def leave(self) -> None:
        """Remove the bars and supports that are to go at the time reached. Collective."""
        self.remove_due()

    def remove_due(self) -> bool:
        """Remove what is due at the state's time; return whether any bar or support of this rank's part changed.

        Supports change on all ranks or on none.
        """
        changed = False
        for entry, share, begins in self.removals.due(self.state.time, self.h):
            changed = True
            if entry.bars is not None:
                self._remove_bars(self.removals.members[str(entry.bars)], share)
            elif begins:
                self.removals.release(entry, self.recorded()[1], self.state.time)
                self.supports_changed()
            elif share == 1.0:
                self.model.external.reactions.pop(entry.supports, None)
                self.load_ended()
        return changed

    def follow_removals(self, before: Removals) -> None:
        """Begin a stage after that of other removals: removals remain, and bars are removed entirely."""
        for members in before.begun_bars():
            self._remove_bars(members, 1.0)
        if self.model.case.holds("support") and before.gone:
            self.removals.gone = list(before.gone)
            self.model.supports.release(before.gone)
            self.supports_changed()

    def _remove_bars(self, members: np.ndarray, share: float) -> None:
        """Remove a share of local bars, with their energy."""
        change = release(self.model.bars, self.state.x, members, share)
        self.bars_left()
        energies = np.array(self.energy.energies) + change
        self.energy = self.energy._replace(energies=tuple(energies.tolist()))
        if self.ledger is not None:
            self.ledger.follow_removal()

    def bars_left(self) -> None:
        """Take account of bars of this rank that have left the model: they touch no others."""
        if self.model.self_contact is not None:
            self.model.self_contact.stale = True

    def supports_changed(self) -> None:
        """Take account of components that are no longer prescribed, or now are. Collective."""
        self.support_changes += 1

    def load_ended(self) -> None:  # noqa: B027 - most steppers evaluate loads in each step
        """Take account of a load that has ended. Collective."""

    def resume(self) -> None:
        """Continue from a state that was restored from a checkpoint. Collective."""
        self.model.inertia.change(self.state.time)
        self.ruptures.begin()
        self.removals.resume(self.state.time)
        if self.removals.gone:
            self.supports_changed()

    def _make_part(self, end: float) -> None:
        """Advance by ``part`` to the time ``end`` [s]."""
        state, scheme, prescribed = self.state, self.scheme, self.prescribed
        with self.turns_named():
            if self.model.bars_vary:
                self.model.bars.keep_start()
            self.carried.start(state.position, state.time)
            if self.treatment is not None:
                self.treatment.before()
            if scheme.solves_next_position:  # move to the positions that the last balance was solved for
                self.before[:] = state.x
                scheme.advance(state, self.part)
                if prescribed.moving:
                    prescribed.place(end)
                self._evaluate_end(end)
            self._make_balance(end)
            if not scheme.solves_next_position:
                if prescribed.moving:
                    prescribed.place(end)
                    prescribed.take_rates(end)
                self._evaluate_end(end)
            if self.treatment is not None:
                self.treatment.after()
            self._account()
            crossing = self.carried.of and self.carried.crossing(state.position, end, self.at(state.step + 1, end))
            if crossing:
                self.fault = SimulationFailure(crossing)

    def _evaluate_end(self, end: float) -> None:
        """Evaluate forces and energies at the positions reached, and keep the internal variables. Collective."""
        model = self.model
        if self.scheme.inertial:  # static steps are infinitely long for material laws
            model.bars.step = self.part
        self.state.time = end
        model.change_bars(end)
        self.evaluate(commit=True)

    def _make_balance(self, end: float) -> None:
        """Solve the balance of the part, with the loads, supports, dampers and walls of its times; update velocities,
        accelerations, walls and the contact log. Collective."""
        state, model, scheme, contact = self.state, self.model, self.scheme, self.model.contact
        self.balance = balance = scheme.balance(state, self.part)
        if self.prescribed.moving:
            self.prescribed.prescribe(balance)
        # exactly the end, at which a continued run takes the damping of the state it starts from
        mean = sum(weight * time for weight, time in balance.loads)
        model.inertia.change(end if scheme.balance_at_endpoints else mean)
        contact.motion.bodies.begin(state.time, self.part)
        state.external = self.load_of(balance)
        if scheme.inertial:
            model.bars.step = balance.time - state.time
        self.solution = self.solve(balance)
        fresh = contact.record(self.solution.walls, balance.time, self.part)
        if not scheme.solves_next_position:
            self.before[:] = state.x
        scheme.finish(state, balance, self.solution.u, self.part)
        if scheme.solves_next_position and self.prescribed.moving:
            self.prescribed.take_rates(state.time)
        contact.motion.bodies.finish(self.part, end)
        if scheme.turns_held and self.treatment is None:
            contact.ties.damp_velocity(*fresh, state.v, balance.time, self.part)

    def _account(self) -> None:
        """Update the ledger."""
        self.iterations[0] += self.solution.newton
        self.iterations[1] += self.solution.linear
        if self.ledger is not None:
            self.ledger.update()

    def load_of(self, balance: Balance) -> np.ndarray:
        """Return the external force (owned, 3) [N] of a balance that is not solved yet. Collective."""
        external = self.model.external
        if not external.active:
            return self.zero
        total = external.constant()
        if total is not None:
            return total
        for weight, time in balance.loads:
            if external.state_forces:
                external.follow(*self._expected(balance, time))
            part = external.at(time, np.empty_like(self.state.v))
            part *= weight
            total = part if total is None else total + part
        if external.failure is not None:
            self._fail_load(self.when(balance))
        return total

    def load_now(self, time: float) -> np.ndarray:
        """Return the external force (owned, 3) [N] at a time [s] and the present state. Collective."""
        external = self.model.external
        if external.state_forces:
            external.follow(self.state.position, self.state.v)
        force = external.at(time, np.empty_like(self.state.v))
        if external.failure is not None:
            self._fail_load(self.arrived())
        return force

    def _fail_load(self, where: str) -> None:
        self.fault = SimulationFailure(f"{where}: external_force: the function {self.model.external.failure}")

    def _expected(self, balance: Balance, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Return positions and velocities (owned, 3) at a time [s] of a balance that is not solved yet.

        The acceleration is that of the state; nodes in contact, whose acceleration may jump, are predicted without it.
        """
        state = self.state
        a = np.where((state.contact != 0.0).any(axis=1)[:, None], 0.0, state.a)
        if self.scheme.solves_next_position:  # the velocity of the state is that of the step before
            known = 0.0 if balance.a_hat is None else balance.a_hat
            return state.position, balance.v_hat + (balance.eta / balance.alpha) * (a - known)
        ahead = time - state.time
        return state.position + ahead * (state.v + (0.5 * ahead) * a), state.v + ahead * a

    def remarks(self) -> list[str]:
        """What users should know at the end of a run."""
        return []

    def doubts(self) -> list[str]:
        """What makes results doubtful, as warnings at the end of a run. Collective."""
        return [] if self.model.self_contact is None else self.model.self_contact.doubts()

    def settle(self) -> None:  # noqa: B027 - steps leave nothing to settle, static ones aside
        """Reduce the residual of a static state to rounding, before a stage that begins there. Collective."""

    def destroy(self) -> None:  # noqa: B027 - most steppers have nothing to free
        """Free PETSc objects; the stepper cannot make further steps. Collective; may be called again."""

    def when(self, balance: Balance) -> str:
        """Return the step of a balance and the time at which it holds, for messages."""
        step = self.state.step + 1
        if self.scheme.solves_next_position:  # the position solved for may belong to the next step
            step += balance.time > (step + TIME) * self.h
        return self.at(step, balance.time)

    @contextmanager
    def turns_named(self) -> Iterator[None]:
        """Name the step of the present balance in the failure of a wall that turns too far."""
        try:
            yield
        except TurnsTooFarError as failure:
            raise SimulationFailure(f"{self.when(self.balance)}: {failure}") from failure

    def evaluate(self, commit: bool) -> None:
        """Evaluate internal force and energies at the state's positions; a collapsed bar becomes a fault."""
        state, bars, scheme = self.state, self.model.bars, self.scheme
        self.model.mesh.update_ghosts(state.x)
        if bars.viscous and scheme.inertial and (bars.step == 0.0 or scheme.rates_follow):
            bars.set_rates(self.before, state.x, self.on_all(state.v), 0.0)
        try:
            self.energy = bars.forces(state.x, state.f, commit)
        except SimulationFailure as failure:  # on all ranks, of bars that touch
            raise SimulationFailure(f"{self.arrived()}: {failure}") from failure
        if commit and self.energy.changed:
            self.ruptures.note(state.x, self.number + 1, self.arrived())
            self.bars_left()
        failed = self.energy.failed
        if failed < 0 and self.energy.shortened:
            failed = bars.first_inverted(state.x, self.before)
        if failed >= 0:
            self.fault = SimulationFailure(self.collapse(failed))

    def on_all(self, values: np.ndarray) -> np.ndarray:
        """Return values (owned, 3) of nodes with those of ghosts, (local, 3). Collective."""
        every = np.empty_like(self.state.x)
        every[: len(values)] = values
        self.model.mesh.update_ghosts(every)
        return every

    def collapse(self, bar: int) -> str:
        """Return the message about a bar (local index) that failed in the current step."""
        found = Collapse(bar, self.state.x, self.before, self.part, bar == self.energy.failed)
        implicit = not self.scheme.explicit and self.scheme.inertial
        return collapse_message(self.model, found, self.arrived(), (self.remedy, implicit))

    def accelerate(self, load: np.ndarray) -> np.ndarray:
        """Return the acceleration (owned, 3) with M a = load [N], zero on prescribed components. Collective."""
        inertia = self.model.inertia
        a, moved = load / inertia.mass[:, None], inertia.redistribution
        if moved is not None:
            a[moved.touched] = np.einsum("kij,kj->ki", moved.inverses, load[moved.touched])
        self.model.supports.clear(a)
        return a

    @abstractmethod
    def solve(self, balance: Balance) -> Solution:
        """Solve a balance, and set contact and support forces in the state."""

"""One step of a scheme: the solve for the position increment, with walls, and what it leaves in the state."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from ..contact.alarm import CarriedNodes
from ..contact.initial_equilibrium import start_at_rest
from ..errors import SimulationFailure
from ..integrators.base import Balance, Scheme, State
from ..mechanics.bars import StrainEnergy
from ..tolerances import BEYOND, TIME
from .collapse import tell_collapse
from .massless import MasslessNodes
from .prescribed import PrescribedMotion
from .solution import Solution

if TYPE_CHECKING:
    from .model import Model

__all__ = ["Stepper"]


class Stepper(ABC):
    """Advances the state by the scheme; subclasses solve the balance.

    Attributes
    ----------
    state : State
    energy : StrainEnergy of this rank's bars at the state's positions
    solution : of the last balance
    balance : the last balance
    fault : a failure that only this rank has met yet; raised on all when ranks next meet
    h : the case's time step [s]; ``part`` the part of it being made, ``smallest`` the smallest part of the last step
    treatment : of impact, None for the scheme's own formulas
    booking : called after each part of a step
    before : (local, 3) positions at the start of the last part, with ghosts [m]
    massless : MasslessNodes where contact nodes have no mass along their walls' normals, else None
    closed : (owned, walls) bool, nodes that have met a wall and not left it since
    prescribed : PrescribedMotion of supports
    step_changed : whether the scheme was told to forget what holds for another step, since the last booking
    totals_at_start, totals_solved : (3, 3) this rank's sums of support, external and damping force [N] at the start,
        and of the balance that was solved there by a scheme that leads; None after a restart
    velocity_solved : (owned, 3) of that balance, in which its damping force acts [m/s]
    walls_at_start, links_at_start : (walls, 3), (tables of links, 3) forces at the start [N]
    renews_forces : each evaluation of the state fills another array ``state.f``, so that the last one is kept
    steady : the loop over many steps (``stepping/fused_loop.py``) makes the same steps, where all else allows it
    kept_numbers, kept_arrays, kept_bars : names of attributes that, with the state, determine what comes: numbers,
        arrays with a row for each owned node, and for each local bar
    columns : names of attributes, numbers, that are columns of the history
    remedy : what the user can do against steps that are too large
    """

    kept_numbers: tuple[str, ...] = ("part", "smallest")
    kept_arrays: tuple[str, ...] = ("touching", "closed")
    kept_bars: tuple[str, ...] = ()
    columns: tuple[str, ...] = ()
    remedy = "reduce time.step"
    renews_forces = False
    steady = False

    def __init__(self, model: Model, scheme: Scheme, h: float) -> None:
        self.model = model
        self.scheme = scheme
        self.h = self.part = self.smallest = h
        self.treatment = None  # of impact; see pfem_petsc.contact.treatments
        self.booking: Callable[[], None] = lambda: None
        mesh = model.mesh
        owned = mesh.n_owned
        self.energy = StrainEnergy()
        self.fault: SimulationFailure | None = None
        self.balance: Balance | None = None
        self.zero = np.zeros((owned, 3))  # stands for forces that do not act: never written
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
        self.touching = model.contact.log.touching
        self.massless = MasslessNodes(model) if model.inertia.redistribution is not None else None
        self.closed = np.zeros_like(self.touching)
        self.step_changed = False
        self.prescribed = PrescribedMotion(self)
        self._carried = CarriedNodes(model.contact)
        self.totals_at_start: np.ndarray | None = None
        self.totals_solved: np.ndarray | None = None
        self.velocity_solved = self.zero
        self.walls_at_start = np.zeros((len(model.contact.names), 3))
        self.links_at_start = model.links.totals()
        self.solution = Solution(self.zero, self.state.f, model.contact.nothing)

    def start(self) -> None:
        """Complete the state at the start: velocity, internal force, acceleration. Collective."""
        state, model = self.state, self.model
        state.v = model.initial_velocity()
        supports = model.supports
        if supports.any:
            state.position[supports.at] = supports.positions(0.0)
            state.v[supports.at] = supports.rates(0.0, 0.0)[0]
        if self.massless is not None and self.massless.settle(state.x, 0.0, 0.0) > BEYOND * model.length:
            self.fault = SimulationFailure(
                "step 0, t = 0 s: contact nodes without mass found no equilibrium; take another contact.treatment"
            )
        self.evaluate(commit=True)
        if model.external.active:
            state.external = model.external.at(0.0, np.empty_like(state.v))
        load = state.external - state.f[: model.mesh.n_owned]
        if model.inertia.damped:
            load -= model.inertia.damping_times(state.v, np.zeros_like(load))
        state.a = self._acceleration(load)
        if model.can_touch and model.inertia.redistribution is None:
            walls = start_at_rest(model, state, self._acceleration, load)
            if walls is not None:
                held = model.links.held(walls.nodes[walls.touching.any(axis=1)])
                self.solution.walls, self.solution.contacts = walls, len(held)
        if self.massless is not None:
            state.contact, self.solution.walls = self.massless.press(state.position, load, 0.0)
            self.solution.contacts = int(self.solution.walls.touching.sum())
        if supports.any:
            inertial = model.inertia.mass_times(state.a, np.empty_like(state.a))
            state.support = np.zeros_like(state.v)
            state.support[supports.fixed] = (inertial - load - state.contact)[supports.fixed]
        self.totals_at_start = self._totals()
        self.walls_at_start = self.solution.walls.force
        self.links_at_start = model.links.totals()
        self.scheme.start(state, self.h)
        motion = model.contact.motion
        motion.start(self.h)
        if self.scheme.solves_next_position:
            v, speeds = state.v, motion.speeds
            self._solve_and_finish(self.state.time)
            self.totals_solved = self._totals()
            self.velocity_solved = state.v
            # what is on a wall has not lost its velocity yet; the scheme goes on from its own memory
            state.v = v
            motion.set_speeds(speeds)

    def acceleration(self) -> np.ndarray:
        """Acceleration (owned, 3) to record [m/s2]; collective where the mass is consistent.

        Where the balance holds at the ends of steps it is the scheme's. For the others that is of first order, or holds
        at another time: nodes that nothing holds have the one of the forces at the end of the step.
        """
        state, model, scheme = self.state, self.model, self.scheme
        if scheme.balance_at_endpoints or state.step == 0:
            return state.a
        load = -state.f[: len(state.a)]
        if model.external.active:
            load += model.external.at(state.time, np.empty_like(load))
        if model.inertia.damped:
            load -= model.inertia.damping_times(state.v, np.empty_like(load))
        held = model.supports.fixed | (state.contact != 0.0).any(axis=1)[:, None]
        if model.inertia.consistent:
            known = np.where(held, state.a, 0.0)
            load += state.contact - model.inertia.mass_times(known, np.empty_like(load))
        return np.where(held, state.a, self.accelerate(load))

    def _totals(self) -> np.ndarray:
        state, inertia = self.state, self.model.inertia
        damping = -inertia.damping_times(state.v, np.empty_like(state.v))
        return np.array([state.support.sum(axis=0), state.external.sum(axis=0), damping.sum(axis=0)])

    def arrived(self) -> str:
        """The step whose end the state is at, complete or not, and its time, for messages."""
        # the step is counted when it is complete, its time is set on arrival
        step = self.state.step + (self.state.time > (self.state.step + TIME) * self.h)
        return f"step {step}, t = {self.state.time:.6g} s"

    @property
    def clock(self) -> float:
        """Time of the state in the results, which increases from step to step."""
        return self.state.time

    def step(self) -> None:
        """Advance from t_n to t_{n+1}; the state is complete at both. Collective where the solve is."""
        self._make_part((self.state.step + 1) * self.h)
        self.state.step += 1

    def _make_part(self, end: float) -> None:
        """Advance by ``part``, to the time ``end``."""
        state, carried = self.state, self._carried
        if self.model.temperatures.varying:
            self.model.bars.heat_at_start[:] = self.model.bars.heat
        places = carried.places(state.position, state.time) if carried.of else {}
        if self.treatment is not None:
            self.treatment.before()
        if self.scheme.solves_next_position:
            self.before[:] = self.state.x
            self.scheme.advance(self.state, self.part)
            self.prescribed.place(end)
            self._arrive(end)
            self._solve_and_finish(end)
        else:
            self._solve_and_finish(end)
            if self.prescribed.moving:
                self.prescribed.place(end)
                self.prescribed.take_rates(end)
            self._arrive(end)
        if self.treatment is not None:
            self.treatment.after()
        self.booking()
        if carried.of and self.fault is None:
            where = f"step {state.step + 1}, t = {end:.6g} s"
            crossing = carried.crossing(places, carried.places(state.position, end), where)
            self.fault = SimulationFailure(crossing) if crossing else None

    def _arrive(self, end: float) -> None:
        self.model.bars.step = self.part
        self.state.time = end
        if self.model.temperatures.varying:
            self.model.temperatures.apply(end)
        self.evaluate(commit=True)

    def _solve_and_finish(self, end: float) -> None:
        state = self.state
        self.balance = self.scheme.balance(state, self.part)
        if self.prescribed.moving:
            self.prescribed.prescribe(self.balance)
        self.model.contact.motion.begin(state.time, self.part)
        state.external = self._load(self.balance)
        self.model.bars.step = self.balance.time - state.time
        self.solution = self.solve(self.balance)
        fresh = self.model.contact.record(self.solution.walls, self.balance.time, self.part)
        if not self.scheme.solves_next_position:
            self.before[:] = state.x
        self.scheme.finish(state, self.balance, self.solution.u, self.part)
        if self.scheme.solves_next_position and self.prescribed.moving:
            self.prescribed.take_rates(state.time)
        self.model.contact.motion.finish(self.part, end)
        if self.scheme.turns_held and self.treatment is None:
            self.model.contact.calm(fresh, state.v, self.balance.time, self.part)

    def _acceleration(self, load: np.ndarray) -> np.ndarray:
        """Acceleration (owned, 3) with M a = load [N] on free components, on others as prescribed. Collective."""
        supports = self.model.supports
        if not supports.moving:
            return self.accelerate(load)
        carried = np.zeros_like(load)
        carried[supports.at] = supports.rates(self.state.time, 0.0)[1]
        a = self.accelerate(load - self.model.inertia.mass_times(carried, np.empty_like(load)))
        a[supports.at] = carried[supports.at]
        return a

    def _load(self, balance: Balance) -> np.ndarray:
        if not self.model.external.active:
            return self.zero
        total = np.zeros_like(self.state.v)
        part = np.empty_like(total)
        for weight, time in balance.loads:
            total += weight * self.model.external.at(time, part)
        return total

    def destroy(self) -> None:  # noqa: B027 - most steppers have nothing to free
        """Free PETSc objects: the stepper makes no further step. Collective; may be called again."""

    def when(self, balance: Balance) -> str:
        """The step that a balance is for, and the time that it holds at, for messages."""
        step = self.state.step + 1
        if self.scheme.solves_next_position and self.state.time > 0.0:
            step += 1  # the position solved for is that of the step after
        return f"step {step}, t = {balance.time:.6g} s"

    def evaluate(self, commit: bool) -> None:
        """Internal force and energies at the state's positions; a collapsed bar becomes a fault."""
        state, mesh = self.state, self.model.mesh
        mesh.update_ghosts(state.x)
        self.energy = self.model.bars.forces(state.x, state.f, commit)
        failed = self.energy.failed
        if failed < 0 and self.energy.shortened:
            failed = self.model.bars.first_inverted(state.x, self.before)
        if failed >= 0 and self.fault is None:
            self.fault = SimulationFailure(self.collapse(failed))

    def collapse(self, bar: int) -> str:
        """What to tell about a bar (local index) that failed in the step being made."""
        return tell_collapse(self, bar)

    @abstractmethod
    def accelerate(self, load: np.ndarray) -> np.ndarray:
        """Acceleration (owned, 3) with M a = load [N] on free components, zero on prescribed ones. Collective."""

    @abstractmethod
    def solve(self, balance: Balance) -> Solution:
        """Solve a balance, and leave contact and support forces in the state."""

"""One step of a scheme: the solve for the position increment, with contact, and the update of the state."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..contact.alarm import CarriedNodes
from ..errors import SimulationFailure
from ..integrators.base import Balance, Scheme, State
from ..mechanics.bars import StrainEnergy
from ..tolerances import TIME
from .collapse import tell_collapse
from .loading import load_now
from .massless import MasslessNodes
from .phases import phases_of
from .prescribed import PrescribedMotion
from .removals import Removals
from .ruptures import Ruptures
from .solution import Solution
from .start import start_at_zero, start_in_motion

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
    fault : a failure that only this rank knows; the earliest is raised on all ranks at the next synchronisation
    fault_step : number of the last finished step when the fault was found
    h : the case's time step [s]; ``part`` the size of the current part, ``smallest`` the smallest part of the last step
    treatment : of impact, None for the scheme's own formulas
    booking : called after each part of a step; bars_removed : after bars are removed between steps
    before : (local, 3) positions at the start of the last part, with ghosts [m]
    massless : MasslessNodes if contact nodes are massless along their walls' normals, else None
    closed : (owned, walls) bool, nodes that have touched a wall and not left it since
    prescribed : PrescribedMotion of supports
    ruptures : Ruptures, which counts broken bars
    removals : Removals of bars and supports
    carried : CarriedNodes, which supports may carry through rectangles
    support_changes : how often components have ceased or begun to be prescribed
    step_changed : whether the scheme was notified of another step size since the last booking
    totals_at_start, totals_solved : (3, 3) this rank's sums of support, external and damping force [N] at the start,
        and of the balance solved there by a scheme that solves for the next position; None after a restart
    velocity_solved : (owned, 3) velocity of that balance if there is damping, whose force depends on it [m/s]
    walls_at_start, links_at_start : (walls, 3), (tables of links, 3) forces at the start [N]
    renews_forces : each evaluation of the state fills another array ``state.f``, so that the last one is kept
    steady : the loop over many steps (``stepping/fused_loop.py``) makes the same steps, where all else allows it
    kept_numbers, kept_arrays, kept_bars : names of attributes that, with the state, determine what comes: numbers,
        arrays with a row for each owned node, and for each local bar
    columns : names of attributes, numbers, that are columns of the history
    remedy : what the user can do against steps that are too large
    event_columns : columns of events and their types; empty for steppers without events
    events : found with the last step and not recorded yet, the same on all ranks; each has ``row()`` and a text
    """

    kept_numbers: tuple[str, ...] = ("part", "smallest", "removal_times", "removed_supports")
    kept_arrays: tuple[str, ...] = ("touching", "closed", "removed_reactions")
    kept_bars: tuple[str, ...] = ()
    columns: tuple[str, ...] = ()
    remedy = "reduce time.step"
    event_columns: Mapping[str, Any] = {}
    events: Sequence[Any] = ()
    renews_forces = False
    steady = False

    def __init__(self, model: Model, scheme: Scheme, h: float) -> None:
        self.model = model
        self.scheme = scheme
        self.h = self.part = self.smallest = h
        self.treatment = None  # of impact; see pfem_petsc.contact.treatments
        self.booking: Callable[[], None] = lambda: None
        self.bars_removed: Callable[[], None] = lambda: None
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
        self.touching = model.contact.log.touching
        self.massless = MasslessNodes(model) if model.inertia.redistribution is not None else None
        self.closed = np.zeros_like(self.touching)
        self.step_changed = False
        self.prescribed = PrescribedMotion(self)
        self.ruptures = Ruptures(self)
        self.removals = Removals(self)
        self.support_changes = 0
        self.carried = CarriedNodes(model.contact)
        self.totals_at_start: np.ndarray | None = None
        self.totals_solved: np.ndarray | None = None
        self.velocity_solved = self.zero
        self.walls_at_start = np.zeros((len(model.contact.names), 3))
        self.links_at_start = model.links.totals()
        self.solution = Solution(self.zero, self.state.f, model.contact.nothing)

    @property
    def fault(self) -> SimulationFailure | None:
        """A failure that only this rank knows; setting it stores the number of the last finished step."""
        return self._fault

    @fault.setter
    def fault(self, fault: SimulationFailure | None) -> None:
        self._fault, self.fault_step = fault, self.number

    def start(self) -> None:
        """Initialise velocity, internal force and acceleration of the state. Collective."""
        start_in_motion(self)

    def start_without_motion(self) -> None:
        """Initialise positions, internal forces and loads at time zero, where nothing moves. Collective."""
        start_at_zero(self)

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
            load += load_now(self, state.time)
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
        return f"step {self.model.first_step + step}, t = {self.model.origin + time:.6g} s"

    @property
    def number(self) -> int:
        """Number of the last step, over all stages."""
        return self.model.first_step + self.state.step

    @property
    def place(self) -> float:
        """Time of the state in the results, over all stages."""
        return self.model.origin + self.clock

    @property
    def clock(self) -> float:
        """Time of the state in the results, from the start of the stage; increases from step to step."""
        return self.state.time

    def step(self) -> None:
        """Advance from t_n to t_{n+1}; the state is complete at both. Collective if the solve is."""
        self._make_part((self.state.step + 1) * self.h)
        self.leave()
        self.state.step += 1

    def leave(self) -> None:
        """Remove the bars and supports that are to go at the time reached. Collective."""
        self.removals.apply()

    def supports_changed(self) -> None:
        """Take account of components that are no longer prescribed, or now are. Collective."""
        self.support_changes += 1

    def resume(self) -> None:
        """Continue from a state that was restored from a checkpoint. Collective."""
        self.model.inertia.change(self.state.time)
        self.ruptures.begin()
        self.removals.resume()

    @property
    def removal_times(self) -> list[float]:
        """See :class:`~pfem_petsc.stepping.removals.Removals`, as the next two."""
        return self.removals.times

    @removal_times.setter
    def removal_times(self, times: list[float]) -> None:
        self.removals.times = [float(time) for time in times]

    @property
    def removed_supports(self) -> list[str]:
        """Names of the supports that are gone."""
        return self.removals.gone

    @removed_supports.setter
    def removed_supports(self, names: list[str]) -> None:
        self.removals.gone = list(names)

    @property
    def removed_reactions(self) -> np.ndarray:
        """Reactions of removed supports (owned, 3 k) [N]."""
        return self.removals.released

    @removed_reactions.setter
    def removed_reactions(self, forces: np.ndarray) -> None:
        self.removals.released[:] = forces

    def _make_part(self, end: float) -> None:
        """Advance by ``part`` to the time ``end`` [s]."""
        for phase in phases_of(self.scheme):
            phase(self, end)

    def remarks(self) -> list[str]:
        """What users should know at the end of a run."""
        return []

    def doubts(self) -> list[str]:
        """What makes results doubtful, as warnings at the end of a run. Collective."""
        return []

    def settle(self) -> None:  # noqa: B027 - steps leave nothing to settle, static ones aside
        """Reduce the residual of a static state to rounding, before a stage that begins there. Collective."""

    def destroy(self) -> None:  # noqa: B027 - most steppers have nothing to free
        """Free PETSc objects; the stepper cannot make further steps. Collective; may be called again."""

    def when(self, balance: Balance) -> str:
        """Return the step of a balance and the time at which it holds, for messages."""
        step = self.state.step + 1
        if self.scheme.solves_next_position and self.state.time > 0.0:
            step += 1  # the position solved for belongs to the next step
        return self.at(step, balance.time)

    def evaluate(self, commit: bool) -> None:
        """Evaluate internal force and energies at the state's positions; a collapsed bar becomes a fault."""
        state, bars, scheme = self.state, self.model.bars, self.scheme
        self.model.mesh.update_ghosts(state.x)
        if bars.viscous and scheme.inertial and (bars.step == 0.0 or scheme.rates_follow):
            bars.set_rates(self.before, state.x, self.on_all(state.v), 0.0)
        self.energy = bars.forces(state.x, state.f, commit)
        if commit and self.energy.changed:
            self.ruptures.note()
        failed = self.energy.failed
        if failed < 0 and self.energy.shortened:
            failed = bars.first_inverted(state.x, self.before)
        if failed >= 0 and self.fault is None:
            self.fault = SimulationFailure(self.collapse(failed))

    def on_all(self, values: np.ndarray) -> np.ndarray:
        """Return values (owned, 3) of nodes with those of ghosts, (local, 3). Collective."""
        every = np.empty_like(self.state.x)
        every[: len(values)] = values
        self.model.mesh.update_ghosts(every)
        return every

    def collapse(self, bar: int) -> str:
        """Return the message about a bar (local index) that failed in the current step."""
        return tell_collapse(self, bar)

    @abstractmethod
    def accelerate(self, load: np.ndarray) -> np.ndarray:
        """Return the acceleration (owned, 3) with M a = load [N], zero on prescribed components. Collective."""

    @abstractmethod
    def solve(self, balance: Balance) -> Solution:
        """Solve a balance, and set contact and support forces in the state."""

"""The phases of a step: functions of a stepper and of the time [s] at which its part of the step ends.

A scheme that solves for the next position moves first; all others solve first. The fused loop makes the phases of
:data:`MOVES_FIRST` too, for blocks of nodes, without what :attr:`~pfem_petsc.stepping.model.Model.steady` excludes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from ..errors import SimulationFailure
from ..integrators.base import Scheme
from .loading import load_of

if TYPE_CHECKING:
    from .stepper import Stepper

__all__ = ["MOVES_FIRST", "SOLVES_FIRST", "phases_of", "solve_and_finish"]


def begin(stepper: Stepper, end: float) -> None:
    """Keep what later phases compare with the start of the part."""
    state = stepper.state
    if stepper.model.bars_vary:
        stepper.model.bars.keep_start()
    stepper.carried.start(state.position, state.time)
    if stepper.treatment is not None:
        stepper.treatment.before()


def move(stepper: Stepper, end: float) -> None:
    """Move to the positions that the last balance was solved for, supports to their exact ones."""
    stepper.before[:] = stepper.state.x
    stepper.scheme.advance(stepper.state, stepper.part)
    stepper.prescribed.place(end)


def evaluate(stepper: Stepper, end: float) -> None:
    """Evaluate forces and energies at the positions reached, and keep the internal variables. Collective."""
    model = stepper.model
    if stepper.scheme.inertial:  # static steps are infinitely long for material laws
        model.bars.step = stepper.part
    stepper.state.time = end
    if model.bars_vary:
        model.change_bars(end)
    stepper.evaluate(commit=True)


def balance(stepper: Stepper, end: float) -> None:
    """Set up the balance of the part, with the loads, supports, dampers and walls of its times. Collective."""
    state, model = stepper.state, stepper.model
    stepper.balance = stepper.scheme.balance(state, stepper.part)
    if stepper.prescribed.moving:
        stepper.prescribed.prescribe(stepper.balance)
    model.inertia.change(sum(weight * time for weight, time in stepper.balance.loads))
    model.contact.motion.begin(state.time, stepper.part)
    state.external = load_of(stepper, stepper.balance)
    if stepper.scheme.inertial:
        model.bars.step = stepper.balance.time - state.time


def solve(stepper: Stepper, end: float) -> None:
    """Solve the balance with contact and supports. Collective if the solve is."""
    stepper.solution = stepper.solve(stepper.balance)


def finish(stepper: Stepper, end: float) -> None:
    """Update velocities, accelerations, walls and the contact log from the solution."""
    state, scheme, contact, found = stepper.state, stepper.scheme, stepper.model.contact, stepper.balance
    fresh = contact.record(stepper.solution.walls, found.time, stepper.part)
    if not scheme.solves_next_position:
        stepper.before[:] = state.x
    scheme.finish(state, found, stepper.solution.u, stepper.part)
    if scheme.solves_next_position and stepper.prescribed.moving:
        stepper.prescribed.take_rates(state.time)
    contact.motion.finish(stepper.part, end)
    if scheme.turns_held and stepper.treatment is None:
        contact.calm(fresh, state.v, found.time, stepper.part)


def place(stepper: Stepper, end: float) -> None:
    """Give supports that move their exact positions and rates."""
    if stepper.prescribed.moving:
        stepper.prescribed.place(end)
        stepper.prescribed.take_rates(end)


def treat(stepper: Stepper, end: float) -> None:
    """Apply the treatment of impact."""
    if stepper.treatment is not None:
        stepper.treatment.after()


def book(stepper: Stepper, end: float) -> None:
    """Update the ledger."""
    stepper.booking()


def check(stepper: Stepper, end: float) -> None:
    """Find nodes that supports have carried through a rectangle."""
    if stepper.carried.of and stepper.fault is None:
        crossing = stepper.carried.crossing(stepper.state.position, end, stepper.at(stepper.state.step + 1, end))
        stepper.fault = SimulationFailure(crossing) if crossing else None


Phase = Callable[["Stepper", float], None]

MOVES_FIRST: tuple[Phase, ...] = begin, move, evaluate, balance, solve, finish, treat, book, check
"""For schemes that solve for the next position, as central differences."""

SOLVES_FIRST: tuple[Phase, ...] = begin, balance, solve, finish, place, evaluate, treat, book, check
"""For all others."""


def phases_of(scheme: Scheme) -> tuple[Phase, ...]:
    """Return the phases of a scheme's steps in their order."""
    return MOVES_FIRST if scheme.solves_next_position else SOLVES_FIRST


def solve_and_finish(stepper: Stepper, end: float) -> None:
    """Make the phases of the balance alone, up to a time [s]: at the start, where the positions stay. Collective if the
    solve is."""
    for phase in (balance, solve, finish):
        phase(stepper, end)

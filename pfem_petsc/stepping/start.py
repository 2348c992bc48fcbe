"""The state of a stepper at the start of a run or of a stage."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from ..contact.initial_equilibrium import start_at_rest
from ..errors import SimulationFailure
from ..mechanics.materials._stiffness_damping import EXTRAPOLATED
from ..tolerances import BEYOND
from .loading import load_now
from .phases import solve_and_finish

if TYPE_CHECKING:
    from .stepper import Stepper

__all__ = ["start_at_zero", "start_in_motion"]


def start_in_motion(stepper: Stepper) -> None:
    """Initialise velocity, internal force and acceleration of the state. Collective."""
    state, model = stepper.state, stepper.model
    velocity = model.initial_velocity()
    state.v = velocity if model.start is None else state.v + velocity
    supports = model.supports
    if supports.any:
        supports.place(state.position, supports.positions(0.0))
        supports.put(state.v, supports.rates(0.0, 0.0)[0])
    if model.external.state_forces:
        model.external.follow(state.position, state.v)
    if stepper.massless is not None and stepper.massless.settle(state.x, 0.0, 0.0) > BEYOND * model.size:
        stepper.fault = SimulationFailure(
            "step 0, t = 0 s: contact nodes without mass found no equilibrium; use another contact.treatment"
        )
    stepper.evaluate(commit=True)
    if model.external.active:
        state.external = load_now(stepper, 0.0)
    load = state.external - state.f[: model.mesh.n_owned]
    if model.inertia.damped:
        load -= model.inertia.damping_times(state.v, np.zeros_like(load))
    state.a = _acceleration(stepper, load)
    if model.can_touch and model.inertia.redistribution is None:
        walls = start_at_rest(model, state, partial(_acceleration, stepper), load)
        if walls is not None:
            held = model.links.count_held(walls.nodes[walls.touching.any(axis=1)], len(state.v))
            stepper.solution.walls, stepper.solution.contacts = walls, held
    if stepper.massless is not None:
        state.contact, stepper.solution.walls = stepper.massless.press(state.position, load, 0.0)
        stepper.solution.contacts = int(stepper.solution.walls.touching.sum())
    if supports.any:
        inertial = model.inertia.mass_times(state.a, np.empty_like(state.a))
        state.support = supports.part(inertial - load - state.contact)
    stepper.totals_at_start = stepper.totals()
    stepper.walls_at_start = stepper.solution.walls.force
    stepper.links_at_start = model.links.totals()
    stepper.scheme.start(state, stepper.h)
    if model.bars.viscous and stepper.scheme.solves_next_position:  # the rate half a step before, to extrapolate from
        half = stepper.on_all(state.memory["half_velocity"])
        model.bars.set_rates(state.x, state.x - (0.5 * stepper.h) * half, (1.0 - EXTRAPOLATED) * half, 0.0)
    motion = model.contact.motion
    motion.start(stepper.h)
    if stepper.scheme.solves_next_position:
        v, speeds = state.v, motion.speeds
        solve_and_finish(stepper, state.time)
        stepper.totals_solved = stepper.totals()
        if model.inertia.damped:
            stepper.velocity_solved = state.v
        # nodes on a wall have not lost their velocity yet; the scheme continues from its own memory
        state.v = v
        motion.set_speeds(speeds)


def start_at_zero(stepper: Stepper) -> None:
    """Initialise positions, internal forces and loads at time zero, where nothing moves. Collective."""
    state, model = stepper.state, stepper.model
    state.v = np.zeros_like(stepper.zero)
    state.a = np.zeros_like(stepper.zero)
    if model.supports.any:
        model.supports.place(state.position, model.supports.positions(0.0))
    stepper.evaluate(commit=True)
    if model.external.active:
        state.external = model.external.at(0.0, np.empty_like(state.v))


def _acceleration(stepper: Stepper, load: np.ndarray) -> np.ndarray:
    """Return the acceleration (owned, 3) with M a = load [N], prescribed values included. Collective."""
    supports = stepper.model.supports
    if not supports.moving:
        return stepper.accelerate(load)
    carried = np.zeros_like(load)
    supports.put(carried, supports.rates(stepper.state.time, 0.0)[1])
    a = stepper.accelerate(load - stepper.model.inertia.mass_times(carried, np.empty_like(load)))
    supports.put(a, supports.get(carried))
    return a

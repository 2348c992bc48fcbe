"""From one stage to the next: what a stage starts from, and the state that is handed over to it.

Within a stage time is counted from its start, for its tables and for its steps; ``StageStart`` says where that lies on
the axis of the results. Positions, velocities, internal variables, temperatures, contact pairs and who touches which
wall go over; the scheme starts again from them, as at the start of a run.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from .model import StageStart

if TYPE_CHECKING:
    from .stepper import Stepper


def end_of_stage(stepper: Stepper) -> StageStart:
    """What the next stage starts from, at the end of a stage."""
    model, state = stepper.model, stepper.state
    external, time = model.external, state.time
    return StageStart(
        step=stepper.number,
        time=stepper.place,
        position=state.position.copy(),
        force=external.loads_at(time),
        gravity=np.array(external.gravity_at(time)),
        wind=np.array(external.wind_at(time)),
        walls=model.contact.motion.displacements(time),
    )


def hand_over(old: Stepper, new: Stepper) -> None:
    """Give the state of a finished stage to the stepper of the next, before its start. Collective."""
    before, state = old.state, new.state
    state.x[:] = before.x
    new.before[:] = before.x
    state.v = before.v.copy()
    if not new.scheme.inertial:  # others find the forces of their start
        state.support, state.contact = old.recorded()[1].copy(), before.contact.copy()
    new.model.bars.put_history(old.model.bars.history())
    new.model.bars.forget_rates()
    new.follow_removals(old.removals)
    new.ruptures.begin()
    new.model.temperatures.hold(old.model.bars.heat)
    new.model.rest_lengths.hold(old.model.bars.rest)
    new.model.links.take_over(old.model.links)
    _hand_over_contact(old, new)


def _hand_over_contact(old: Stepper, new: Stepper) -> None:
    """Who touches walls of the same name, their forces, times and ties; walls with mass that stay in force go on."""
    before, contact = old.model.contact, new.model.contact
    pairs = [(before.names.index(name), k) for k, name in enumerate(contact.names) if name in before.names]
    if pairs:
        from_, to = np.array(pairs, dtype=np.int64).T
        new.touching[:, to] = old.touching[:, from_] & contact.members[:, to]
        new.closed[:, to] = old.closed[:, from_] & contact.members[:, to]
        contact.log.last = np.flatnonzero(new.touching.any(axis=1))
        contact.log.time[to] = before.log.time[from_]
    if pairs and not new.scheme.inertial:
        force = contact.nothing.force.copy()
        force[to] = old.solution.walls.force[from_]
        new.solution.walls = dataclasses.replace(contact.nothing, force=force)
    if new.model.case.holds("wall"):
        bodies, earlier = contact.motion.bodies, before.motion.bodies
        bodies.state.x, bodies.state.v = earlier.state.x.copy(), earlier.state.v.copy()
    _hand_over_ties(old, new, dict(pairs))


def _hand_over_ties(old: Stepper, new: Stepper, walls: dict[int, int]) -> None:
    """Nodes tied to walls that tie still are tied to them, where they are."""
    before, contact = old.model.contact, new.model.contact
    if not (before.ties.any and contact.ties.any):
        return
    nodes, tied = before.ties.nodes()
    owned = len(new.state.v)
    tied_to, tied_at = np.zeros(owned, dtype=np.int64), np.zeros((owned, 3))
    displacements = contact.motion.displacements(0.0)
    for node, wall in zip(nodes, tied, strict=True):
        k = walls.get(int(wall), -1)
        if k >= 0 and contact.ties.tying[k] and contact.members[node, k]:
            tied_to[node], tied_at[node] = k + 1, new.state.x[node] - displacements[k]
    new.state.memory["tied_to"], new.state.memory["tied_at"] = tied_to, tied_at

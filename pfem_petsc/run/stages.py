"""The stages of a case and their steppers: planned before the first step, begun one after the other.

Within a stage time is counted from its start, for its tables and for its steps; ``StageStart`` says where that lies on
the axis of the results. Positions, velocities, internal variables, temperatures, contact pairs and who touches which
wall go over to the next one; the scheme starts again from them, as at the start of a run.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from ..columns import Fields, declared
from ..contact.contact import check_start
from ..errors import InputError, SimulationFailure
from ..preflight import warnings_before
from ..stepping.model import Model, StageStart
from ..stepping.plan import Plan, make_plan
from ..stepping.plan import make_stepper as time_stepper
from .recorder import Handover, Recorder

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..stepping.stepper import Stepper


def _make_stepper(model: Model, recorded: Mapping[str, Any] | None) -> Stepper:
    """Create the stepper of a model's case, with its plan. Collective.

    ``recorded``: record of the plan of the continued run, None for a new run
    """
    if model.case.modes is not None:
        from ..modes.find import describe_modes

        describe_modes(model)  # refuses at the start modes that cannot be computed at the end
    if model.case.static is not None:
        from ..statics.stepper import make_stepper as static_stepper

        return static_stepper(model)
    if model.case.time is None:
        from ..modes.find import InitialState

        return InitialState(model)
    return time_stepper(model, make_plan(model, recorded))


def _join(plans: list[Plan], names: list[str]) -> Plan:
    """Return the plan of all stages: steps, end and axis are those of all together, others those of the first stage.

    A static stage takes as much time [s] of the results as its load factor or points count. The axis is that of the
    last stage, from where it begins in the results.
    """
    lines = ["; ".join(f"{label}: {text}" for label, text in plan.texts.items()) for plan in plans]
    counts, ends = [plan.steps for plan in plans], [plan.end for plan in plans]
    last, before = plans[-1].axis, 0.0 if None in ends else sum(ends[:-1])
    return dataclasses.replace(
        plans[0],
        steps=None if None in counts else sum(counts),
        end=None if None in ends else sum(ends),
        axis=last._replace(key=f"stage[{len(plans) - 1}].{last.key}", start=before),
        stages=tuple(plans),
        texts={f"stage {name}": line for name, line in zip(names, lines, strict=True)},
        record={"stages": [plan.record for plan in plans]},
    )


class Stages:
    """The stages of a case, one of which is being computed. Construction is collective.

    A case without stages is its own only stage, and is built as ever. Otherwise the model of every stage is built once
    before the first step, so that what is wrong with a later one is found then.

    Parameters
    ----------
    case : Case
    comm : MPI.Comm
    recorded : record of the plan of the run that is continued, None for a new run
    number : of the stage to begin with

    Attributes
    ----------
    stepper : of the present stage
    origin : stepper of the stage from whose end load cases start, once it has ended; None before and without
    plan : of the whole run
    functions : that give forces in the present stage and in those after it, see :meth:`call`
    columns : of the history, name to type with the shape of a value, None for a case without stages
    fields : names of the fields to write, None for a case without stages
    wall_positions : of moving walls before the first stage that has them, by their columns of the history; empty for a
        case without stages
    events : columns of events and their types

    Raises
    ------
    InputError
        On all ranks.
    """

    def __init__(self, case: Case, comm: MPI.Comm, recorded: Mapping[str, Any] | None, number: int = 0) -> None:
        self.case, self.comm = case, comm
        self._cases = case.stages
        self.functions: list[Callable[..., Any]] = []
        self.stepper: Stepper
        self.origin: Stepper | None = None
        self.columns: dict[str, np.dtype] | None = None
        self.fields: list[str] | None = None
        self.wall_positions: dict[str, np.ndarray] = {}
        self.events: dict[str, Any] = {}
        first = Model(self._cases[0], comm, later=self._cases[1:])
        if not case.stage:
            self.stepper = _make_stepper(first, recorded)
            self.plan = self.stepper.plan
            self.events |= self.stepper.event_columns
            return
        records = [None] * len(case.stage) if recorded is None else recorded["stages"]
        self.columns = {name: declared(name).dtype for name in ("time", "step", "stage")}
        plans, warnings, told = [], [], []
        points, cells = {}, {}
        for k, (stage, record) in enumerate(zip(self._cases, records, strict=True)):
            model = first if k == 0 else Model(stage, comm, first.mesh)
            stepper = _make_stepper(model, record)
            plans.append(stepper.plan)
            self.columns |= Recorder(stepper).columns
            self.events |= stepper.event_columns
            positions = zip(model.contact.names, model.contact.positions(0.0), strict=True)
            started = {f"wall/{name}/position": position for name, position in positions}
            moving = self.columns.keys() & started.keys()
            self.wall_positions = {name: started[name] for name in moving} | self.wall_positions
            fields = Fields(model)
            points |= dict.fromkeys(fields.points)
            cells |= dict.fromkeys(fields.cells)
            warnings += [f"stage {stage.name!r}: {text}" for text in model.warnings if text not in told]
            told += model.warnings
            if k >= number:
                found = warnings_before(stage, model, stepper.plan, first=False)
                new = [text for text in found if text not in told]
                warnings += [f"stage {stage.name!r}: {text}" for text in new if k > number]
                told += new
            if k == number:
                self.stepper = stepper
            else:
                stepper.destroy()
        self.plan = _join(plans, [stage.name for stage in self._cases])
        self.fields = [*points, *cells]
        self.model.warnings = warnings

    @property
    def model(self) -> Model:
        """Of the present stage."""
        return self.stepper.model

    @property
    def number(self) -> int:
        """Of the present stage, from 0."""
        return self.model.case.number

    @property
    def at_last(self) -> bool:
        """Whether no stage comes after the present one."""
        return self.number == len(self._cases) - 1

    @property
    def next_starts_from(self) -> int | None:
        """Number of the stage from whose end the next one starts, if that is the origin of load cases."""
        return None if self.at_last else self._cases[self.number + 1].starts_from

    def make_origin(self) -> Stepper:
        """Create the stepper of the stage from whose end load cases start, to restore its state. Collective."""
        number = self._cases[self.number].starts_from
        model = Model(self._cases[number], self.comm, self.model.mesh)
        self.origin = _make_stepper(model, self.plan.record["stages"][number])
        return self.origin

    def call(self, function: Callable[..., Any]) -> None:
        """Add the forces that a function returns in stages that compute motion.

        Raises
        ------
        InputError
            If there is no such stage.
        """
        if not any(stage.time is not None for stage in self._cases):
            raise InputError(
                f"{self.case.source}: external_force: a function acts in dynamic analyses only, and this case has "
                "no [time]; use [[load]]"
            )
        if any(stage.contact.treatment == "mass_redistribution" for stage in self._cases if stage.time is not None):
            raise InputError(
                f'{self.case.source}: external_force: contact.treatment = "mass_redistribution" leaves nodes without '
                "mass, which cannot follow forces that depend on their velocity; use another contact.treatment"
            )
        self.functions.append(function)
        if self.model.case.time is not None:
            self.model.external.call(function)

    def advance(self) -> Handover:
        """Begin the next stage where the present one has ended; bars and supports that go at once are still there.
        Collective.

        Raises
        ------
        SimulationFailure
            On all ranks, where the stage cannot begin there.
        """
        ended, number = self.stepper, self.number + 1
        stage = self._cases[number]
        where = f"stage {stage.name!r}, begun after step {ended.number}, {ended.axis.exact(ended.place)}"
        if self.origin is None:
            ended.settle()
            self.origin = ended if stage.starts_from is not None else None
        old = self.origin or ended
        try:
            model = Model(stage, self.comm, old.model.mesh)
            model.begin_stage(_end_of_stage(old, ended))
            for function in self.functions if stage.time is not None else ():
                model.external.call(function)
            check_start(model.contact, old.state.position, model.size, adjusts=False)
            if model.self_contact is not None:
                model.self_contact.check_start(old.state.x, old.model.self_contact)
            stepper = _make_stepper(model, self.plan.record["stages"][number])
        except InputError as error:
            raise SimulationFailure(f"{where}: {error}") from error
        _hand_over(old, stepper)
        handed = _changes(old, stepper)
        if ended is not self.origin:
            ended.destroy()
        self.stepper = stepper
        stepper.start()
        if model.self_contact is not None:
            overlap = model.self_contact.overlap_at_start(old.model.self_contact)
            if overlap > 0.0:
                raise SimulationFailure(
                    f"{where}: [self_contact]: bars that may touch now overlap by up to {overlap:.3g} m, which would "
                    "add energy: give the table with the same bars and radius to the stages before, or reduce "
                    "self_contact.radius"
                )
        return handed

    def destroy(self) -> None:
        """Free PETSc objects of the steppers. Collective; may be called again."""
        for stepper in (self.stepper, *([self.origin] if self.origin is not None else [])):
            stepper.destroy()


def _changes(old: Stepper, new: Stepper) -> Handover:
    """What a stage changes in the state that it is handed, before its start. Collective."""
    model, before = new.model, old.model.bars
    added = model.initial_velocity()
    momentum = model.inertia.mass_times(added, np.empty_like(added))
    work = (momentum * (new.state.v + 0.5 * added)).sum()
    change = model.bars.rest - before.rest
    scaled = before.scaled_dissipation(before.densities(old.state.x), change) if change.any() else 0.0
    sums = np.concatenate([[work], momentum.sum(axis=0), old.ledger.bar_energies - scaled])
    sums = model.comm.allreduce(sums)
    return Handover(float(sums[0]), sums[1:4], sums[4:])


def _end_of_stage(old: Stepper, ended: Stepper) -> StageStart:
    """What the next stage starts from, at the end of a stage, and where: after the stage that has ended."""
    model, state = old.model, old.state
    external, time = model.external, state.time
    return StageStart(
        step=ended.number,
        time=ended.place,
        position=state.position.copy(),
        force=external.loads_at(time),
        gravity=np.array(external.gravity_at(time)),
        wind=np.array(external.wind_at(time)),
        walls=model.contact.motion.poses(time),
    )


def _hand_over(old: Stepper, new: Stepper) -> None:
    """Give the state of a finished stage to the stepper of the next, before its start. Collective."""
    before, state = old.state, new.state
    state.x[:] = before.x
    new.before[:] = before.x
    state.v = before.v.copy()
    if not new.scheme.inertial:  # others find the forces of their start
        state.support, state.contact = old.recorded()[1].copy(), before.contact.copy()
    new.model.bars.put_history(old.model.bars.history(), old.model.bars.kept_names)
    new.model.bars.forget_rates()
    new.follow_removals(old.removals)
    new.ruptures.begin()
    new.model.temperatures.hold(old.model.bars.heat)
    new.model.rest_lengths.hold(old.model.bars.rest)
    new.model.links.take_over(old.model.links)
    if new.model.self_contact is not None:
        new.model.self_contact.take_over(old.model.self_contact, state.position)
    _hand_over_contact(old, new)


def _hand_over_contact(old: Stepper, new: Stepper) -> None:
    """Who touches walls of the same name, their forces, times and ties; walls with mass that stay in force go on."""
    before, contact = old.model.contact, new.model.contact
    pairs = [(before.names.index(name), k) for k, name in enumerate(contact.names) if name in before.names]
    if pairs:
        walls_from, walls_to = np.array(pairs, dtype=np.int64).T
        slots = [
            (before.first[one] + s, contact.first[other] + s)
            for one, other in pairs
            for s in range(min(before.walls[one].faces, contact.walls[other].faces))
        ]
        from_, to = np.array(slots, dtype=np.int64).T
        new.touching[:, to] = old.touching[:, from_] & contact.members[:, to]
        new.closed[:, to] = old.closed[:, from_] & contact.members[:, to]
        contact.log.last = np.flatnonzero(new.touching.any(axis=1))
        contact.log.time[walls_to] = before.log.time[walls_from]
    if pairs and not new.scheme.inertial:
        force = contact.nothing.force.copy()
        force[walls_to] = old.solution.walls.force[walls_from]
        new.solution.walls = dataclasses.replace(contact.nothing, force=force)
    if new.model.case.holds("wall"):
        contact.motion.bodies.follow(before.motion.bodies)
    _hand_over_ties(old, new, dict(pairs))


def _hand_over_ties(old: Stepper, new: Stepper, walls: dict[int, int]) -> None:
    """Nodes tied to walls that tie still are tied to them, where they are."""
    before, contact = old.model.contact, new.model.contact
    if not (before.ties.any and contact.ties.any):
        return
    nodes, tied = before.ties.nodes()
    owned = len(new.state.v)
    tied_to, tied_at = np.zeros(owned, dtype=np.int64), np.zeros((owned, 3))
    poses = contact.motion.poses(0.0)
    for node, wall in zip(nodes, tied, strict=True):
        k = walls.get(int(wall), -1)
        slot = contact.first[k]
        if k >= 0 and contact.ties.tying[slot] and contact.members[node, slot]:
            tied_to[node], tied_at[node] = k + 1, poses.rest(k, new.state.x[node])
    new.state.memory["tied_to"], new.state.memory["tied_at"] = tied_to, tied_at

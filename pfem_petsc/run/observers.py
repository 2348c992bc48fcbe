"""Observers act after steps: history, snapshots, checkpoints, events, ruptures and progress of a run; and when the
ranks agree on faults, requests to stop, and checkpoints that are due."""

from __future__ import annotations

import signal
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from ..columns import Fields, Row, Snapshot
from ..contact.bars_at_walls import Piercing
from ..contact.contact import check_positions
from ..errors import SimulationFailure
from ..files import FolderLock
from ..output.checkpoint import write_checkpoint
from ..output.units import duration
from ..output.vtkhdf import ResultWriter
from ..restart import STATE_VERSION, RunState
from ..signals import SignalNotes, early
from ..stepping.bar_events import MOST_TOLD
from ..stepping.ledger import Ledger
from ..stepping.stepper import Stepper
from ..version import __version__
from .monitors import WATCHED, BlowUp, ContactWatch, Doubts
from .recorder import Handover, Recorder
from .stages import Stages

if TYPE_CHECKING:
    from ..stepping.stepper import Stepper

_WALL_TIME = 1000  # code of the wall time, larger than all signal numbers


class StopRequest(SignalNotes):
    """Requests that a run stops at the end of a step, after a signal or the wall time, but not before its first step.

    Parameters
    ----------
    wall_time : limit from now on [s]; None for no limit

    Attributes
    ----------
    stepped : whether the run has made a step
    """

    def __init__(self, wall_time: float | None = None) -> None:
        super().__init__()
        self.wall_time = wall_time
        self.stepped = False
        self._begin = time.monotonic()

    def watch(self) -> None:
        """Install the signal handlers; signals received since the start of the program count."""
        super().watch()
        self.adopt(early())

    @property
    def code(self) -> int:
        """Code of the request, zero if there is none."""
        if self._signal:
            return self._signal
        if self.wall_time is not None and self.stepped and time.monotonic() - self._begin >= self.wall_time:
            return _WALL_TIME
        return 0

    def reason(self, code: int) -> str:
        """Describe a code."""
        if code == _WALL_TIME:
            return f"the wall time of {duration(self.wall_time or 0.0)} has elapsed"
        return f"{signal.Signals(code).name} received"


_INTERVAL = 0.2  # seconds between synchronisations
_NONE = -(2**62)  # for ranks without a fault
_MOST = 1000  # maximum number of steps between them, so that all ranks know of a fault within a bounded number of steps


class Synchroniser:
    """Infrequent agreement of all ranks on faults, requests to stop, and checkpoints that are due.

    About every 0.2 s, and at least every thousand steps, the ranks make one reduction of four numbers, in which they
    also agree on the step of the next one.

    Parameters
    ----------
    stages : Stages
    stop : StopRequest
    lock : FolderLock, renewed at each synchronisation
    interval : wall-clock time between checkpoints [s], None for none

    Attributes
    ----------
    request : code of a request to stop that all ranks know, zero for none
    checkpoint_due : whether the time between checkpoints has elapsed
    """

    def __init__(self, stages: Stages, stop: StopRequest, lock: FolderLock, interval: float | None = None) -> None:
        self.comm, self.stop, self.interval = stages.comm, stop, interval
        self._stages, self.lock = stages, lock
        self.request = 0
        self.checkpoint_due = False
        self._last_checkpoint = time.monotonic()
        self._last = (0, time.monotonic())
        self._next = 0

    @property
    def alarm(self) -> bool:
        """Whether this rank has a fault."""
        return self._stages.stepper.fault is not None or self.stop.code != 0

    def due(self, step: int) -> bool:
        """Return whether all ranks synchronise after this step; equal on all ranks."""
        return step >= self._next or (self.comm.size == 1 and self.alarm)

    def steps_left(self, step: int) -> int:
        """Return the number of steps to the next synchronisation."""
        return self._next - step

    def synchronise(self) -> int:
        """Synchronise; return the code of a request to stop, or zero. Collective.

        Raises
        ------
        PfemError
            On all ranks: the earliest fault, of the lowest rank that has one; later ones may be its consequences.
        """
        stepper = self._stages.stepper
        fault, step = stepper.fault, stepper.number
        since = stepper.fault_step if fault is not None else step
        try:
            self.lock.renew()
        except SimulationFailure as lost:
            fault = fault or lost
        now = time.monotonic()
        steps, seconds = step - self._last[0], now - self._last[1]
        ahead = int(np.clip(steps * _INTERVAL / seconds, 1, _MOST)) if steps > 0 and seconds > 0.0 else 1
        late = self.interval is not None and now - self._last_checkpoint >= self.interval
        order = -(since * self.comm.size + self.comm.rank) if fault is not None else _NONE
        mine = np.array([order, self.stop.code, late, -ahead])
        self.comm.Allreduce(MPI.IN_PLACE, mine, op=MPI.MAX)
        first, code, late, ahead = (int(number) for number in mine)
        if first != _NONE:
            raise self.comm.bcast(fault, root=-first % self.comm.size)
        self.checkpoint_due = bool(late)
        self._last = (step, now)
        self._next = step - ahead
        self.request = code
        return code

    def checkpoint_written(self) -> None:
        """Restart the interval between checkpoints."""
        self.checkpoint_due = False
        self._last_checkpoint = time.monotonic()


NEVER = sys.maxsize
"""Number of steps before an event that never occurs."""


class Observer(ABC):
    """Acts after some steps. All methods are collective, and their results are the same on all ranks.

    Attributes
    ----------
    every : due after steps whose number is a multiple of it; 0: never
    needs_agreement : whether the ranks must agree first that none of them has a fault
    """

    every: int = 0
    needs_agreement: bool = False

    def due(self, step: int) -> bool:
        """Return whether the observer acts after this step."""
        return bool(self.every) and step % self.every == 0

    def steps_left(self, step: int) -> int:
        """Return the number of steps until it must act again, which may be made in a call."""
        return self.every - step % self.every if self.every else NEVER

    @abstractmethod
    def observe(self) -> None:
        """Act in the present state of the stepper, after a step."""

    def complete(self) -> None:
        """Act after the last step of the run, unless this has been done."""

    def remarks(self) -> list[str]:
        """Return remarks for the user at the end of the run."""
        return []


class History(Observer):
    """Records and checks rows. Construction is collective, after the start of the stepper.

    The reduction that computes a row also communicates a fault on any rank.

    Parameters
    ----------
    stages : Stages
    synchroniser : Synchroniser
    warn : receives a warning
    stepper : of the stage; None: of the present one

    Attributes
    ----------
    row : the last row
    writer : of the result file
    """

    def __init__(
        self,
        stages: Stages,
        synchroniser: Synchroniser,
        warn: Callable[[str], None],
        stepper: Stepper | None = None,
    ) -> None:
        stepper = stages.stepper if stepper is None else stepper
        model = stepper.model
        self.every, self._staged = model.case.output.history_every, bool(stages.case.stage)
        self._stepper, self._synchroniser, self._model = stepper, synchroniser, model
        self.ledger = stepper.ledger = Ledger(stepper)
        self.recorder = Recorder(stepper, stages.columns)
        for name, value in stages.wall_positions.items():  # which this stage may not have
            self.recorder.rest[self.recorder.layout[name]] = value
        stepper.row_every, stepper.probed = self.every, self.recorder.probed
        inertial = stepper.scheme.inertial
        self.blow_up = BlowUp(model, inertial)
        # works over the increments of equilibria are quadratures, whose error is no energy that something has made
        self._contact_watch = ContactWatch(model, warn, stepper.plan) if inertial else None
        self._watched = self.recorder.layout.indices(WATCHED)
        self.row: Mapping[str, Any] | None = None
        self.writer: ResultWriter | None = None

    def begin_stage(self, earlier: History, source: History, last: Row, handed: Handover) -> None:
        """Go on with the rows of the stage that has ended, in the state at the end of the stage of ``source``, which
        is the same unless a load case begins, with ``last``, the row of that end. Collective."""
        self.row, self.writer = last, earlier.writer
        first = self.recorder.begin_stage(source.recorder, last, handed)
        self._check(first)

    def kept(self) -> dict[str, Any]:
        """Return what a restart goes on with, besides the ledger."""
        recorder, watch = self.recorder, self._contact_watch
        return {
            "iterations": list(self._stepper.iterations),
            "start_energy": recorder.start_energy,
            "energy_scale": recorder.energy_scale,
            "carried": None if recorder.carried is None else recorder.carried.tolist(),
            "rest": None if recorder.rest is None else recorder.rest.tolist(),
            "watch": None if watch is None else watch.start,
            "blow_up": self.blow_up.kept,
            "row": {name: float(self.row[name]) for name in ("energy_imbalance", "active_contacts", "step")},
        }

    def load_state(self, kept: Mapping[str, Any]) -> None:
        """Take what :meth:`kept` gave."""
        recorder = self.recorder
        self._stepper.iterations = [int(n) for n in kept["iterations"]]
        recorder.start_energy, recorder.energy_scale = kept["start_energy"], kept["energy_scale"]
        self.blow_up.kept = kept["blow_up"]
        self.row = dict(kept["row"])
        if kept["carried"] is not None:
            recorder.carried = np.array(kept["carried"])
        if recorder.rest is not None:
            recorder.rest[:] = kept["rest"]
        if self._contact_watch is not None:
            self._contact_watch.start = kept["watch"]

    def due(self, step: int) -> bool:
        """Return whether there is a row to record: of this step or, in a call, of one before."""
        return super().due(step) or self._stepper.instants is not None

    def steps_left(self, step: int) -> int:
        """Never: compiled steps collect what rows need."""
        return NEVER

    def observe(self) -> None:
        """Record rows: of compiled steps, and of the present state if it is due and not among them."""
        self.record()
        if super().due(self._stepper.number):
            self.complete()

    def record(self) -> None:
        """Record the rows of the last step or call, unless a rank has a fault, which is raised on all ranks."""
        rows, alarms = self.recorder.rows(alarm=self._synchroniser.alarm)
        begun = 0
        for alarm in np.flatnonzero(alarms).tolist():
            self._take(rows[begun:alarm])
            self._synchroniser.synchronise()
            begun = alarm
        self._take(rows[begun:])

    def _take(self, rows: np.ndarray) -> None:
        """Check rows (m, width), store the last one and add them to the history."""
        for vector in rows:
            row = Row(self.recorder.layout, vector)
            self._check(row)
            self.row = row
            self.writer.append_history(row if self._model.comm.rank == 0 else None)

    def _check(self, row: Row) -> None:
        values = dict(zip(WATCHED, row.vector[self._watched].tolist(), strict=True))
        self.blow_up.check(row, values, self._stepper.state)
        if self._contact_watch is not None:
            self._contact_watch.check(row, values)

    def complete(self) -> None:
        """Record the row of the last step."""
        if self.row["step"] != self._stepper.number:
            self.record()

    @property
    def drift(self) -> float | None:
        """Energy imbalance of the last row relative to the largest energy so far; None without energy."""
        scale = self.recorder.energy_scale
        return self.row["energy_imbalance"] / scale if scale > 0.0 else None

    def remarks(self) -> list[str]:
        """Return remarks about walls and pairs without contact, which may be unintended."""
        contact = self._model.contact
        times = contact.log.times(self._model.comm)
        touched = np.array(times["sum"]) > 0.0
        for flags in times["flags"]:
            touched |= np.array(flags, dtype=bool)
        touch = self._model.self_contact
        if touch is not None and touch.at_walls is not None:
            met = touch.at_walls.met.copy()
            self._model.comm.Allreduce(MPI.IN_PLACE, met, op=MPI.LOR)
            touched |= met
        names = np.array(contact.names, dtype=object)[~touched]
        during = f" in stage {self._model.case.name!r}" if self._staged else ""
        # impulses are those of inertial schemes, and of several stages together
        known = self._stepper.scheme.inertial and self.recorder.rest is None
        pairs = [pair.name for pair in self._model.case.contact_pair if known and not self._pressed(pair.name)]
        return [
            *(f"wall {name!r} was never touched by a node{during}" for name in names),
            *(f"contact pair {name!r} never carried a force" for name in pairs),
        ]

    def _pressed(self, name: str) -> bool:
        """Return whether a pair has had a force: its forces have one direction, so that their impulses add up."""
        return any(bool(np.any(self.row[f"pair/{name}/{kind}"])) for kind in ("impulse", "jump_impulse"))


class Snapshots(Observer):
    """Writes snapshots, including the start and the end of a run. Construction is collective.

    Parameters
    ----------
    stepper : Stepper
    fields : Fields
    warn : receives a warning

    Attributes
    ----------
    last : step of the last snapshot, -1 before the first
    writer : of the result file
    """

    needs_agreement = True

    def __init__(self, stepper: Stepper, fields: Fields, warn: Callable[[str], None]) -> None:
        self.every = stepper.model.case.output.fields_every
        self._stepper, self._fields, self._warn = stepper, fields, warn
        self._piercing = Piercing(stepper.model)
        self._doubts = Doubts(stepper.model, warn)
        self.last = -1
        self.writer: ResultWriter | None = None

    def observe(self) -> None:
        """Check the nodes against the walls, then write a snapshot of the present state."""
        state, fields = self._stepper.state, self._fields
        if not self.every and 0 < state.step < self._stepper.last_step:
            return
        number, place = self._stepper.number, self._stepper.place
        at = f"step {number}, {self._stepper.axis.exact(place)}"
        held = self._stepper.held_by_contact()
        if held is not None:
            check_positions(self._stepper.model, *held, at)
        self._stepper.model.links.check_carried(state.position, at)
        now = Snapshot(self._stepper.model, state, self._stepper.acceleration)
        points = state.position.copy()  # as all values that are written while the next steps change the state
        self.writer.begin_snapshot(place, number, points, fields.at("nodes", now), fields.at("bars", now))
        self.last = number
        for text in self._piercing.look(state.x, state.time, at):
            self._warn(text)
        self._doubts.look(state.x, at, last=state.step >= self._stepper.last_step)

    def kept(self) -> dict[str, Any]:
        """Return what a restart and the next stage go on with: the step of the last snapshot, and counts."""
        return {"snapshot": self.last, "doubts": self._doubts.kept}

    def load_state(self, kept: Mapping[str, Any]) -> None:
        """Go on with what :meth:`kept` returned."""
        self.last = int(kept["snapshot"])
        self._doubts.kept = kept.get("doubts", {})

    def complete(self) -> None:
        """Write the snapshot of the last step."""
        if self.last != self._stepper.number:
            self.observe()

    def doubts(self) -> list[str]:
        """Return what the model could not represent, for the end of the run."""
        return self._doubts.summary()

    def remarks(self) -> list[str]:
        """Return remarks about bars across walls."""
        return self._piercing.summary()


class Checkpointing(Observer):
    """Writes checkpoints at intervals of steps, and when the ranks agree that one is due by wall-clock time.

    Parameters
    ----------
    stages : Stages
    path : the file
    state : RunState, of the present stage
    history, snapshots : from which a restart continues
    synchroniser : Synchroniser

    Attributes
    ----------
    last_step : step of the last one, -1 before the first
    at_end : whether :meth:`complete` writes one: the case requests checkpoints
    """

    needs_agreement = True

    def __init__(
        self,
        stages: Stages,
        path: Path,
        state: RunState,
        history: History,
        snapshots: Snapshots,
        synchroniser: Synchroniser,
    ) -> None:
        output = stages.case.output
        self.every = output.checkpoint_every
        self.at_end = bool(output.checkpoint_every or output.checkpoint_minutes)
        self.last_step = -1
        self._stages, self._path, self._state = stages, path, state
        self._history, self._snapshots, self._synchroniser = history, snapshots, synchroniser

    def due(self, step: int) -> bool:
        """Return whether a checkpoint is due by the number of the step or by wall-clock time."""
        return super().due(step) or self._synchroniser.checkpoint_due

    def observe(self) -> None:
        """Flush the results, from which a restart continues, then write a checkpoint, unless the step has one.

        Raises
        ------
        SimulationFailure
            On all ranks; earlier checkpoints are kept.
        """
        if self._state.stepper.number != self.last_step:
            self.write_state(self._path)
            self.last_step = self._state.stepper.number
        self._synchroniser.checkpoint_written()

    def write_state(self, path: Path) -> None:
        """Write the state into a file: of load cases the one that they start from, which a restart in one needs for
        those after it. Collective."""
        history, state, case = self._history, self._state, self._stages.case
        history.writer.flush_history()
        scalars = state.scalars(history.ledger.kept(), history.kept(), self._snapshots.kept())
        if case.stage:
            # the arrays of what the stage starts from are among those of nodes
            start = self._stages.model.start
            numbers = None if start is None else start.scalars()
            scalars["stage"] = {"number": self._stages.number, "start": numbers}
        attributes = {
            "state_version": STATE_VERSION,
            "pfem_petsc": __version__,
            "name": case.name,
            "overrides": list(case.overrides),
            "plugins": list(case.added),
            "case": case.to_dict(),
            "plan": self._stages.plan.record,
            "mesh_mark": state.mesh_mark,
            "external_functions": self._stages.model.external.functions,
        }
        write_checkpoint(path, self._stages.comm, state.arrays(), scalars, attributes)

    def complete(self) -> None:
        """Write the checkpoint of the last step, if the case requests checkpoints."""
        if self.at_end:
            self.observe()


class Events(Observer):
    """Records the ``events`` that a stepper found before its last state, the same on all ranks.

    Parameters
    ----------
    stepper : Stepper
    tell : receives a message

    Attributes
    ----------
    writer : of the result file
    """

    def __init__(self, stepper: Stepper, tell: Callable[[str], None]) -> None:
        self._stepper, self._tell = stepper, tell
        self._root = stepper.model.comm.rank == 0
        self.writer: ResultWriter | None = None

    def due(self, step: int) -> bool:
        """Return whether the step has events."""
        return bool(self._stepper.events)

    def observe(self) -> None:
        """Record and report the events."""
        events, self._stepper.events = self._stepper.events, []
        for event in events:
            self.writer.append_event(event.row() if self._root else None)
            self._tell(str(event))

    def remarks(self) -> list[str]:
        """Return a remark about the end of the analysis, if it is not known in advance."""
        return self._stepper.remarks()


class RuptureReport(Observer):
    """Gathers what the ranks know about broken bars when a row of the history shows that there are more of them.

    Parameters
    ----------
    stepper : Stepper
    history : History, whose rows count the broken bars of all ranks
    tell : receives a message
    """

    def __init__(self, stepper: Stepper, history: History, tell: Callable[[str], None]) -> None:
        self._stepper, self._history, self._tell = stepper, history, tell
        self._comm = stepper.model.comm
        self._reported = 0  # texts of this stage
        self._start = self._told = self._comm.allreduce(stepper.ruptures.told) if stepper.model.bars.can_break else 0

    @property
    def _broken(self) -> int:
        row = self._history.row
        return int(row["broken_bars"]) if row is not None and "broken_bars" in row else self._told

    def due(self, step: int) -> bool:
        """Return whether more bars are broken in the last row than have been reported; the same on all ranks."""
        return self._broken > self._told

    def complete(self) -> None:
        """Report the bars of the last row."""
        if self.due(0):
            self.observe()

    def observe(self) -> None:
        """Report the bars that broke."""
        self._told = self._broken
        parts = self._comm.allgather(self._stepper.ruptures.take())
        breaks = sorted(part for share in parts for part in share)
        for each in breaks[: max(MOST_TOLD - self._reported, 0)]:
            self._reported += 1
            self._tell(each.text)

    def remarks(self) -> list[str]:
        """Return how many bars have broken in the stage."""
        count = self._told - self._start
        if not count:
            return []
        listed = f"; the first {self._reported} are listed above" if count > self._reported else ""
        total = self._stepper.model.mesh.n_bars
        return [f"{count:,} of {total:,} bars broke{listed}"]

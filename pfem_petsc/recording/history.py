"""The history: accumulates energies step by step, writes rows, and checks them for divergence."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from ..analysis import Step
from ..output.row import Row
from ..output.sums import HEAD
from ..output.vtkhdf import ResultWriter
from ..stepping.leapfrog_ledger import make_ledger
from .blowup import BlowUp
from .contact_watch import ContactWatch, NoContactWatch
from .observer import NEVER, Observer
from .recorder import Recorder
from .stages import StageColumns, StageRows, carried_sums

if TYPE_CHECKING:
    from ..run.synchroniser import Synchroniser
    from ..stepping.plan import Plan
    from ..stepping.stepper import Stepper

__all__ = ["History"]


class History(Observer):
    """Records and checks rows. Construction is collective, after the start of the stepper.

    The reduction that computes a row also communicates a fault on any rank.

    Parameters
    ----------
    stepper : Stepper
    plan : Plan
    synchroniser : Synchroniser
    warn : receives a warning
    columns : of all stages of the case, None for a case without stages

    Attributes
    ----------
    columns, types : of the rows
    row : the last row
    writer : of the result file
    """

    def __init__(
        self,
        stepper: Stepper,
        plan: Plan,
        synchroniser: Synchroniser,
        warn: Callable[[str], None],
        columns: StageColumns | None = None,
    ) -> None:
        model = stepper.model
        self.every = model.case.output.history_every
        self._stepper, self._synchroniser, self._model = stepper, synchroniser, model
        self.ledger = make_ledger(stepper)
        self.recorder = Recorder(stepper, self.ledger)
        inertial = stepper.scheme.inertial
        self.blow_up = BlowUp(model, inertial)
        self.contact_watch = ContactWatch(model, warn, plan) if inertial else NoContactWatch()
        self.row: dict[str, Any] | None = None
        self.writer: ResultWriter | None = None
        stepper.booking, stepper.bars_removed = self._book, self.ledger.follow_removal
        self.rows = None if columns is None else StageRows(columns, model.case.number, self.recorder.layout)
        self.columns, self.types = (columns or self.recorder).columns, (columns or self.recorder).types

    def end_of_stage(self) -> Row:
        """Return the row of the present state, not recorded, in the columns of all stages. Collective."""
        return self.rows.fill(self.recorder.row())

    def go_on(self, earlier: History, last: Row, kick: tuple[float, np.ndarray]) -> None:
        """Begin a stage after the one that has ended, whose rows these continue. Collective.

        ``last``: row of its end; ``kick``: work [J] and momentum (3,) [N s] of the velocities that the stage adds.
        """
        recorder, before = self.recorder, earlier.recorder
        recorder.carried = carried_sums(recorder, last, kick)
        recorder.start_energy, recorder.energy_scale = before.start_energy, before.energy_scale
        self.rows.begin(last)
        self.row, self.writer = last, earlier.writer
        first = self.rows.fill(recorder.row())
        self.blow_up.check(first, self._stepper.state)
        self.contact_watch.check(first)

    def stage(self) -> dict[str, Any] | None:
        """What a checkpoint must hold of the stages before; None for a case without stages."""
        if self.rows is None:
            return None
        carried = self.recorder.carried
        return {
            "carried": None if carried is None else carried.tolist(),
            "rest": self.rows.rest.tolist(),
            "watch": self.contact_watch.start,
        }

    def load_stage(self, kept: dict[str, Any]) -> None:
        """Take what :meth:`stage` gave."""
        self.recorder.carried = None if kept["carried"] is None else np.array(kept["carried"])
        self.rows.rest[:] = kept["rest"]
        self.contact_watch.start = kept["watch"]

    def _book(self) -> None:
        """Add energies and iterations of a step, or of each part of a bisected step."""
        self.ledger.update()
        self.recorder.count(self._stepper.solution.newton, self._stepper.solution.linear)

    def steps_left(self, step: int) -> int:
        """Return no limit: rows of fused steps are passed to :meth:`take`."""
        return NEVER

    def observe(self, made: Step) -> None:
        """Record a row."""
        self.record()

    def record(self) -> None:
        """Record a row, unless a rank has a fault, which is raised on all ranks."""
        row = self.recorder.row(alarm=self._synchroniser.alarm)
        if self.recorder.alarmed:
            self._synchroniser.synchronise()
        self.take(row)

    def take_sums(self, sums: np.ndarray) -> bool:
        """Take the row of this rank's sums (width,) at the state's step and time, unless a rank has a fault; return
        whether none has. Collective."""
        total = self.recorder.total(sums)
        if self._model.comm.size > 1 and total[HEAD.first("alarm")] > 0.0:
            return False
        self.take(self.recorder.row_of(total))
        return True

    def take(self, row: Row) -> None:
        """Check a row, store it and add it to the history."""
        if self.rows is not None:
            row = self.rows.fill(row)
        self.blow_up.check(row, self._stepper.state)
        self.contact_watch.check(row)
        self.row = row
        self.writer.append_history(row if self._model.comm.rank == 0 else None)

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
        names = np.array(contact.names, dtype=object)[~touched]
        # impulses are those of inertial schemes, and of several stages together
        known = self._stepper.scheme.inertial and self.rows is None
        pairs = [pair.name for pair in self._model.case.contact_pair if known and not self._pressed(pair.name)]
        return [
            *(f"wall {name!r} was never touched by a node" for name in names),
            *(f"contact pair {name!r} never carried a force" for name in pairs),
        ]

    def _pressed(self, name: str) -> bool:
        """Return whether a pair has had a force: its forces have one direction, so that their impulses add up."""
        return any(bool(np.any(self.row[f"pair/{name}/{kind}"])) for kind in ("impulse", "jump_impulse"))

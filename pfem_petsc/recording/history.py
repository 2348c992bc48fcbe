"""The history: accumulates energies step by step, writes rows, and checks them for divergence."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from ..analysis import Step
from ..output.row import Row
from ..output.vtkhdf import ResultWriter
from ..stepping.ledger import Ledger
from .blowup import BlowUp
from .contact_watch import ContactWatch, NoContactWatch
from .observer import NEVER, Observer
from .recorder import Recorder

if TYPE_CHECKING:
    from ..run.synchroniser import Synchroniser
    from ..stepping.prepare import Plan
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

    Attributes
    ----------
    row : the last row
    writer : of the result file
    """

    def __init__(self, stepper: Stepper, plan: Plan, synchroniser: Synchroniser, warn: Callable[[str], None]) -> None:
        model = stepper.model
        self.every = model.case.output.history_every
        self._stepper, self._synchroniser, self._model = stepper, synchroniser, model
        self.ledger = Ledger(stepper)
        self.recorder = Recorder(stepper, self.ledger)
        self.blow_up = BlowUp(model)
        inertial = stepper.scheme.inertial
        self.contact_watch = ContactWatch(model, warn, plan) if inertial else NoContactWatch()
        self.row: dict[str, Any] | None = None
        self.writer: ResultWriter | None = None
        stepper.booking = self._book

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

    def take(self, row: Row) -> None:
        """Check a row, store it and add it to the history."""
        self.blow_up.check(row, self._stepper.state)
        self.contact_watch.check(row)
        self.row = row
        self.writer.append_history(row if self._model.comm.rank == 0 else None)

    def complete(self) -> None:
        """Record the row of the last step."""
        if self.row["step"] != self._stepper.state.step:
            self.record()

    @property
    def drift(self) -> float | None:
        """Energy imbalance of the last row relative to the largest energy so far; None without energy."""
        scale = self.recorder.energy_scale
        return self.row["energy_imbalance"] / scale if scale > 0.0 else None

    def remarks(self) -> list[str]:
        """Return remarks about walls without contact, which may be unintended."""
        contact = self._model.contact
        times = contact.log.times(self._model.comm)
        touched = np.array(times["sum"]) > 0.0
        for flags in times["flags"]:
            touched |= np.array(flags, dtype=bool)
        names = np.array(contact.names, dtype=object)[~touched]
        return [f"wall {name!r} was never touched by a node" for name in names]

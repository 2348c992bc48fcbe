"""Snapshots of the fields; before each, positions are checked against the walls."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from ..analysis import Analysis, Step
from ..contact.alarm import check_positions
from ..contact.piercing import Piercing
from ..output.vtkhdf import ResultWriter
from .doubts import Doubts
from .fields import Fields
from .observer import Observer

__all__ = ["Snapshots"]


class Snapshots(Observer):
    """Writes snapshots, including the start and the end of a run. Construction is collective.

    Parameters
    ----------
    analysis : Analysis
    fields : Fields
    warn : receives a warning

    Attributes
    ----------
    last : step of the last snapshot, -1 before the first
    writer : of the result file
    """

    needs_agreement = True

    def __init__(self, analysis: Analysis, fields: Fields, warn: Callable[[str], None]) -> None:
        stepper = analysis.stepper
        self.every = stepper.model.case.output.fields_every
        self._analysis, self._stepper, self._fields, self._warn = analysis, stepper, fields, warn
        self._piercing = Piercing(stepper.model)
        self._doubts = Doubts(stepper.model, warn)
        self.last = -1
        self.writer: ResultWriter | None = None

    def observe(self, made: Step) -> None:
        """Write a snapshot."""
        self.write()

    def write(self) -> None:
        """Check the nodes against the walls, then write a snapshot of the present state."""
        state, fields = self._stepper.state, self._fields
        if not self.every and 0 < state.step < self._analysis.last_step:
            return
        check_positions(self._stepper)
        at_nodes = fields.at_nodes(state, self._stepper.acceleration)
        number, place = self._stepper.number, self._stepper.place
        self.writer.write_snapshot(place, number, state.position, at_nodes, fields.at_bars(state))
        self.last = number
        for text in self._piercing.look(state.x, state.time):
            self._warn(text)
        self._doubts.look(state.x, f"step {number}, {self._analysis.plan.axis.exact(place)}")

    def kept(self) -> dict[str, Any]:
        """Return what a restart and the next stage go on with: the step of the last snapshot, and counts."""
        return {"snapshot": self.last, "doubts": self._doubts.kept()}

    def load_state(self, kept: Mapping[str, Any]) -> None:
        """Go on with what :meth:`kept` returned."""
        self.last = int(kept["snapshot"])
        self._doubts.load_state(kept.get("doubts", {}))

    def complete(self) -> None:
        """Write the snapshot of the last step."""
        if self.last != self._stepper.number:
            self.write()

    def doubts(self) -> list[str]:
        """Return what the model could not represent, for the end of the run."""
        return self._doubts.summary()

    def remarks(self) -> list[str]:
        """Return remarks about bars across walls."""
        return self._piercing.summary()

"""Checkpoints in the course of a run."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..analysis import Step
from ..restart.checkpoints import Checkpoints
from .history import History
from .observer import Observer
from .snapshots import Snapshots

if TYPE_CHECKING:
    from ..run.synchroniser import Synchroniser

__all__ = ["Checkpointing"]


class Checkpointing(Observer):
    """Writes checkpoints after so many steps, and when the ranks agree that one is due by the clock.

    Parameters
    ----------
    checkpoints : Checkpoints
    history, snapshots : what a checkpoint goes on from
    synchroniser : Synchroniser
    """

    needs_agreement = True

    def __init__(
        self, checkpoints: Checkpoints, history: History, snapshots: Snapshots, synchroniser: Synchroniser
    ) -> None:
        self.every = checkpoints.case.output.checkpoint_every
        self._checkpoints, self._history, self._snapshots = checkpoints, history, snapshots
        self._synchroniser = synchroniser

    def due(self, step: int) -> bool:
        """By the number of the step, or by the clock."""
        return super().due(step) or self._synchroniser.checkpoint_due

    def observe(self, made: Step) -> None:
        """Write one."""
        self.write()

    def write(self) -> None:
        """Write a checkpoint. Results come first: what the checkpoint goes on from must be in them."""
        history = self._history
        history.writer.flush_history()
        self._checkpoints.write(history.ledger, history.recorder, history.blow_up, history.row, self._snapshots.last)
        self._synchroniser.checkpoint_written()

    def complete(self) -> None:
        """The checkpoint of the last step, in a case that asks for checkpoints."""
        if self._checkpoints.wanted:
            self.write()

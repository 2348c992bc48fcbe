"""Checkpoints during a run."""

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
    """Writes checkpoints at intervals of steps, and when the ranks agree that one is due by wall-clock time.

    Parameters
    ----------
    checkpoints : Checkpoints
    history, snapshots : from which a restart continues
    synchroniser : Synchroniser
    """

    needs_agreement = True

    def __init__(
        self, checkpoints: Checkpoints, history: History, snapshots: Snapshots, synchroniser: Synchroniser
    ) -> None:
        self.every = checkpoints.case.output.checkpoint_every
        self._checkpoints, self._history, self._snapshots = checkpoints, history, snapshots
        self._synchroniser = synchroniser

    @property
    def last_step(self) -> int:
        """Step of the last one."""
        return self._checkpoints.last_step

    @property
    def at_end(self) -> bool:
        """Whether :meth:`complete` writes one."""
        return self._checkpoints.wanted

    def due(self, step: int) -> bool:
        """Return whether a checkpoint is due by the number of the step or by wall-clock time."""
        return super().due(step) or self._synchroniser.checkpoint_due

    def observe(self, made: Step) -> None:
        """Write a checkpoint."""
        self.write()

    def write(self) -> None:
        """Flush the results, from which a restart continues, then write a checkpoint."""
        history = self._history
        history.writer.flush_history()
        sums = history.ledger, history.recorder, history.blow_up
        self._checkpoints.write(*sums, history.row, self._snapshots.kept(), history.stage())
        self._synchroniser.checkpoint_written()

    def complete(self) -> None:
        """Write the checkpoint of the last step, if the case requests checkpoints."""
        if self._checkpoints.wanted:
            self.write()

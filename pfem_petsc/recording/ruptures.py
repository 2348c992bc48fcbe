"""Reports bars that break: the first hundred one by one, the others by their number at the end."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from ..analysis import Step
from ..stepping.ruptures import MOST_TOLD, Break
from .observer import NEVER, Observer

if TYPE_CHECKING:
    from ..stepping.stepper import Stepper
    from .history import History

__all__ = ["RuptureReport"]


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

    def steps_left(self, step: int) -> int:
        """Return no limit: the fused loop stops where bars break."""
        return NEVER

    def observe(self, made: Step) -> None:
        """Report the bars that broke."""
        self.complete()

    def complete(self) -> None:
        """Report the bars of the last row."""
        if not self.due(0):
            return
        self._told = self._broken
        parts = self._comm.allgather(self._stepper.ruptures.take())
        for each in self._first(sorted(part for share in parts for part in share)):
            self._tell(each.text)

    def _first(self, breaks: list[Break]) -> list[Break]:
        chosen = breaks[: max(MOST_TOLD - self._reported, 0)]
        self._reported += len(chosen)
        return chosen

    def remarks(self) -> list[str]:
        """Return how many bars have broken in the stage."""
        count = self._told - self._start
        if not count:
            return []
        listed = f"; the first {self._reported} are listed above" if count > self._reported else ""
        total = self._stepper.model.mesh.n_bars
        return [f"{count:,} of {total:,} bars broke{listed}"]

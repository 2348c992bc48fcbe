"""Progress of a run, reported after each step."""

from __future__ import annotations

from ..analysis import Analysis, Step
from ..output.progress import Progress
from .history import History
from .observer import NEVER, Observer

__all__ = ["ProgressReport"]


class ProgressReport(Observer):
    """Reports each step to the progress bar, or to the lines that replace it."""

    every = 1

    def __init__(self, progress: Progress, analysis: Analysis, history: History) -> None:
        self._progress, self._analysis, self._history = progress, analysis, history

    def steps_left(self, step: int) -> int:
        """Return no limit: the last of fused steps is reported."""
        return NEVER

    def observe(self, made: Step) -> None:
        """Report a step."""
        history = self._history
        contacts = history.row["active_contacts"]
        self._progress.update(
            made.step, made.time, self._analysis.step_size, made.newton, made.linear, contacts, history.drift
        )

"""The progress report of a sweep: one line that is rewritten on a terminal, else a line now and then."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from time import perf_counter
from typing import Any

from ..output.units import duration

__all__ = ["SweepProgress"]

_BETWEEN = 10.0  # seconds between lines where they are not rewritten


class SweepProgress:
    """Counts finished runs on stderr.

    Parameters
    ----------
    runs : number of all runs
    quiet : print nothing
    """

    def __init__(self, runs: int, quiet: bool) -> None:
        self._runs, self._ended, self._failed, self._quiet = runs, 0, 0, quiet
        self._begin = self._last = perf_counter()
        self._rewrites = sys.stderr is not None and sys.stderr.isatty()

    def done(self, row: Mapping[str, Any]) -> None:
        """Count a run that has ended."""
        self._ended += 1
        self._failed += row["status"] != 0
        now = perf_counter()
        if self._quiet or not (self._rewrites or now - self._last > _BETWEEN):
            return
        self._last = now
        left = (now - self._begin) / self._ended * (self._runs - self._ended)
        self._tell(f"{self._counts()}, {duration(left)} left")

    def close(self) -> None:
        """Tell the number of runs and how long they took."""
        if not self._quiet:
            self._tell(f"{self._counts()} in {duration(perf_counter() - self._begin)}", last=True)

    def _counts(self) -> str:
        failed = f", {self._failed} without result (see the column message)" if self._failed else ""
        return f"sweep: {self._ended} of {self._runs} runs{failed}"

    def _tell(self, text: str, last: bool = False) -> None:
        if self._rewrites:
            print(f"\r{text:<78}", end="\n" if last else "", file=sys.stderr, flush=True)
        else:
            print(text, file=sys.stderr, flush=True)

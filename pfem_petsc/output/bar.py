"""The progress bar on a terminal, drawn by rich."""

from __future__ import annotations

import os
from typing import TextIO

__all__ = ["ProgressBar", "is_terminal"]

# Open MPI gives rank 0 a pseudo-terminal, so that isatty() alone would draw a bar into mpirun's line-wise forwarding.
_LAUNCHERS = ("OMPI_COMM_WORLD_SIZE", "PMI_RANK", "PMIX_RANK", "SLURM_PROCID")


def is_terminal(stream: TextIO) -> bool:
    """Whether a bar can be drawn into a stream: not into files, pipes, or the output of a launcher."""
    launched = any(name in os.environ for name in _LAUNCHERS)
    return stream.isatty() and not launched and os.environ.get("TERM", "dumb") != "dumb"


class ProgressBar:
    """A bar with a line of text, redrawn only when asked. All methods raise OSError when the terminal has gone.

    Parameters
    ----------
    title : str
    stream : TextIO
        A terminal.
    """

    def __init__(self, title: str, stream: TextIO) -> None:
        # only a terminal pays for loading rich
        from rich.console import Console
        from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
        from rich.progress import Progress as Bar

        columns = (
            BarColumn(bar_width=20),
            TaskProgressColumn(),
            TextColumn("{task.fields[state]}", markup=False),
            TimeElapsedColumn(),
            TextColumn("ETA"),
            TimeRemainingColumn(),
        )
        # no refresh thread: it would take time from the solver whenever it liked
        self._bar = Bar(*columns, console=Console(file=stream), auto_refresh=False)
        self._task = self._bar.add_task(title, total=1.0, state="")
        self._bar.start()

    def draw(self, done: float, state: str) -> None:
        """Redraw the bar with the fraction that is done and a text of the state, which fits into 80 columns."""
        self._bar.update(self._task, completed=done, state=state)
        self._bar.refresh()

    def print(self, text: str, style: str | None = None) -> None:
        """Print a line above the bar."""
        self._bar.console.print(text, style=style, markup=False, highlight=False)

    def stop(self) -> None:
        """End the bar; its last state remains on the terminal."""
        self._bar.stop()

"""The progress bar on a terminal, drawn by rich."""

from __future__ import annotations

import os
from html import escape
from math import inf
from time import monotonic
from typing import TextIO

__all__ = ["NotebookBar", "ProgressBar", "is_notebook", "is_terminal"]

# Open MPI gives rank 0 a pseudo-terminal, so isatty() alone would draw a bar into the line-wise forwarding of mpirun.
_LAUNCHERS = ("OMPI_COMM_WORLD_SIZE", "PMI_RANK", "PMIX_RANK", "SLURM_PROCID")

NOTEBOOK_REFRESH = 0.5  # seconds between two updates of a bar in a notebook


def is_terminal(stream: TextIO) -> bool:
    """Return whether a bar can be drawn into a stream: not into files, pipes, or the output of a launcher."""
    launched = any(name in os.environ for name in _LAUNCHERS)
    return stream.isatty() and not launched and os.environ.get("TERM", "dumb") != "dumb"


def is_notebook(stream: TextIO) -> bool:
    """Return whether a stream is the output of a cell of a notebook."""
    return type(stream).__module__.partition(".")[0] == "ipykernel"


class NotebookBar:
    """A bar below the cell of a notebook, in place of lines; the same interface as :class:`ProgressBar`.

    Parameters
    ----------
    title : str
    stream : TextIO
        The output of the cell.
    """

    def __init__(self, title: str, stream: TextIO) -> None:
        from IPython.display import HTML, display

        self._html, self._title, self._stream = HTML, title, stream
        self._drawn = -inf
        self._last = 0.0, ""
        self._handle = display(HTML(self._text()), display_id=True)

    def _text(self) -> str:
        done, state = self._last
        return (
            f'<progress value="{done:.4f}" max="1" style="width: 20em"></progress> {100 * done:.0f} % '
            f"<code>{escape(state)}</code> {escape(self._title)}"
        )

    def draw(self, done: float, state: str) -> None:
        """Redraw the bar, twice a second at most."""
        self._last = done, state
        if monotonic() - self._drawn >= NOTEBOOK_REFRESH:
            self._show()

    def _show(self) -> None:
        self._drawn = monotonic()
        self._handle.update(self._html(self._text()))

    def print(self, text: str, style: str | None = None) -> None:
        """Print a line below the cell."""
        print(text, file=self._stream, flush=True)

    def stop(self) -> None:
        """Draw the last state, which remains."""
        self._show()


class ProgressBar:
    """A bar with a line of text, redrawn only on request. All methods raise OSError if the terminal is closed.

    Parameters
    ----------
    title : str
    stream : TextIO
        A terminal.
    """

    def __init__(self, title: str, stream: TextIO) -> None:
        # loaded here, so that only a terminal pays for loading rich
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
        # no refresh thread, which would interrupt the solver at any time
        self._bar = Bar(*columns, console=Console(file=stream), auto_refresh=False)
        self._task = self._bar.add_task(title, total=1.0, state="")
        self._bar.start()

    def draw(self, done: float, state: str) -> None:
        """Redraw the bar with the completed fraction and a text of the state that fits into 80 columns."""
        self._bar.update(self._task, completed=done, state=state)
        self._bar.refresh()

    def print(self, text: str, style: str | None = None) -> None:
        """Print a line above the bar."""
        self._bar.console.print(text, style=style, markup=False, highlight=False)

    def stop(self) -> None:
        """End the bar; its last state remains on the terminal."""
        self._bar.stop()

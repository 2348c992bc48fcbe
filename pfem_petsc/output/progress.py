"""The progress report of a run: a summary, a bar or lines, and messages, also written to ``log.txt``."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Self, TextIO

from ..parallel.agreement import agreed
from .bar import NotebookBar, ProgressBar, is_notebook, is_terminal
from .log import LogFile
from .units import TIME, Axis, duration

if TYPE_CHECKING:
    from mpi4py import MPI

__all__ = ["Progress"]

FIRST_LINE = 2.0  # seconds until the first line, and between the first lines
LAST_LINE = 10.0  # maximum number of seconds between lines
BAR_REFRESH = 0.1  # seconds between two updates of the bar


def _speed(rate: float) -> str:
    return f"{rate:,.0f} steps/s" if rate >= 10 else f"{rate:.2g} steps/s"


class Progress:
    """Progress report of a run. Rank 0 writes; on the other ranks every call returns at once.

    On a terminal and in a notebook a bar is drawn; elsewhere (files, pipes, under ``mpirun``) a line is printed after
    2 s and then at intervals that grow to 10 s. ``log.txt`` gets the lines in any case, each with date and level; an
    existing log is continued. Between two reports :meth:`update` costs a few additions and one reading of the clock.

    A log that cannot be opened at the start is an :class:`~pfem_petsc.errors.InputError` on all ranks (the constructor
    is collective); for a log that is lost during the run see :class:`~pfem_petsc.output.log.LogFile`. If the reader of
    stdout exits (``| head``), the log records it and the run continues.

    Parameters
    ----------
    title : heading of the bar and the log
    n_steps : number of the last step, None if unknown (then progress is measured by time)
    end_time : [s], or in the unit of the axis
    quiet : print nothing on stdout; the log is still written, and warnings still go to stderr
    log_path : file of the log, None for no log
    start_step, start_time : at which a restarted run begins; rates and remaining time count from there
    axis : of the times
    stream, clock : stdout and the wall clock [s], replaceable in tests
    """

    def __init__(
        self,
        comm: MPI.Comm,
        title: str,
        n_steps: int | None,
        end_time: float,
        quiet: bool = False,
        log_path: Path | str | None = None,
        *,
        start_step: int = 0,
        start_time: float = 0.0,
        axis: Axis = TIME,
        stream: TextIO | None = None,
        clock: Callable[[], float] = perf_counter,
    ) -> None:
        self._root = comm.rank == 0
        self._axis = axis
        self._title, self._n_steps, self._end_time = title, n_steps, end_time
        self._stream = None if quiet else (stream or sys.stdout)
        self._bar: NotebookBar | ProgressBar | None = None
        self._log: LogFile | None = None
        self._clock = clock
        with agreed(comm):
            if self._root and log_path is not None:
                self._log = LogFile(log_path)
        self._begin = clock()
        self._start = (start_step, start_time)
        self._newton = self._linear = 0
        self._last = (start_step, start_time, 0.0, 0, None)
        self._marked = (self._begin, start_step, start_time, 0, 0)  # state at the last line, for rates and means
        self._rate: tuple[float, float] | None = None  # steps and simulated seconds per second of wall time
        self._interval = FIRST_LINE
        self._next_line = self._due = self._begin + FIRST_LINE
        self._closed = False
        self._compiling = 0.0
        if self._root and self._stream is not None and (is_notebook(self._stream) or is_terminal(self._stream)):
            kind = NotebookBar if is_notebook(self._stream) else ProgressBar
            self._bar = kind(title, self._stream)
            self._due = self._begin + BAR_REFRESH

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        self.close("done" if kind is None else "stopped")

    def summary(self, entries: dict[str, str]) -> None:
        """Print the start-up block: label and text of each entry, aligned; in a notebook it goes to the log alone."""
        if not self._root:
            return
        width = max((len(label) for label in entries), default=0)
        write = self._write if not isinstance(self._bar, NotebookBar) else partial(self._log_line, level="INFO")
        for line in [self._title, *(f"  {label:<{width}}  {text}" for label, text in entries.items())]:
            write(line)

    def update(
        self,
        step: int,
        time: float,
        dt: float,
        newton: int = 0,
        linear: int = 0,
        contacts: int = 0,
        energy_drift: float | None = None,
    ) -> None:
        """Record a finished step; report it if a report is due.

        Parameters
        ----------
        step, time, dt : number of the step, its time and its size [s]
        newton, linear : Newton and linear-solver iterations of this step
        contacts : number of nodes in contact
        energy_drift : energy imbalance relative to the largest energy, None without energy
        """
        if not self._root:
            return
        self._newton += newton
        self._linear += linear
        first = self._last[2] == 0.0
        self._last = (step, time, dt, contacts, energy_drift)
        now = self._clock()
        if first:
            # the first step includes compiling, loading, and waiting for ranks that do so
            self._marked = (now, step, time, self._newton, self._linear)
        if now >= self._due:
            self._report(now)

    def compiled(self, seconds: float) -> None:
        """Exclude compilation time [s] from rates and from the remaining time, because it does not recur."""
        self._compiling += seconds
        self._marked = (self._marked[0] + seconds, *self._marked[1:])

    def message(self, text: str, level: str = "INFO") -> None:
        """Print a text between the reports and log it with its level."""
        if self._root:
            for line in text.splitlines():
                self._write(line, level)

    def warning(self, text: str) -> None:
        """Log a warning and print it on stderr (above the bar, if there is one), even if quiet."""
        if not self._root:
            return
        self._log_line(text, "WARNING")
        with contextlib.suppress(OSError):  # it is in the log
            if self._bar is not None:
                self._bar.print(f"warning: {text}", style="yellow")
            else:
                print(f"warning: {text}", file=sys.stderr, flush=True)

    def close(self, outcome: str = "done") -> None:
        """Print the state at the end, the wall time and the speed; a second call does nothing."""
        if not self._root or self._closed:
            return
        self._closed = True
        now = self._clock()
        step, time, *_ = self._last
        if self._bar is not None:
            self._draw_bar()
        in_notebook = isinstance(self._bar, NotebookBar)
        if self._bar is not None:
            try:
                self._bar.stop()
                self._bar = None
            except OSError:
                self._let_go_of_stdout()
        if step > self._marked[1]:
            (self._log_line if in_notebook else self._write)(self._line(now), "INFO")
        wall, steps = now - self._begin, step - self._start[0]
        text = f"{outcome}: {steps:,} steps in {duration(wall)}"
        if self._compiling >= 0.1:
            text += f", including {duration(self._compiling)} for compiling"
        if steps and wall > self._compiling:
            text += f" ({_speed(steps / (wall - self._compiling))})"
        text += f", {self._axis.place(time)}"
        if self._newton:
            text += f", {self._newton:,} Newton and {self._linear:,} linear iterations"
        self._write(text)
        if self._log is not None:
            self._log.close()

    def _report(self, now: float) -> None:
        if now >= self._next_line:
            line = self._line(now)
            if self._bar is None:
                self._write(line)
            else:
                self._log_line(line, "INFO")
            self._marked = (now, *self._last[:2], self._newton, self._linear)
            self._interval = min(LAST_LINE, 1.25 * self._interval)
            self._next_line = now + self._interval
        if self._bar is not None:
            self._draw_bar()
        self._due = self._next_line if self._bar is None else min(self._next_line, now + BAR_REFRESH)

    def _measure(self, now: float) -> float:
        """Update the smoothed rates since the last line and return the remaining wall time [s] (inf if unknown)."""
        wall = now - self._marked[0]
        step, time, *_ = self._last
        if wall > 0 and step > self._marked[1]:
            new = ((step - self._marked[1]) / wall, (time - self._marked[2]) / wall)
            # exponential smoothing with weight 1/2 per line
            self._rate = new if self._rate is None else tuple(0.5 * a + 0.5 * b for a, b in zip(self._rate, new))
        if self._rate is None:
            return float("inf")
        left, rate = (self._end_time - time, self._rate[1])
        if self._n_steps is not None:
            left, rate = (self._n_steps - step, self._rate[0])
        return max(left, 0.0) / rate if rate > 0 else float("inf")

    def _done(self) -> float:
        """Return the completed fraction of the run."""
        step, time, *_ = self._last
        if self._n_steps:
            return min(1.0, step / self._n_steps)
        return min(1.0, time / self._end_time) if self._end_time > 0 else 1.0

    def _counters(self) -> list[str]:
        """Return iterations per step since the last line, contacts and drift; items that do not occur are omitted."""
        step, _, _, contacts, drift = self._last
        steps = max(1, step - self._marked[1])
        newton, linear = self._newton - self._marked[3], self._linear - self._marked[4]
        parts = [f"Newton {newton / steps:.1f}/step"] if newton else []
        parts += [f"linear {linear / steps:.1f}/step"] if linear else []
        parts += [f"contacts {contacts:,}"]
        return parts + ([f"energy drift {drift:+.1e}"] if drift is not None else [])

    def _line(self, now: float) -> str:
        step, time, dt, *_ = self._last
        remaining = self._measure(now)
        total = f"/{self._n_steps}" if self._n_steps is not None else ""
        width = len(str(self._n_steps)) if self._n_steps is not None else 8
        parts = [f"step {step:>{width}}{total} {100 * self._done():3.0f} %"]
        parts += [self._axis.place(time)]
        parts += [f"d{self._axis.place(dt, 3)}"] if self._axis.unit else []
        parts += self._counters()
        parts += [_speed(self._rate[0])] if self._rate is not None else []
        return "  ".join([*parts, f"ETA {duration(remaining)}"])

    def _draw_bar(self) -> None:
        step, time, _, contacts, _ = self._last
        total = f"/{self._n_steps}" if self._n_steps is not None else ""
        # must fit into 80 columns; the lines of the log have more details
        state = f"{step}{total}  {self._axis.place(time)}" + (f"  contacts {contacts:,}" if contacts else "")
        try:
            self._bar.draw(self._done(), state)
        except OSError:
            self._let_go_of_stdout()

    def _write(self, text: str, level: str = "INFO") -> None:
        """Write a line to stdout (above the bar, if there is one) and to the log."""
        self._log_line(text, level)
        if self._stream is None:
            return
        try:
            if self._bar is not None:
                self._bar.print(text)
            else:
                print(text, file=self._stream, flush=True)
        except OSError:
            self._let_go_of_stdout()

    def _let_go_of_stdout(self) -> None:
        """Stop writing to stdout, because its reader or terminal is closed, or its disk is full."""
        if self._stream is sys.stdout:
            # Python flushes stdout at exit and needs a valid target
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        self._stream = self._bar = None
        self._log_line("stdout is closed: the run continues and reports here only", "WARNING")

    def _log_line(self, text: str, level: str) -> None:
        if self._log is not None:
            self._log.write(text, level)

"""The progress report of a run: a summary, a bar or lines, and messages, also written to ``log.txt``."""

from __future__ import annotations

import contextlib
import os
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path
from time import perf_counter, strftime
from typing import TYPE_CHECKING, Any, NamedTuple, TextIO

from ..errors import InputError
from ..parallel.agreement import agreed
from ..signals import launched_rank
from .table import aligned
from .units import TIME, Axis, duration

if TYPE_CHECKING:
    from mpi4py import MPI

__all__ = ["LogFile", "Progress", "Span"]

FIRST_LINE = 2.0  # seconds until the first line, and between the first lines
LAST_LINE = 10.0  # maximum number of seconds between lines
SHORT = 240  # letters of a warning, if quiet
BAR_REFRESH = 0.1  # seconds between two updates of the bar


class LogFile:
    """Appends lines to a log, each with date and level; an existing one is continued, one that is removed begins anew.

    A file that cannot be opened at the start is an error. If it is lost during the run (folder removed, disk full), a
    warning is printed once on stderr, later lines are dropped, and the run continues.

    Raises
    ------
    InputError
        If the file cannot be created; a missing folder is created.
    """

    def __init__(self, path: Path | str) -> None:
        self._path, self._lost = Path(path).absolute(), False
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._path.open("a").close()
        except OSError as error:
            raise InputError(
                f"{path}: the log cannot be written ({error.strerror}); choose another output folder with -o"
            ) from error

    def write(self, text: str, level: str = "INFO") -> None:
        """Append a line."""
        if self._lost:
            return
        try:
            file = os.open(self._path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
            try:  # without what needs imports, which a run that is left at the end of a program cannot make
                os.write(file, f"{strftime('%Y-%m-%d %H:%M:%S')} {level:7} {text}\n".encode())
            finally:
                os.close(file)
        except OSError as error:
            self._lost = True
            print(
                f"warning: {self._path}: the log cannot be written any more ({error.strerror}); "
                "the run continues without it",
                file=sys.stderr,
                flush=True,
            )


class Span(NamedTuple):
    """What a run computes, from which its progress is measured.

    Attributes
    ----------
    steps : number of the last step, None if unknown (then progress is measured by time)
    end : [s], or in the unit of the axis
    axis : of the times
    first_step, start : number and time at which a restarted run begins; rates and remaining time count from there
    """

    steps: int | None
    end: float
    axis: Axis = TIME
    first_step: int = 0
    start: float = 0.0


class Progress:
    """Progress report of a run. Rank 0 writes; on the other ranks every call returns at once.

    On a terminal a bar is drawn; elsewhere (files, pipes, notebooks, under ``mpirun``) a line is printed after 2 s and
    then at intervals that grow to 10 s. The log gets the lines in any case. Between two reports :meth:`update` costs a
    few additions and one reading of the clock. If the reader of stdout exits (``| head``), the log records it and the
    run continues.

    Parameters
    ----------
    title : heading of the bar and the log
    span : Span
    quiet : print nothing on stdout; the log is still written, and the beginnings of warnings go to stderr
    log_path : file of the log, None for no log; one that cannot be opened is an
        :class:`~pfem_petsc.errors.InputError` on all ranks (the constructor is collective)
    stream, clock : stdout and the wall clock [s], replaceable in tests

    Attributes
    ----------
    axis : of the times of the current stage
    warnings : texts of the warnings so far
    """

    def __init__(
        self,
        comm: MPI.Comm,
        title: str,
        span: Span,
        quiet: bool = False,
        log_path: Path | str | None = None,
        stream: TextIO | None = None,
        clock: Callable[[], float] = perf_counter,
    ) -> None:
        self._root = comm.rank == 0
        self._title, self._span, self._clock, self.axis = title, span, clock, span.axis
        self._stream = None if quiet else (stream or sys.stdout)
        self._short = log_path if quiet else None
        self._log: LogFile | None = None
        with agreed(comm):
            if self._root and log_path is not None:
                self._log = LogFile(log_path)
        self._begin = clock()
        self._newton = self._linear = 0
        self.warnings: list[str] = []
        self._last = (span.first_step, span.start, 0.0, 0, None)
        self._marked = (self._begin, span.first_step, 0, 0, span.start)  # state at the last line, for rates and means
        self._interval = FIRST_LINE
        self._next_line = self._due = self._begin + FIRST_LINE
        self._closed = False
        self._compiling = 0.0
        self._bar = None
        if self._root and self._stream is not None and _is_terminal(self._stream):
            self._bar = _bar(title, self._stream)
            self._due = self._begin + BAR_REFRESH

    def summary(self, entries: dict[str, str]) -> None:
        """Print the start-up block: label and text of each entry, aligned."""
        self.message("\n".join([self._title, *aligned(entries.items())]))

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
            self._mark(now)
        if now >= self._due:
            self._report(now)

    def _mark(self, now: float) -> None:
        self._marked = (now, self._last[0], self._newton, self._linear, self._last[1])

    def compiled(self, seconds: float) -> None:
        """Exclude compilation time [s] from rates and from the remaining time, because it does not recur."""
        self._compiling += seconds
        self._marked = (self._marked[0] + seconds, *self._marked[1:])

    def message(self, text: str) -> None:
        """Print a text between the reports, and log it."""
        if self._root:
            for line in text.splitlines():
                self._write(line)

    def warning(self, text: str) -> None:
        """Log a warning and print it on stderr (above the bar, if there is one), even if quiet: then one line of it.

        The same text is told once.
        """
        if not self._root or text in self.warnings:
            return
        self.warnings.append(text)
        self._log_line(text, "WARNING")
        shown = f"warning: {text}"
        if self._short is not None:
            brief = textwrap.shorten(shown, SHORT, placeholder=" ...")
            shown = brief if len(shown) <= SHORT else f"{brief} ({self._short})"
        with contextlib.suppress(OSError):  # it is in the log
            self._show(shown, sys.stderr, style="yellow")

    def close(
        self,
        outcome: str = "done",
        reached: tuple[int, float] | None = None,
        error: BaseException | None = None,
        results: Path | None = None,
    ) -> None:
        """Print the state at the end, the wall time and the speed; a second call does nothing.

        ``reached``: number and time of the last step, the one that failed included, if it was not reported; ``error``:
        what ended the run, for the log; ``results``: their folder, if there are any.
        """
        if not self._root or self._closed:
            return
        self._closed = True
        now = self._clock()
        if reached is not None:
            self._last = (*reached, *self._last[2:])
        step, time, *_ = self._last
        self._draw()
        if self._bar is not None:
            with contextlib.suppress(OSError):  # the terminal is closed, as the next line will find
                self._bar.stop()
            self._bar = None
        if step > self._marked[1]:
            self._write(self._line(now, ended=outcome == "done"))
        wall, steps = now - self._begin, step - self._span.first_step
        text = f"{outcome}: {steps:,} step{'' if steps == 1 else 's'} in {duration(wall)}"
        if self._compiling >= 0.1:
            text += f", including {duration(self._compiling)} for compiling"
        if steps and wall > self._compiling:
            text += f" ({_speed(steps / (wall - self._compiling))})"
        text += f", {self.axis.place(time)}"
        if self._newton:
            text += f", {self._newton:,} Newton and {self._linear:,} linear iterations"
        self._write(text)
        if results is not None:
            self._write(f"results in {results}")
        if error is not None:
            self._log_line(f"error: {error}", "ERROR")

    def _report(self, now: float) -> None:
        if now >= self._next_line:
            line = self._line(now)
            if self._bar is None:
                self._write(line)
            else:
                self._log_line(line)
            self._mark(now)
            self._interval = min(LAST_LINE, 1.25 * self._interval)
            self._next_line = now + self._interval
        self._draw()
        self._due = self._next_line if self._bar is None else min(self._next_line, now + BAR_REFRESH)

    def _done(self) -> float:
        """Return the completed fraction of the run."""
        step, time, *_ = self._last
        if self._span.steps:
            return min(1.0, step / self._span.steps)
        return min(1.0, time / self._span.end) if self._span.end > 0 else 1.0

    def _draw(self) -> None:
        """Redraw the bar, if there is one, in 80 columns; the lines of the log say more."""
        if self._bar is None:
            return
        step, time, _, contacts, _ = self._last
        total = f"/{self._span.steps}" if self._span.steps is not None else ""
        text = f"{step}{total}  {self.axis.place(time)}" + (f"  contacts {contacts:,}" if contacts else "")
        try:
            self._bar.update(self._bar.task_ids[0], completed=self._done(), state=text)
            self._bar.refresh()
        except OSError:
            self._let_go_of_stdout()

    def _line(self, now: float, ended: bool = False) -> str:
        """Return the state, means and rates since the last line, and the remaining wall time unless all is done: a path
        may end before its last point."""
        step, time, dt, contacts, drift = self._last
        begin, before, newton, linear, start = self._marked
        n_steps, axis, wall, made = self._span.steps, self.axis, now - begin, step - before
        width = len(str(n_steps)) if n_steps is not None else 8
        total = f"/{n_steps}" if n_steps is not None else ""
        done = 1.0 if ended else self._done()
        parts = [f"step {step:>{width}}{total} {100 * done:3.0f} %", axis.place(time)]
        parts += [f"d{axis.place(dt, 3)}"] if axis.unit else []
        parts += [f"Newton {(self._newton - newton) / max(1, made):.1f}/step"] if self._newton > newton else []
        parts += [f"linear {(self._linear - linear) / max(1, made):.1f}/step"] if self._linear > linear else []
        parts += [f"contacts {contacts:,}"]
        parts += [f"energy drift {drift:+.1e}"] if drift is not None else []
        remaining = 0.0 if ended else float("inf")
        if wall > 0.0 and made > 0:
            parts += [_speed(made / wall)]
            left, since = (n_steps - step, made) if n_steps is not None else (self._span.end - time, time - start)
            remaining = max(left, 0.0) * wall / since if since > 0.0 and not ended else remaining
        return "  ".join([*parts, f"ETA {duration(remaining)}"])

    def _write(self, text: str) -> None:
        """Write a line to stdout (above the bar, if there is one) and to the log."""
        self._log_line(text)
        if self._stream is None:
            return
        try:
            self._show(text, self._stream)
        except OSError:
            self._let_go_of_stdout()

    def _show(self, text: str, stream: TextIO, style: str | None = None) -> None:
        """Print a line to a stream, or above the bar if there is one."""
        if self._bar is not None:
            self._bar.console.print(text, style=style, markup=False, highlight=False)
        else:
            print(text, file=stream, flush=True)

    def _let_go_of_stdout(self) -> None:
        """Stop writing to stdout, because its reader or terminal is closed, or its disk is full."""
        if self._stream is sys.stdout:
            # Python flushes stdout at exit and needs a valid target
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        self._stream = self._bar = None
        self._log_line("stdout is closed: the run continues and reports here only", "WARNING")

    def _log_line(self, text: str, level: str = "INFO") -> None:
        if self._log is not None:
            self._log.write(text, level)


def _speed(rate: float) -> str:
    return f"{rate:,.0f} steps/s" if rate >= 10 else f"{rate:.2g} steps/s"


def _is_terminal(stream: TextIO) -> bool:
    """Return whether a bar can be drawn into a stream: not into files, pipes, or the output of a launcher."""
    # Open MPI gives rank 0 a pseudo-terminal, whose lines mpirun forwards
    return stream.isatty() and launched_rank() is None and os.environ.get("TERM", "dumb") != "dumb"


def _bar(title: str, stream: TextIO) -> Any:
    """Return a bar by rich, redrawn only on request; what writes to it raises OSError if the terminal is closed."""
    # loaded here, so that only a terminal pays for loading rich
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    state = TextColumn("{task.fields[state]}", markup=False)
    columns = (BarColumn(bar_width=20), TaskProgressColumn(), state, TimeElapsedColumn(), TextColumn("ETA"))
    # no refresh thread, which would interrupt the solver at any time
    bar = Progress(*columns, TimeRemainingColumn(), console=Console(file=stream), auto_refresh=False)
    bar.add_task(title, total=1.0, state="")
    bar.start()
    return bar

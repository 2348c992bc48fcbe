"""Sweeps: many runs of a case with other values of its keys, in processes of their own, and the table of their results.

None is forked from a process in which MPI runs. Tasks come to a process through stdin and reports leave through stdout,
as pickles; what libraries print goes to stderr.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import pickle
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

from .case.schema import Case
from .case.toml import plain
from .columns import LOST, STORED, SUPPLIED
from .errors import InputError, PfemError
from .files import move_aside
from .output.result import Result, open_result, peak_force, touch_impulse
from .output.table import SWEEP, Table, flat_columns, select
from .registry import nearest
from .signals import environment_alone

if TYPE_CHECKING:
    from .case.schema import Case

_PATIENCE = 10.0  # seconds in which a process that is told to end must end
_WATCH = 1.0  # seconds between two looks for the parent process


class Task(NamedTuple):
    """A run: case, folder of the results, and limit of its wall time [s], None for none."""

    case: Case
    output: Path
    wall_time: float | None


class Report(NamedTuple):
    """How a run has ended: exit status, message (warnings of a run that is done), wall time [s] and number of steps."""

    status: int
    message: str
    wall_time: float
    steps: int


def environment() -> dict[str, str]:
    """Return the environment of a run's process: one thread, unless OMP_NUM_THREADS is set."""
    return {"OMP_NUM_THREADS": "1", **environment_alone()}


class _Process:
    """A separate process for tasks, started with its first one, and again after it has ended."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - as long as the process lives

    def perform(self, task: Task) -> Report:
        """Send a task, and wait for the report."""
        if self._process is None:
            self._errors.seek(0)
            self._errors.truncate()
            self._process = subprocess.Popen(
                [sys.executable, "-m", "pfem_petsc.studies"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                env=environment(),
                start_new_session=True,  # Ctrl-C reaches this process alone, which ends the others
            )
        try:
            pickle.dump(task, self._process.stdin)
            self._process.stdin.flush()
            return Report(*pickle.load(self._process.stdout))
        except (OSError, EOFError, pickle.UnpicklingError):
            status = self._process.wait()
            self.close()
            how = f"by {signal.Signals(-status).name}" if status < 0 else f"with status {status}"
            self._errors.seek(0)
            lines = ["", *self._errors.read().decode(errors="replace").strip().splitlines()]
            message = f"the process of the run ended {how}" + (f": {lines[-1]}" if lines[-1] else "")
            return Report(status or 1, message, float("nan"), 0)

    def end(self) -> None:
        """End a run at once; may be called from another thread."""
        process = self._process
        if process is not None:
            process.terminate()
            try:
                process.wait(_PATIENCE)
            except subprocess.TimeoutExpired:
                process.kill()

    def close(self) -> None:
        """Let the process end."""
        process, self._process = self._process, None
        if process is not None:
            with contextlib.suppress(OSError):
                process.stdin.close()
            process.stdout.close()
            process.wait()


def performed(tasks: Sequence[Task], processes: int) -> Iterator[tuple[int, Report]]:
    """Yield number and report of each task, in the order in which they end.

    If the iteration is left before its end, runs in progress are ended, and no others begin.
    """
    workers: list[_Process] = []
    own = threading.local()

    def perform_apart(task: Task) -> Report:
        if not hasattr(own, "worker"):
            own.worker = _Process()
            workers.append(own.worker)
        return own.worker.perform(task)

    with ThreadPoolExecutor(max(min(processes, len(tasks)), 1)) as pool:
        runs = {pool.submit(perform_apart, task): number for number, task in enumerate(tasks)}
        try:
            for run in as_completed(runs):
                yield runs[run], run.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            for worker in workers if not all(run.done() for run in runs) else ():
                worker.end()
            pool.shutdown()
            for worker in workers:
                worker.close()


def perform(task: Task) -> Report:
    """Execute a run in this process, and return its outcome."""
    from mpi4py import MPI

    from .errors import PfemError
    from .simulation import Simulation

    begin, steps = time.perf_counter(), 0
    status, message = 0, ""
    try:
        with Simulation(
            task.case, MPI.COMM_SELF, output=task.output, quiet=True, wall_time=task.wall_time
        ) as simulation:
            try:
                status = simulation.run()
            finally:
                steps = simulation.stepper.number
            warnings = simulation.outputs.progress.warnings
            if warnings:
                message = f"{len(warnings)} warning{'s' * (len(warnings) > 1)}: {warnings[0]}"
    except PfemError as error:
        status, message = error.exit_status, str(error)
    except Exception as error:  # noqa: BLE001 - whatever it is becomes a row of the table
        status, message = 1, f"{type(error).__name__}: {error}"
    return Report(status, message, time.perf_counter() - begin, steps)


def _follow_parent() -> None:
    """Stop the run in progress, with a checkpoint, when the process that makes the sweep has gone. Runs in a thread."""
    parent = os.getppid()
    while os.getppid() == parent:
        time.sleep(_WATCH)
    os.kill(os.getpid(), signal.SIGTERM)


def _main() -> None:
    """Perform tasks until there are no more, or nobody is there to give them."""
    threading.Thread(target=_follow_parent, daemon=True).start()
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    with contextlib.suppress(EOFError):
        while True:
            report = perform(pickle.load(sys.stdin.buffer))
            pickle.dump(tuple(report), replies)
            replies.flush()


_OWN = ("run", "status", "message", "wall_time", "steps")
"""Columns that a table has besides parameters and results."""

ResultFunction = Callable[[Result], Any]


def sweep(
    case: Case,
    vary: Mapping[str, Sequence[Any]] | Sequence[Mapping[str, Any]],
    *,
    processes: int = 1,
    results: ResultFunction | Mapping[str, ResultFunction | str] | None = None,
    output: Path | str | None = None,
    keep: bool = True,
    wall_time: float | None = None,
    quiet: bool = False,
) -> Table:
    """Run a case for all combinations of values of some keys, and return a table with a row for each.

    Each run uses one rank, in a separate process. A run that is rejected, fails or crashes is a row with its status
    and message, and the sweep continues. Rows are in the order of the combinations, and are also written to
    ``sweep.csv`` in the output folder as soon as they are available.

    Parameters
    ----------
    case : Case
    vary : values by key, ``{"time.step": [1e-5, 2e-5], "material.steel.young_modulus": [2e11]}``: all combinations, the
        last key varying fastest; or a list of changes, each as for :meth:`Case.copy`, one for each run
    processes : number of runs at a time
    results : columns of results: a function of the finished :class:`Result` for each name, or a column of the history,
        whose last value is used (vectors have a column for each component), or a part of it as for
        :func:`~pfem_petsc.output.table.selected`, or one of the default results; or one function that returns values
        by name. Functions are called in this process; an exception becomes the message of the row, whose status is then
        1. Default: ``final_...``, the last values of time and of the energies that occur [J];
        ``peak_wall/NAME/force`` and ``peak_support_force``, the largest forces of walls and supports [N], as means over
        the time of a wave forth and back in the shortest bar there; and ``touch_wall/NAME/impulse``, the impulses of
        walls in the rows in which nodes touch them [N s]
    output : folder of the results, which are in folders ``0000``, ``0001``, ... in it; default:
        ``results/<case name>-sweep``. An existing one is moved aside
    keep : whether the results of the runs are kept; otherwise those with status 0 are removed after their row is made
    wall_time : limit for each run [s]; a run that reaches it has status 4
    quiet : print no progress

    Returns
    -------
    Table with the columns ``run``, one for each key, ``status`` (0: done, 2: rejected, 3: failed, 4: stopped, 1 or
    negative: an unexpected error or signal), ``message``, ``wall_time`` [s], ``steps``, and the results (nan for runs
    without). The message of a run that is done is the number of its warnings and the first of them.

    Raises
    ------
    InputError
        If no combination makes a valid case, no case has a named column, or the output folder cannot be written.
    """
    from mpi4py import MPI

    changes = _combinations(vary)
    if not isinstance(processes, int) or isinstance(processes, bool) or processes < 1:
        raise InputError(f"sweep: processes = {processes!r}: give a positive whole number")
    if MPI.COMM_WORLD.size > 1:
        raise InputError("sweep: each run has its own process on one rank: start the sweep without mpirun")
    if results is not None and not callable(results) and not isinstance(results, Mapping):
        raise InputError(f"sweep: results = {results!r:.60}: expected a function, or functions by name")
    asked = list(results) if isinstance(results, Mapping) else []
    for name in set(asked) & set(_OWN):
        raise InputError(f"sweep: results: the table has a column {name!r} already")
    cases, refused = _cases(case, changes)
    if isinstance(results, Mapping):
        _refuse_unknown([name for name in results.values() if isinstance(name, str)], cases.values())
    folder = _prepared(Path(output) if output is not None else Path("results") / f"{case.name}-sweep")
    tasks = [Task(each, folder / f"{number:04d}", wall_time) for number, each in cases.items()]
    numbers = list(cases)
    rows: dict[int, dict[str, Any]] = {}
    found: dict[int, dict[str, Any]] = {}
    ended = itertools.chain(
        ((number, Report(2, text, 0.0, 0)) for number, text in refused.items()),
        ((numbers[k], report) for k, report in performed(tasks, processes)),
    )
    with _progress(quiet) as progress:
        counter = progress.add_task("", total=len(changes), failed=0)
        for number, report in ended:
            place = folder / f"{number:04d}"
            if not report.status:
                try:
                    found[number] = _results_of(open_result(place), results)
                except Exception as error:  # noqa: BLE001 - of a user's function; the other runs go on
                    text = error.args[0] if isinstance(error, KeyError) and error.args else error
                    report = report._replace(status=1, message=f"results: {type(error).__name__}: {text}")
            rows[number] = {"run": number, **plain(changes[number]), **report._asdict()}
            if not keep and report.status == 0:
                shutil.rmtree(place, ignore_errors=True)
            failed = sum(row["status"] != 0 for row in rows.values())
            progress.update(counter, advance=1, failed=failed)
            table = _table(rows, found, asked, results is None)
            table.to_csv(folder / SWEEP)
    return table


def _combinations(vary: Any) -> list[dict[str, Any]]:
    """Return the changes of each run."""
    if isinstance(vary, Mapping):
        for key, values in vary.items():
            if isinstance(values, str | bytes | Mapping) or not hasattr(values, "__len__"):
                raise InputError(f"sweep: {key} = {values!r:.60}: expected a list of values")
        found = [dict(zip(vary, values, strict=True)) for values in itertools.product(*vary.values())]
    else:
        found = [dict(changes) for changes in vary]
    if not found:
        raise InputError("sweep: there is nothing to run: give values, as {'time.step': [1e-5, 2e-5]}")
    for key in {key for changes in found for key in changes}:
        if key in _OWN:
            raise InputError(f"sweep: {key}: this is a column of the table, not a key of a case")
    return found


def _cases(case: Case, changes: list[dict[str, Any]]) -> tuple[dict[int, Case], dict[int, str]]:
    """Return the valid cases and the messages about the others, by number."""
    cases: dict[int, Case] = {}
    refused: dict[int, str] = {}
    for number, each in enumerate(changes):
        try:
            cases[number] = case.copy(each)
        except InputError as error:
            refused[number] = str(error)
    if not cases:
        raise InputError(refused[0])
    return cases, refused


def _prepared(folder: Path) -> Path:
    """Create the output folder, after an existing one was moved aside to a numbered name."""
    try:
        if folder.exists() and any(folder.iterdir()):
            move_aside(folder)
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot write the results of a sweep there: {error.strerror}") from error
    return folder.absolute()


def _table(rows: dict[int, dict[str, Any]], found: dict[int, dict[str, Any]], asked: list[str], usual: bool) -> Table:
    """Make the table of rows and results, by number of the run; results that a run lacks are nan.

    ``asked`` are the names of results where no run has any; of the ``usual`` ones those that never occur are left out.
    """
    ordered = [rows[number] | found.get(number, {}) for number in sorted(rows)]
    own = [name for row in rows.values() for name in row]
    names = [name for number in sorted(found) for name in found[number]] or asked
    if usual:
        names = [name for name in names if any(row.get(name) for row in ordered)]
    return Table({name: [row.get(name, float("nan")) for row in ordered] for name in dict.fromkeys([*own, *names])})


def _progress(quiet: bool) -> Progress:
    """Return a line on stderr that counts runs."""
    parts = (BarColumn(), MofNCompleteColumn(), "runs, {task.fields[failed]} without result", TimeRemainingColumn())
    return Progress("sweep", *parts, console=Console(stderr=True), disable=quiet)


def _results_of(result: Result, results: ResultFunction | Mapping[str, ResultFunction | str] | None) -> dict[str, Any]:
    """Return the results of a run by name, as :func:`sweep` takes them."""
    if results is None:
        return {name: value(result) for name, value in _usual_results(result.history).items()}
    if callable(results):
        values = results(result)
        return dict(values) if isinstance(values, Mapping) else {"result": values}
    found: dict[str, Any] = {}
    for name, what in results.items():
        found |= {name: what(result)} if callable(what) else _column(result, name, what)
    return found


def _refuse_unknown(asked: Iterable[str], cases: Iterable[Case]) -> None:
    """Refuse columns of results that no case has; one has all of them as a rule."""
    from mpi4py import MPI

    from .simulation import Simulation

    refusal = None
    for case in cases if asked else ():
        try:
            with Simulation(case, MPI.COMM_SELF, check_only=True) as simulation:
                rows = {name: np.zeros((1, *kind.shape)) for name, kind in simulation.columns.items()}
        except PfemError:  # which becomes the message of the row
            continue
        try:
            for name in asked:
                _check(rows, name)
            return
        except InputError as error:
            refusal = refusal or error
    if refusal is not None:
        raise refusal


def _check(history: Mapping[str, np.ndarray], name: str) -> None:
    """Refuse a name that is neither one of the default results nor a selection of the history."""
    usual = list(_usual_results(history))
    if name in usual:
        return
    if name.startswith(("final_", "peak_", "touch_")):
        raise InputError(f"sweep: results: there is no {name!r}{nearest(name, usual)}")
    try:
        select(history, name)
    except InputError as error:
        raise InputError(f"sweep: results: {error}") from None


def _column(result: Result, label: str, name: str) -> dict[str, Any]:
    """Return one of the default results, or the last value of a column, a number or all components, as ``label``."""
    usual = _usual_results(result.history)
    if name in usual:
        return {label: usual[name](result)}
    found = select(result.history, name)
    return {each: column[0] for each, column in flat_columns(label, found.values[-1:], found.vector).items()}


def _usual_results(columns: Iterable[str]) -> dict[str, ResultFunction]:
    """Return the default results that a history with these columns has: last time and energies, largest mean forces
    [N], and impulses of first touches [N s]."""
    names, found = list(columns), {}
    for name in ("time", *STORED, *LOST, *SUPPLIED, "energy_imbalance"):
        if name in names:
            found[f"final_{name}"] = lambda result, name=name: float(result.history[name][-1])
    for name in names:
        if (name.startswith("wall/") and name.endswith("/force")) or name == "support_force":
            found[f"peak_{name}"] = lambda result, name=name: peak_force(result, name)[0]
        if name.startswith("wall/") and name.endswith("/contacts"):
            wall = name.removeprefix("wall/").removesuffix("/contacts")
            found[f"touch_wall/{wall}/impulse"] = lambda result, wall=wall: touch_impulse(result, wall)[0]
    return found


if __name__ == "__main__":
    _main()

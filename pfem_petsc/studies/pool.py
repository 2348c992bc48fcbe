"""Processes that make the runs of a sweep, several at a time, and what such a process does.

None is forked from a process in which MPI runs. Tasks come to a process through stdin and reports leave through stdout,
as pickles; what libraries print goes to stderr.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from ..case.schema import Case

OF_A_LAUNCH = (
    *("PMIX_", "PMI_", "OPAL_", "ORTE_", "PRTE_LAUNCHED", "OMPI_COMM_", "OMPI_APP_", "OMPI_UNIVERSE_", "OMPI_FILE_"),
    *("OMPI_MCA_orte_", "OMPI_MCA_ess", "OMPI_MCA_pmix", "HYDRA_", "SLURM_PMI"),
)
"""Variables that a launcher of MPI sets, and that would make another process a rank of the same job."""

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
    """Return the environment of processes that MPI did not launch; one thread each, unless OMP_NUM_THREADS is set."""
    own = {name: value for name, value in os.environ.items() if not name.startswith(OF_A_LAUNCH)}
    return {"OMP_NUM_THREADS": "1", **own}


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
                [sys.executable, "-m", "pfem_petsc.studies.pool"],
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
    workers = [_Process() for _ in range(max(min(processes, len(tasks)), 1))]
    idle: queue.SimpleQueue[_Process] = queue.SimpleQueue()
    stopped = threading.Event()

    def with_next(task: Task) -> Report:
        worker = idle.get()
        try:
            return worker.perform(task)
        finally:
            idle.put(worker)
            if stopped.is_set():
                worker.close()

    with contextlib.ExitStack() as ending, ThreadPoolExecutor(len(workers)) as pool:
        for worker in workers:
            ending.callback(worker.close)
            idle.put(worker)
        runs = {pool.submit(with_next, task): number for number, task in enumerate(tasks)}
        try:
            for run in as_completed(runs):
                yield runs[run], run.result()
        finally:
            stopped.set()
            pool.shutdown(wait=False, cancel_futures=True)
            for worker in workers if not all(run.done() for run in runs) else ():
                worker.end()


def perform(task: Task) -> Report:
    """Execute a run in this process, and return its outcome."""
    from mpi4py import MPI

    from ..errors import PfemError
    from ..simulation import Simulation

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


if __name__ == "__main__":
    _main()

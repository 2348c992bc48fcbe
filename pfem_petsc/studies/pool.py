"""Processes that make the runs of a sweep, several at a time; none is forked from a process in which MPI runs."""

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
from collections.abc import Iterator, Sequence

from .worker import Report, Task

__all__ = ["environment", "performed"]

OF_A_LAUNCH = (
    *("PMIX_", "PMI_", "OPAL_", "ORTE_", "PRTE_LAUNCHED", "OMPI_COMM_", "OMPI_APP_", "OMPI_UNIVERSE_", "OMPI_FILE_"),
    *("OMPI_MCA_orte_", "OMPI_MCA_ess", "OMPI_MCA_pmix", "HYDRA_", "SLURM_PMI"),
)
"""Variables that a launcher of MPI sets, and that would make another process a rank of the same job."""

_PATIENCE = 10.0  # seconds in which a process that is told to end must end


def environment() -> dict[str, str]:
    """Return the environment of processes that MPI did not launch; one thread each, unless OMP_NUM_THREADS is set."""
    own = {name: value for name, value in os.environ.items() if not name.startswith(OF_A_LAUNCH)}
    return {"OMP_NUM_THREADS": "1", **own}


class _Process:
    """A worker in a separate process, started with its first task, and again after it has ended."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - as long as the process lives
        self._ended = False

    def perform(self, task: Task) -> Report:
        """Send a task, and wait for the report."""
        if self._process is None:
            self._errors.seek(0)
            self._errors.truncate()
            self._process = subprocess.Popen(
                [sys.executable, "-m", "pfem_petsc.studies.worker"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                env=environment(),
                start_new_session=True,  # Ctrl-C reaches this process alone, which ends the workers
            )
        process = self._process
        try:
            pickle.dump(task, process.stdin)
            process.stdin.flush()
            return Report(*pickle.load(process.stdout))
        except (OSError, EOFError, pickle.UnpicklingError):
            status = process.wait()
            self.close()
            return Report(status or 1, self._last_words(status), float("nan"), 0)

    def _last_words(self, status: int) -> str:
        if self._ended:
            return "the run was ended"
        how = f"by {signal.Signals(-status).name}" if status < 0 else f"with status {status}"
        self._errors.seek(0)
        lines = self._errors.read().decode(errors="replace").strip().splitlines()
        return f"the process of the run ended {how}" + (f": {lines[-1]}" if lines else "")

    def end(self) -> None:
        """End a run at once; may be called from another thread."""
        self._ended = True
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
    waiting: queue.SimpleQueue[int] = queue.SimpleQueue()
    done: queue.SimpleQueue[tuple[int, Report | BaseException]] = queue.SimpleQueue()
    for number in range(len(tasks)):
        waiting.put(number)
    stopped = threading.Event()
    workers = [_Process() for _ in range(min(processes, len(tasks)))]

    def work(worker: _Process) -> None:
        try:
            while not stopped.is_set():
                try:
                    number = waiting.get_nowait()
                except queue.Empty:
                    return
                try:
                    done.put((number, worker.perform(tasks[number])))
                except Exception as error:  # noqa: BLE001 - raised by the main thread
                    done.put((number, error))
        finally:
            worker.close()

    threads = [threading.Thread(target=work, args=(worker,), daemon=True) for worker in workers]
    for thread in threads:
        thread.start()
    ended = 0
    try:
        while ended < len(tasks):
            number, report = done.get()
            if isinstance(report, BaseException):
                raise report
            ended += 1
            yield number, report
    finally:
        if ended < len(tasks):
            stopped.set()
            for worker in workers:
                worker.end()
        for thread in threads:
            thread.join()

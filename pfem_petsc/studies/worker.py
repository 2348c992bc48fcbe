"""A process that makes one run after the other for a sweep: tasks come through stdin, reports leave through stdout.

Messages are pickles. What libraries print goes to stderr.
"""

from __future__ import annotations

import os
import pickle
import signal
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from ..case.schema import Case

__all__ = ["Report", "Task", "perform"]

_WATCH = 1.0  # seconds between two looks for the parent process


class Task(NamedTuple):
    """A run: case, folder of the results, and limit of its wall time [s], None for none."""

    case: Case
    output: Path
    wall_time: float | None


class Report(NamedTuple):
    """How a run has ended: exit status, message, wall time [s] and number of steps."""

    status: int
    message: str
    wall_time: float
    steps: int


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
    except PfemError as error:
        status, message = error.exit_status, str(error)
    except Exception as error:  # noqa: BLE001 - whatever it is becomes a row of the table
        status, message = 1, f"{type(error).__name__}: {error}"
    return Report(status, message, time.perf_counter() - begin, steps)


def follow_parent() -> None:
    """Stop the run in progress, with a checkpoint, when the process that makes the sweep has gone. Runs in a thread."""
    parent = os.getppid()
    while os.getppid() == parent:
        time.sleep(_WATCH)
    os.kill(os.getpid(), signal.SIGTERM)


def main() -> None:
    """Perform tasks until there are no more, or nobody is there to give them."""
    threading.Thread(target=follow_parent, daemon=True).start()
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    while True:
        try:
            task = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        pickle.dump(tuple(perform(task)), replies)
        replies.flush()


if __name__ == "__main__":
    main()

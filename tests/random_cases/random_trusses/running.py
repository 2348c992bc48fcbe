"""Runs cases in this process, one after the other, on the ranks of a communicator."""

from __future__ import annotations

import contextlib
import gc
import io
import os
import re
import shutil
import signal
import time
import traceback
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from pfem_petsc import Case, Simulation, open_result
from pfem_petsc.case.toml import table_text
from pfem_petsc.errors import EarlyStop, InputError, SimulationFailure

COLLECT = 20
"""Number of cases between garbage collections, which take as long as a case."""
_cleared = 0
GRACE = 20.0
"""Seconds in which all ranks must reach the end of a case."""
STATUS = {InputError: 2, SimulationFailure: 3}
_PLACE = re.compile(r"\bstep \d|\bt = |^form finding: | at the start")  # a form is found in one step


@dataclass
class Outcome:
    """Outcome of a run.

    Attributes
    ----------
    status : as of the command line; 1 for an unexpected exception
    message : of the failure
    warnings : of the run
    faults : of its termination: (cause, detail)
    stopped : step at which a stop was requested, -1 for none
    """

    status: int = 0
    message: str = ""
    warnings: list[str] = field(default_factory=list)
    faults: list[tuple[str, str]] = field(default_factory=list)
    stopped: int = -1
    seconds: float = 0.0


def case_text(table: dict[str, Any]) -> str:
    """The case file."""
    return table_text(table)


def run_case(
    text: str,
    comm: MPI.Comm,
    folder: Path,
    *,
    source: str = "random.toml",
    restart: bool = False,
    stop_after: int | None = None,
    jiggle: int = 0,
) -> Outcome:
    """Run the text of a case. Collective.

    Parameters
    ----------
    folder : of the results, the same on all ranks
    restart : continue what is there
    stop_after : the last rank receives SIGTERM after this step
    jiggle : number of a random change of the initial positions by 1e-13 of the truss's size; 0: none
    """
    outcome, screen = Outcome(), io.StringIO()
    begin = time.monotonic()
    with contextlib.redirect_stderr(screen), warnings.catch_warnings(record=True) as numeric:
        warnings.simplefilter("always")
        try:
            simulation = Simulation(
                Case.from_toml(text, source=source, name=Path(source).stem), comm, folder, restart or None, quiet=True
            )
            if jiggle:
                _jiggle(simulation, jiggle)
            if stop_after is None:
                simulation.run()
            else:
                _run_to(simulation, comm, stop_after, outcome)
        except EarlyStop as stop:
            outcome.status, outcome.message = 4, str(stop)
        except (InputError, SimulationFailure) as error:
            outcome.status, outcome.message = STATUS[type(error) if type(error) in STATUS else _kind(error)], str(error)
            outcome.faults += _unclear(outcome, source)
        except Exception as error:  # noqa: BLE001 - this is what is looked for
            outcome.status, outcome.message = 1, f"{type(error).__name__}: {error}"
            place = traceback.extract_tb(error.__traceback__)[-1]
            where = f"{Path(place.filename).name}:{place.lineno}"
            outcome.faults.append(("internal error", f"{outcome.message} ({where})"))
        _meet(comm, outcome)
    outcome.warnings = [line for line in screen.getvalue().splitlines() if line]
    for warning in numeric:
        if issubclass(warning.category, RuntimeWarning):
            place = f"{Path(warning.filename).name}:{warning.lineno}"
            outcome.faults.append(("numerical warning", f"{warning.message} ({place})"))
            break
    if "Traceback" in screen.getvalue():
        outcome.faults.append(("traceback on stderr", screen.getvalue()[-500:]))
    outcome.seconds = time.monotonic() - begin
    simulation = None
    return outcome


def run_in_two_parts(text: str, comm: MPI.Comm, folder: Path, middle: int, source: str = "random.toml") -> Outcome:
    """Run to a step, stop there on a signal, and continue from the checkpoint. Collective.

    The outcome is that of the second part, with the step at which the first one ended.
    """
    first = run_case(text, comm, folder, source=source, stop_after=middle)
    if first.status != 4:
        return first
    second = run_case(text, comm, folder, source=source, restart=True)
    second.stopped = first.stopped
    second.warnings = first.warnings + second.warnings
    return second


def _run_to(simulation: Simulation, comm: MPI.Comm, last: int, outcome: Outcome) -> None:
    try:
        for made in simulation:
            if made.step == last and comm.rank == comm.size - 1:
                os.kill(os.getpid(), signal.SIGTERM)
    except EarlyStop:
        outcome.stopped = simulation.state.step
        raise
    finally:
        simulation = None


def _jiggle(simulation: Simulation, number: int) -> None:
    """Move the nodes by 1e-13 of the truss's size without changing the stress-free lengths of bars."""
    state = simulation.stepper.state
    size = float(np.ptp(state.x, axis=0).max())
    change = 1e-13 * size * np.random.default_rng(number).uniform(-1.0, 1.0, state.x.shape)
    fixed = simulation.model.supports
    if fixed.any:
        change[fixed.nodes, fixed.components] = 0.0
    state.x += change
    simulation.stepper.before += change


def _kind(error: Exception) -> type:
    return InputError if isinstance(error, InputError) else SimulationFailure


def _unclear(outcome: Outcome, source: str) -> list[tuple[str, str]]:
    """Check that a refusal names the file, and a failure the step or the time."""
    if outcome.status == 2 and source not in outcome.message:
        return [("refusal does not name the file", outcome.message[:200])]
    if outcome.status == 3 and not _PLACE.search(outcome.message):
        return [("failure does not name the step", outcome.message[:200])]
    return []


def _meet(comm: MPI.Comm, outcome: Outcome) -> None:
    """Check that all ranks arrive with the same status; otherwise end the process and blame the case."""
    if comm.size == 1:
        return
    request = comm.Ibarrier()
    deadline = time.monotonic() + GRACE
    while not request.Test():
        if time.monotonic() > deadline:
            print(f"alone {comm.rank} {outcome.status} {outcome.message[:300]}", flush=True)
            comm.Abort(1)
        time.sleep(0.002)
    statuses = comm.allgather(outcome.status)
    if len(set(statuses)) > 1:
        outcome.faults.append(("ranks end differently", f"{statuses}: {outcome.message[:200]}"))


def steps_of(folder: Path) -> int:
    """Return the number of the last step of a result."""
    return int(open_result(folder).history["step"][-1])


def clear(comm: MPI.Comm, *folders: Path) -> None:
    """Remove folders, and PETSc and Python objects of earlier cases. Collective."""
    global _cleared
    _cleared += 1
    if _cleared % COLLECT == 0:
        # at the same case on all ranks: PETSc destroys collectively
        gc.collect()
        from petsc4py import PETSc

        if hasattr(PETSc, "garbage_cleanup"):
            PETSc.garbage_cleanup()
    comm.Barrier()
    if comm.rank == 0:
        for folder in folders:
            shutil.rmtree(folder, ignore_errors=True)

"""Runs the studies in worker processes, stores their results, and reads them back."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import shutil
import sys
import time
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pfem_petsc import Case, Simulation, open_result
from pfem_petsc.errors import PfemError
from pfem_petsc.output.result import Result

from .studies import Study

# Files that determine the numbers: results of older versions of these are not reused.
SOURCES = ("contact", "integrators", "mechanics", "mesh/generators", "solvers", "stepping", "simulation.py")


@dataclass
class Run:
    """A finished run.

    Attributes
    ----------
    history : column to array, one row a step
    failure : why it ended early, or was refused (then there is no history); empty when it reached its end
    folder : of its results
    h : time step [s]
    seconds : wall time
    """

    key: str
    history: dict[str, np.ndarray]
    failure: str
    folder: Path
    h: float
    seconds: float

    @property
    def time(self) -> np.ndarray:
        """(rows,) [s]."""
        return self.history["time"]

    @property
    def result(self) -> Result:
        """The result file, for snapshots."""
        return open_result(self.folder)


def _digest(study: Study) -> str:
    digest = hashlib.sha256(Case.load(study.case, list(study.overrides)).to_toml().encode())
    package = Path(sys.modules["pfem_petsc"].__file__).parent
    for name in SOURCES:
        path = package / name
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            digest.update(file.read_bytes())
    return digest.hexdigest()


def run_study(study: Study, folder: Path) -> tuple[str, str, float]:
    """Run one study into its folder; return its key, the reason of a failure (or nothing), and seconds."""
    digest, started = _digest(study), time.perf_counter()
    if folder.exists():
        shutil.rmtree(folder)
    failure = ""
    try:
        Simulation(Case.load(study.case, list(study.overrides)), output=folder, quiet=True).run()
    except PfemError as error:
        failure = str(error)
    seconds = time.perf_counter() - started
    folder.mkdir(parents=True, exist_ok=True)  # a refused case has made none
    outcome = {"digest": digest, "failure": failure, "seconds": seconds}
    (folder / "outcome.json").write_text(json.dumps(outcome, indent=1))
    return study.key, failure, seconds


def _is_current(study: Study, folder: Path) -> bool:
    outcome = folder / "outcome.json"
    return outcome.is_file() and json.loads(outcome.read_text())["digest"] == _digest(study)


def run_all(studies: Iterable[Study], root: Path, workers: int) -> None:
    """Run the studies without a current result under ``root`` in separate processes; report each on stdout."""
    missing = [study for study in studies if not _is_current(study, root / study.key)]
    if not missing:
        print("all results are there")
        return
    # MPI does not survive a fork, so workers are spawned
    with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        runs = [pool.submit(run_study, study, root / study.key) for study in missing]
        for number, run in enumerate(as_completed(runs), 1):
            key, failure, seconds = run.result()
            print(f"{number:3d}/{len(missing)}  {key:45s} {seconds:6.1f} s  {failure[:100]}", flush=True)


def read(key: str, root: Path) -> Run:
    """Read a run back.

    Raises
    ------
    FileNotFoundError
        If it has not been run.
    """
    folder = root / key
    outcome = json.loads((folder / "outcome.json").read_text())
    history: dict[str, np.ndarray] = {}
    h = 0.0
    if (folder / "result.vtkhdf").exists():
        result = open_result(folder)
        history = {name: result.history[name] for name in result.history}
        h = float(result.attributes["time_step"])
    return Run(key, history, outcome["failure"], folder, h, outcome["seconds"])

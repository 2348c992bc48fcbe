"""Several runs started into one folder at once: one works, the others are refused, and nothing is lost."""

from __future__ import annotations

import os
import random
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

from pfem_petsc.cli.main import main
from pfem_petsc.output.result import open_result

from .kills import differences

CASE = "rod_impact"
SHARED = ("mesh.elements=8", "time.step=0.02", "output.fields_every=100", "output.checkpoint_every=50")
FIRST, LATER = 1000, 1500  # steps of the runs, and of those that continue them
LONGEST = 0.4  # seconds between the first start and the last
REFUSED = "another run is writing into this folder"
CHANGED = "another run has overwritten this checkpoint"


def words(folder: Path, steps: int, *more: str) -> list[str]:
    """The command line of one run."""
    return [CASE, "-o", str(folder), "--quiet", *more, "--set", *SHARED, f"time.end={0.02 * steps}"]


def start_together(lines: list[list[str]], chance: random.Random) -> Counter:
    """Start all at nearly the same time and wait; return how many worked, were refused, and had another outcome.

    They are forks of this process, on one rank each, so that imports are already done.
    """
    found = Counter()
    with tempfile.TemporaryDirectory() as folder:
        pids = {}
        for number, line in enumerate(lines):
            delay, told = LONGEST * chance.random() ** 2, Path(folder, str(number))
            pids[_fork(lambda line=line, delay=delay: time.sleep(delay) or main(line), told)] = told
        for pid, told in pids.items():
            status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
            said = told.read_text()
            refused = status == 2 and (REFUSED in said or CHANGED in said) and said.count("error:") == 1
            found["worked" if status == 0 else "refused" if refused else f"{status}: {said}"] += 1
    return found


def _fork(function: Callable[[], int], told: Path) -> int:
    """Call a function in a forked process, whose status is its result; stderr goes to a file."""
    pid = os.fork()
    if pid:
        return pid
    status = 99
    try:
        os.dup2(os.open(told, os.O_CREAT | os.O_WRONLY), 2)
        status = function()
    finally:
        os._exit(status)


def play(folder: Path, reference: Path, chance: random.Random) -> tuple[Counter, Counter]:
    """Run one round in a new folder, three starts and then two restarts; return the outcomes.

    Raises
    ------
    AssertionError
        If data were lost, or differ from ``reference``, the result of a single run.
    """
    out = folder / "out"
    starts = start_together([words(out, FIRST) for _ in range(3)], chance)
    assert starts["worked"] + starts["refused"] == 3 and starts["worked"] >= 1, starts
    results = sorted(path.parent for path in folder.glob("out*/result.vtkhdf"))
    # one that came when another had ended has moved its results aside
    assert len(results) == starts["worked"], results
    for path in results:
        _assert_whole(path, FIRST)
    restarts = start_together([words(out, LATER, "--restart") for _ in range(2)], chance)
    assert restarts["worked"] + restarts["refused"] == 2 and restarts["worked"] >= 1, restarts
    _assert_whole(out, LATER)
    assert differences(out / "result.vtkhdf", reference) == {}
    left = [path for path in folder.rglob("*") if "lock" in path.name]
    assert left == [], left
    return starts, restarts


def _assert_whole(folder: Path, steps: int) -> None:
    with open_result(folder) as result:
        np.testing.assert_array_equal(result.history["step"], range(steps + 1))
        np.testing.assert_array_equal(result.steps, range(0, steps + 1, 100))

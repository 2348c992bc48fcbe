"""Several runs that are started into one folder at once: one works, the others say why, and nothing is lost."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
from kills import PATIENCE, command, differences, environment

from pfem_petsc.output.result import open_result

CASE = "rod_impact"
SHARED = ("mesh.elements=8", "time.step=0.02", "output.fields_every=100", "output.checkpoint_every=50")
FIRST, LATER = 1000, 1500  # steps of the runs, and of those that continue them
REFUSED = "another run is writing into this folder"
CHANGED = "another run has written this checkpoint anew"


def line(folder: Path, steps: int, *more: str, ranks: int = 1, python: str = sys.executable) -> list[str]:
    """The command of one run."""
    words = [CASE, "-o", folder, "--quiet", *more, "--set", *SHARED, f"time.end={0.02 * steps}"]
    return command(ranks, *words, python=python)


def start_together(lines: list[list[str]]) -> Counter:
    """Start all, wait for all; how many worked, were refused, and did something else."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    processes = [subprocess.Popen(line, env=environment(), **pipes) for line in lines]
    found = Counter()
    for process in processes:
        _, said = process.communicate(timeout=PATIENCE)
        refused = process.returncode == 2 and (REFUSED in said or CHANGED in said) and said.count("error:") == 1
        found["worked" if process.returncode == 0 else "refused" if refused else f"{process.returncode}: {said}"] += 1
    return found


def play(folder: Path, reference: Path, ranks: int = 1, python: str = sys.executable) -> tuple[Counter, Counter]:
    """One round in a new folder: three starts, then two restarts; what became of them.

    Raises
    ------
    AssertionError
        Something was lost, or differs from ``reference``, the result of a run that nobody disturbed.
    """
    out = folder / "out"
    starts = start_together([line(out, FIRST, ranks=ranks, python=python) for _ in range(3)])
    assert starts["worked"] + starts["refused"] == 3 and starts["worked"] >= 1, starts
    results = sorted(path.parent for path in folder.glob("out*/result.vtkhdf"))
    # one that came when another had ended has moved its results aside
    assert len(results) == starts["worked"], results
    for path in results:
        _assert_whole(path, FIRST)
    restarts = start_together([line(out, LATER, "--restart", ranks=ranks, python=python) for _ in range(2)])
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

"""The points of a study: one run of ``bench`` each, kept in a file of its own."""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Point:
    """So many bars on so many ranks; ``study`` is strong or weak, ``size`` in bars, whole or a rank."""

    study: str
    kind: str
    job: str
    integrator: str
    size: int
    ranks: int

    @property
    def bars(self) -> int:
        """Of the whole lattice, about."""
        return self.size * self.ranks if self.study == "weak" else self.size

    @property
    def file(self) -> str:
        """Name of its file; points of both studies with as many bars and ranks share one."""
        return f"{self.kind}_{self.job}_{self.integrator}_{self.bars}bars_{self.ranks}ranks.json"


def points_of(
    studies: list[str],
    kinds: list[str],
    jobs: list[str],
    sizes: dict[str, list[int]],
    ranks: list[int],
    names: Callable[[str], str],
) -> list[Point]:
    """All points, smallest first. ``names``: the integrator of a job."""
    found = [
        Point(study, kind, job, names(job), size, r)
        for study in studies
        for kind in kinds
        for job in jobs
        for size in sizes[study]
        for r in ranks
    ]
    return sorted(found, key=lambda p: (p.bars, p.ranks))


def run_point(point: Point, folder: Path, launcher: str, seconds: float, limit: float) -> str:
    """Run a point unless its file is there. Gives what happened: kept, done or a failure."""
    path = folder / point.file
    if path.exists():
        return "kept"
    part = path.with_suffix(".part")
    option = "--explicit" if point.job.startswith("explicit") else "--implicit"
    command = [
        *shlex.split(launcher.format(ranks=point.ranks)),
        *(sys.executable, "-m", "pfem_petsc", "bench", "--sizes", str(point.bars), "--kind", point.kind),
        *("--jobs", point.job, option, point.integrator, "--seconds", str(seconds), "-o", str(part)),
    ]
    path_of_package = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    # a group of its own: a launcher that is ended must take its ranks along
    process = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
        env={"OMP_NUM_THREADS": "1", **os.environ, "PYTHONPATH": path_of_package},
    )
    try:
        output, _ = process.communicate(timeout=limit)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        part.unlink(missing_ok=True)
        return f"failed: more than {limit:.0f} s"
    except BaseException:
        os.killpg(process.pid, signal.SIGTERM)
        part.unlink(missing_ok=True)
        raise
    if process.returncode != 0 or not part.exists() or part.stat().st_size == 0:
        part.unlink(missing_ok=True)
        return "failed: " + (output.strip().splitlines() or ["no message"])[-1]
    part.replace(path)
    return "done"


def read_point(point: Point, folder: Path) -> dict | None:
    """What ``bench`` wrote for a point, None where it has not run."""
    path = folder / point.file
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else None

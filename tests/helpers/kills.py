"""Runs that are killed at any time and restarted, runs at once in one folder, and comparison of their results."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np

from helpers.launch import environment
from pfem_petsc.cli.main import main
from pfem_petsc.output.result import open_result

PATIENCE = 600.0  # seconds that any single run may take, on a machine with other work


class Kind(NamedTuple):
    """A case with its overrides."""

    case: str
    overrides: tuple[str, ...]


IMPACT = ("mesh.elements=200", "time.step=0.001")
DROP = ("mesh.cells=[5,5,5]", "time.step=5e-7", "output.fields_every=20")
KINDS = {
    "explicit": Kind("rod_impact", (*IMPACT, "time.end=1.0", "output.fields_every=25")),
    "explicit contact, plastic": Kind("lattice_drop", (*DROP, "time.end=3e-4")),
    "explicit, snapshots beside the steps": Kind(
        "lattice_drop", ("mesh.cells=[10,10,10]", "time.step=5e-7", "time.end=3e-4", "output.fields_every=20")
    ),
    "bars that touch": Kind(
        "lattice_crush",
        ("mesh.cells=[2,2,2]", "wall.plate.point=[0,0,0.02025]", "time.end=2.65e-3", "output.fields_every=400"),
    ),
    "implicit contact": Kind(
        "rod_impact", ("time.integrator=newmark", "time.end=2.5", "mesh.elements=60", "output.fields_every=5")
    ),
    "multistep": Kind("pendulum", ("time.integrator=houbolt", "time.end=0.5", "time.step=1e-3")),
    "implicit, plastic, compressed": Kind(
        "bar_collision_plastic",
        ("time.integrator=wilson", "time.theta=1.5", "time.end=1.5e-4", "output.compression=gzip"),
    ),
}
"""One to a few seconds of steps each."""


def command(ranks: int, *words: str | Path, python: str = sys.executable) -> list[str]:
    """Of the program on so many ranks."""
    launcher = [] if ranks == 1 else ["mpirun", "-n", str(ranks)]
    return [*launcher, python, "-m", "pfem_petsc", *map(str, words)]


def words(kind: Kind, folder: Path, every: int, *more: str) -> list[str | Path]:
    """Command line of a case with a checkpoint every so many steps."""
    return [kind.case, "-o", folder, "--quiet", "--set", *kind.overrides, f"output.checkpoint_every={every}", *more]


def run(
    kind: Kind, ranks: int, folder: Path, every: int, *more: str, python: str = sys.executable
) -> subprocess.CompletedProcess:
    """Run to the end."""
    line = command(ranks, *words(kind, folder, every, *more), python=python)
    return subprocess.run(line, env=environment(), capture_output=True, text=True, timeout=PATIENCE)


def processes_of(process: subprocess.Popen, ranks: int) -> list[int]:
    """The ranks: the process itself, or the children of the launcher."""
    if ranks == 1:
        return [process.pid]
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if int(fields[1]) == process.pid:
                found.append(int(entry.name))
    return found


LEFT_OVER = ", and the launcher did not notice"
"""In one of a hundred kills mpirun of Open MPI 4 does not notice that a rank was killed; it is then killed too."""


def killed(
    kind: Kind,
    ranks: int,
    folder: Path,
    every: int,
    longest: float,
    chance: random.Random,
    *more: str,
    python: str = sys.executable,
) -> str:
    """Start a run and kill all its ranks, or one of them, at a random time; return when, or that it had finished."""
    process = subprocess.Popen(
        command(ranks, *words(kind, folder, every, *more), python=python),
        env=environment(),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        begin = time.monotonic()
        steps_only = chance.random() < 0.8
        log = folder / "log.txt"
        before = log.stat().st_mtime_ns if log.exists() else None
        # Most kills while steps are made, some while the model is set up.
        while steps_only and process.poll() is None and time.monotonic() - begin < PATIENCE:
            if log.exists() and log.stat().st_mtime_ns != before:
                break
            time.sleep(0.002)
        started = time.monotonic() - begin
        process_time = chance.uniform(0.0, longest)
        deadline = time.monotonic() + process_time
        while time.monotonic() < deadline and process.poll() is None:
            time.sleep(0.001)
        if process.poll() is not None:
            return "done before"
        pids = processes_of(process, ranks)
        for pid in pids if chance.random() < 0.5 else pids[:1]:
            os.kill(pid, signal.SIGKILL)
        how = f"killed {process_time:.3f} s after {'the first words' if steps_only else 'the start'} ({started:.2f} s)"
        try:
            process.wait(timeout=60.0)
        except subprocess.TimeoutExpired:
            how += LEFT_OVER
            for pid in pids:  # those that it has left have the folder's lock
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
        return how
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


VTK = """
import sys
from vtkmodules.vtkIOHDF import vtkHDFReader
for line in sys.stdin:
    reader, errors = vtkHDFReader(), []
    for source in (reader, reader.GetExecutive()):
        source.AddObserver("ErrorEvent", lambda *_: errors.append(1))
    reader.SetFileName(line.strip())
    reader.UpdateInformation()
    n = reader.GetNumberOfSteps()
    for i in sorted({0, n // 2, max(n - 1, 0)}):
        if n:
            reader.SetStep(i)
            reader.Update()
    print(n if not errors else -1, flush=True)
"""


class VtkReader:
    """The reader of VTK in a separate process, because an unreadable file may crash it."""

    def __enter__(self) -> VtkReader:
        self.process = subprocess.Popen(
            [sys.executable, "-c", VTK], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment()
        )
        return self

    def __exit__(self, *_: object) -> None:
        self.process.stdin.close()
        self.process.wait()
        self.process.stdout.close()

    def steps(self, path: Path) -> int:
        """Return the number of time steps in VTK, after reading the first, a middle and the last; -1 on errors."""
        self.process.stdin.write(f"{path}\n")
        self.process.stdin.flush()
        answer = self.process.stdout.readline()
        assert answer, f"VTK's reader ended on {path}"
        return int(answer)


def assert_readable(path: Path, vtk: VtkReader) -> int:
    """Open the file of a killed run with VTK and with the package; return the number of snapshots."""
    with open_result(path) as result:
        n = len(result.times)
        assert list(result.times) == sorted(set(result.times)), f"times {result.times}"
        steps = result.history["step"]
        assert len(np.unique(steps)) == len(steps), f"steps {steps}"
        for name in result.history:
            assert np.isfinite(np.asarray(result.history[name], dtype=float)).all(), name
        for i in range(n):
            assert np.isfinite(result.positions(i)).all(), i
    seen = vtk.steps(path)
    # some may be complete but for their times, which come last, and go first when a restart cuts them off
    assert n <= seen, f"{n} snapshots, VTK sees {seen}"
    return n


def differences(one: Path, other: Path) -> dict[str, float]:
    """Return the datasets of two results that are not bitwise identical, with the largest difference over the largest
    value (inf: of another shape, only in one, or no numbers)."""
    found = {}
    with h5py.File(one, "r", locking=False) as a, h5py.File(other, "r", locking=False) as b:
        for name in sorted({*_datasets(a), *_datasets(b)}):
            if name not in a or name not in b or a[name].shape != b[name].shape or a[name].dtype != b[name].dtype:
                found[name] = np.inf
                continue
            x, y = a[name][()], b[name][()]
            if a[name].dtype.kind not in "iufb":
                found |= {} if np.array_equal(x, y) else {name: np.inf}
            elif x.tobytes() != y.tobytes():
                scale = max(float(np.abs(x).max()), np.finfo(float).tiny)
                found[name] = float(np.abs(x - y).max()) / scale
    return found


def _datasets(file: h5py.File) -> list[str]:
    names: list[str] = []
    file.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
    return [name for name in names if name != "case/text"]


CASE = "rod_impact"
SHARED = ("mesh.elements=8", "time.step=0.02", "output.fields_every=100", "output.checkpoint_every=50")
FIRST, LATER = 1000, 1500  # steps of the runs, and of those that continue them
LONGEST = 0.4  # seconds between the first start and the last
REFUSED = "another run is writing into this folder"
CHANGED = "another run has overwritten this checkpoint"


def shared_words(folder: Path, steps: int, *more: str) -> list[str]:
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
    starts = start_together([shared_words(out, FIRST) for _ in range(3)], chance)
    assert starts["worked"] + starts["refused"] == 3 and starts["worked"] >= 1, starts
    results = sorted(path.parent for path in folder.glob("out*/result.vtkhdf"))
    # one that came when another had ended has moved its results aside
    assert len(results) == starts["worked"], results
    for path in results:
        _assert_whole(path, FIRST)
    restarts = start_together([shared_words(out, LATER, "--restart") for _ in range(2)], chance)
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


def damaged(file: Path, chance: random.Random) -> str:
    """Change a bit, a byte or a page of a file, and return a description of it."""
    content = bytearray(file.read_bytes())
    kind, at = chance.choice(["bit", "byte", "page"]), chance.randrange(len(content))
    if kind == "bit":
        content[at] ^= 1 << chance.randrange(8)
    elif kind == "byte":
        content[at] = (content[at] + chance.randrange(1, 256)) % 256
    else:
        at -= at % 4096
        size = len(content[at : at + 4096])
        content[at : at + 4096] = bytes(size) if chance.random() < 0.5 else chance.randbytes(size)
    file.write_bytes(content)
    return f"{kind} at {at}"

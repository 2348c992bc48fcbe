"""Times and memory of the steps of jobs, blocks of cubic, octet or body-centred cells that fly or hit a floor, and the
memory bandwidth of this machine; tables and JSON of both."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import io
import json
import math
import os
import platform
import re
import shutil
import tempfile
import timeit
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from statistics import median
from time import perf_counter, process_time, sleep
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    from mpi4py import MPI

    from .case.schema import Case


YOUNG_MODULUS = 110e9  # [Pa] titanium
DENSITY = 4500.0  # [kg/m3]
AREA = 1e-6  # [m2]
PITCH = 0.01  # [m]
YIELD_STRESS = 200e6  # [Pa]
HARDENING = 1e9  # [Pa]
WAVE_SPEED = math.sqrt(YOUNG_MODULUS / DENSITY)  # [m/s]
CROSSING = PITCH / WAVE_SPEED  # [s] of a wave along the edge of a cell
SPEED = 20.0  # [m/s] of the impact, and of the corners of a lattice that spins

KINDS = {
    "cubic": lambda n: 3 * n * (n + 1) * (3 * n + 1),
    "octet": lambda n: 12 * n * n * (n + 1) + 12 * n**3,
    "bcc": lambda n: 3 * n * (n + 1) ** 2 + 8 * n**3,
}
"""Bars of n x n x n cells."""

JOBS: dict[str, dict[str, Any]] = {
    "explicit": {"step": 0.1 * CROSSING},
    # short steps: thousands of them before the lattice leaves the floor
    "explicit_contact": {"step": 0.02 * CROSSING, "contact": True},
    "matrix_free": {"step": 2.0 * CROSSING, "operator": "matrix_free", "linear": "cg"},
    "assembled": {"step": 2.0 * CROSSING, "operator": "assembled", "linear": "cg"},
    "implicit_contact": {"step": 2.0 * CROSSING, "operator": "matrix_free", "contact": True},
}
"""The measurements by name, as attributes of :class:`Job`."""


@dataclass(frozen=True)
class Job:
    """A measurement.

    Attributes
    ----------
    name : in the tables
    integrator : name of a time integration scheme
    step : time step [s]
    operator : of an implicit scheme: ``matrix_free`` or ``assembled``
    linear : linear solver of an implicit scheme
    contact : the foot of the lattice presses on a floor in every step; else the lattice flies and spins
    plastic : bars can yield
    mass : ``lumped`` or ``consistent``
    history_every : steps between rows of the history
    """

    name: str
    integrator: str
    step: float
    operator: str = "auto"
    linear: str = "auto"
    contact: bool = False
    plastic: bool = False
    mass: str = "lumped"
    history_every: int = 1


def jobs(
    names: list[str], explicit: str, implicit: str, mass: str, plastic: bool | None, history_every: int
) -> list[Job]:
    """Return the jobs of these names.

    Parameters
    ----------
    names : of :data:`JOBS`
    explicit, implicit : integrators
    mass : ``lumped`` or ``consistent``
    plastic : whether bars can yield; None: in the explicit impact only
    history_every : steps between rows of the history
    """
    return [
        Job(
            name,
            explicit if name.startswith("explicit") else implicit,
            plastic=name == "explicit_contact" if plastic is None else plastic,
            mass=mass,
            history_every=history_every,
            **JOBS[name],
        )
        for name in names
    ]


def tiny_jobs(explicit: str) -> list[Job]:
    """Return jobs with so few bars that the measured time is the cost of a step outside the loops over bars."""
    step = 0.02 * CROSSING
    return [
        Job("tiny", explicit, step),
        Job("tiny, history every 10", explicit, step, history_every=10),
        Job("tiny, contact", explicit, 0.1 * step, contact=True),
    ]


def cells_for(kind: str, bars: int) -> int:
    """Return the cells along an edge of the lattice whose number of bars is nearest to ``bars``."""
    most = 2 + math.ceil(bars ** (1.0 / 3.0))  # every kind has more than n^3 bars
    return min(range(1, most), key=lambda n: abs(KINDS[kind](n) - bars))


def make_case(job: Job, kind: str, cells: int, steps: int) -> Case:
    """Return the case of a job on a lattice, with ``steps`` steps and a history but no fields."""
    from .case.schema import Case

    material: dict[str, Any] = {"young_modulus": YOUNG_MODULUS, "density": DENSITY}
    if job.plastic:
        material |= {"yield_stress": YIELD_STRESS, "isotropic_hardening": HARDENING}
    table: dict[str, Any] = {
        "title": f"{job.name}: {kind} lattice of {KINDS[kind](cells):,} bars",
        "mesh": {"generator": "lattice", "kind": kind, "cells": [cells, cells, cells], "pitch": PITCH},
        "material": {"strut": material},
        "section": {"strut": {"area": AREA, "material": "strut"}},
        "time": {"integrator": job.integrator, "step": job.step, "end": steps * job.step, "mass": job.mass},
        "output": {"fields_every": 0, "fields": [], "history_every": job.history_every},
        "solver": {"operator": job.operator, "linear": job.linear},
    }
    if job.contact:
        table["initial"] = {"velocity": [0.0, 0.0, -SPEED]}
        table["wall"] = [{"name": "floor", "type": "plane", "point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}]
    else:
        # a spin with the same speed at the corners, which strains and rotates bars
        table["initial"] = {"angular_velocity": [2.0 * SPEED / (cells * PITCH), 0.0, 0.0]}
    return Case.from_dict(table, source="bench", folder=Path.cwd())


_FEWEST = 4  # minimum number of timed steps, even if each takes longer than the given time


class PeakMemory:
    """Measures the growth of the resident memory of this process (Linux) from its creation."""

    def __init__(self) -> None:
        gc.collect()
        # return freed memory to the system, so that earlier use does not hide later growth
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None).malloc_trim(0)
        # reset the kernel's peak; if that is not permitted, the peak since the start of the process counts
        with contextlib.suppress(OSError):
            Path("/proc/self/clear_refs").write_text("5")
        self.base = self._status("VmRSS")

    def growth(self) -> float:
        """Return the peak resident memory since the start minus that at the start [B]."""
        return max(self._status("VmHWM") - self.base, 0.0)

    def _status(self, name: str) -> float:
        """Return a value of /proc/self/status [B]."""
        found = re.search(rf"^{name}:\s*(\d+) kB", Path("/proc/self/status").read_text(), re.MULTILINE)
        return 1024.0 * float(found[1])


@dataclass(frozen=True)
class Record:
    """Measurements of a job on a lattice. Times in seconds, over steps after the first; memory in bytes.

    Attributes
    ----------
    median, best : of a step, wall clock on rank 0
    cpu : processor time of a step, all ranks together
    setup, first : wall clock of the set-up, and from there to the end of the first step (with output opened)
    newton, linear : mean number of iterations of a step
    memory : maximum growth of resident memory, all ranks together
    ghosts, neighbours : maximum number of ghosts, and of neighbouring ranks, over all ranks
    evaluated : bars evaluated on all ranks together; those between two ranks are evaluated on both
    """

    job: str
    kind: str
    bars: int
    nodes: int
    ranks: int
    steps: int
    median: float
    best: float
    cpu: float
    setup: float
    first: float
    newton: float
    linear: float
    memory: float
    ghosts: int
    neighbours: int
    evaluated: int
    solver: str

    @property
    def rate(self) -> float:
        """Bar updates per second: bars over the median step."""
        return self.bars / self.median


def time_job(job: Job, kind: str, cells: int, comm: MPI.Comm, seconds: float, most: int = 100_000) -> Record:
    """Run a job for about ``seconds``, at most ``most`` steps. Collective."""
    from .simulation import Simulation

    # the foot stays on the floor until the elastic wave has run to the far side and back
    lasting = int(2.0 * cells * CROSSING / job.step) if job.contact else most
    case = make_case(job, kind, cells, max(min(most, lasting), _FEWEST + 2))
    folder = comm.bcast(tempfile.mkdtemp(prefix="pfem_bench_") if comm.rank == 0 else None)
    memory = PeakMemory()
    try:
        start = perf_counter()
        simulation = Simulation(case, comm, output=folder, quiet=True)
        ready = perf_counter()
        times, newton, linear, count = [], 0, 0, None
        running = simulation.batches()  # as in a long run
        next(running)
        first = perf_counter() - ready
        last = next(running).step  # loads the loop of steps
        before, cpu_before = perf_counter(), process_time()
        for step in running:
            now = perf_counter()
            made, last = step.step - last, step.step
            times += [(now - before) / made] * made
            newton += step.newton
            linear += step.linear
            if count is None and len(times) >= 2:  # the same on all ranks
                count = comm.bcast(max(int(seconds / max(min(times), 1e-9)), _FEWEST))
            if count is not None and len(times) >= count:
                break
            before = perf_counter()
        cpu = (process_time() - cpu_before) / len(times)
        running.close()
        grown = comm.allreduce(memory.growth())
        plan, mesh = simulation.plan, simulation.mesh
        if hasattr(simulation.stepper, "destroy"):
            simulation.stepper.destroy()
    finally:
        comm.Barrier()
        if comm.rank == 0:
            shutil.rmtree(folder, ignore_errors=True)
    return Record(
        job=job.name,
        kind=kind,
        bars=KINDS[kind](cells),
        nodes=mesh.n_nodes,
        ranks=comm.size,
        steps=len(times),
        median=comm.bcast(median(times)),
        best=comm.bcast(min(times)),
        cpu=comm.allreduce(cpu),
        setup=comm.bcast(ready - start),
        first=comm.bcast(first),
        newton=newton / len(times),
        linear=linear / len(times),
        memory=grown,
        ghosts=max(comm.allgather(mesh.n_local - mesh.n_owned)),
        neighbours=max(comm.allgather(mesh.n_neighbours)),
        evaluated=comm.allreduce(len(mesh.bars)),
        solver=plan.linear.why if plan.linear is not None else "none",
    )


PATIENCE = 1.0
"""Seconds of compilations for a piece of the work up to which nothing is said."""


def compile_loops(jobs: list[Job], kind: str, explicit: str, comm: MPI.Comm) -> None:
    """Make a few steps of each job on a lattice of a ``kind``, and ``explicit`` steps of each law. The ranks of a
    machine share them: each takes the next one when it is ready, and says what takes long. Collective."""
    from mpi4py import MPI

    from .mechanics.compiled import Compilation
    from .mechanics.materials.base import LAWS
    from .registry import choices

    tiny = tiny_jobs(explicit)[0]
    work: dict[str, Callable[[], Any]] = {
        **{job.name: partial(time_job, job, kind, 2, MPI.COMM_SELF, 0.0) for job in jobs},
        tiny.name: partial(time_job, tiny, "cubic", 2, MPI.COMM_SELF, 0.0, 3000),
        **{f"law {name}": partial(_run, name, explicit) for name in choices(LAWS)},
    }
    machine = comm.Split_type(MPI.COMM_TYPE_SHARED)
    begin = perf_counter()
    with tempfile.TemporaryDirectory(prefix="pfem_compile_") as own:
        taken = Path(machine.bcast(own))
        for k, (name, make) in enumerate(work.items()):
            with contextlib.suppress(FileExistsError):  # another rank has taken it
                (taken / str(k)).touch(exist_ok=False)
                place = f"{name}, {k + 1} of {len(work)}"
                with Compilation(partial(_tell, place, begin), lambda seconds: None, PATIENCE):
                    make()
        comm.Barrier()
    machine.Free()
    if comm.size > 1:
        with Compilation(partial(_tell, f"{comm.size} ranks", begin), lambda seconds: None, PATIENCE):
            time_job(jobs[0], kind, 2, comm, 0.0)


def _tell(place: str, begin: float, loop: str, seconds: float) -> None:
    """Say which loop is being compiled for a piece of the work, and for how long all of it has lasted."""
    from .output.units import duration

    print(f"compiling loops: {place}: {loop}, {duration(perf_counter() - begin)} so far", flush=True)


def law_case(name: str, explicit: str) -> Case:
    """Return a case with a law, on a floor; keys that the law needs are 1 in SI units, which all laws accept."""
    from .case.schema import Case
    from .mechanics.materials.base import LAWS
    from .registry import lookup

    material: dict[str, Any] = {"law": name, "young_modulus": YOUNG_MODULUS, "density": DENSITY}
    for key, field in lookup(LAWS, name, "").Parameters.model_fields.items():
        if field.is_required() and key not in material:
            material[key] = 1.0 if field.annotation is float else [[1.0 / YOUNG_MODULUS, 1.0]]
    table = {
        "mesh": {"generator": "lattice", "kind": "cubic", "cells": [2, 2, 2], "pitch": 1.0},
        "material": {"it": material},
        "section": {"all": {"area": 1e-4, "shape": "round", "material": "it"}},
        "initial": {"velocity": [0.0, 0.0, -1.0]},
        "wall": [{"name": "floor", "type": "plane", "point": [0.0, 0.0, -1.0], "normal": [0.0, 0.0, 1.0]}],
        "time": {"integrator": explicit, "step": 1e-6, "end": 2e-6},
    }
    return Case.from_dict(table, source=name)


def _run(law: str, explicit: str) -> None:
    from mpi4py import MPI

    from .simulation import Simulation

    told = io.StringIO()  # warnings about values that nobody means
    with tempfile.TemporaryDirectory(prefix="pfem_compile_") as folder, contextlib.redirect_stderr(told):
        Simulation(law_case(law, explicit), MPI.COMM_SELF, output=folder, quiet=True).run()


BYTES_PER_ELEMENT = 24
"""As STREAM counts: two reads and a write of 8 B. Cache lines read before they are overwritten are not counted."""

_ELEMENTS = 8_000_000  # 64 MB per array and process, larger than the share of a core in any current cache


def _triad(a: np.ndarray, b: np.ndarray, c: np.ndarray, scalar: float) -> None:
    for i in range(len(a)):
        a[i] = b[i] + scalar * c[i]


def measure_bandwidth(comm: MPI.Comm, repeats: int = 10) -> dict[str, float]:
    """Return the STREAM triad [B/s], best of several, of one process alone and of all ranks together, and their ratio,
    the maximum speed-up of memory-bound work. Collective; the other ranks sleep while one is measured."""
    import numpy as np

    from .mechanics.compiled import kernel

    loop = kernel(_triad)
    a, b, c = np.zeros(_ELEMENTS), np.full(_ELEMENTS, 1.0), np.full(_ELEMENTS, 2.0)
    size = BYTES_PER_ELEMENT * _ELEMENTS

    triad = partial(loop, a, b, c, 3.0)
    triad()  # compile, and touch every page
    alone = size / min(timeit.repeat(triad, number=1, repeat=repeats)) if comm.rank == 0 else 0.0
    waiting = comm.Ibarrier()
    while not waiting.Test():
        sleep(0.01)
    alone = together = comm.bcast(alone)
    if comm.size > 1:
        # the slowest of a round, because all share the memory until it has finished
        slowest = np.max(comm.allgather(timeit.repeat(triad, comm.Barrier, number=1, repeat=repeats)), axis=0)
        together = comm.size * size / float(slowest.min())
    return {"alone": alone, "together": together, "ratio": together / alone, "bytes_per_element": BYTES_PER_ELEMENT}


def processor() -> str:
    """Return the name of the processor."""
    with contextlib.suppress(OSError):
        if found := re.search(r"^model name\s*:(.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE):
            return found[1].strip()
    return platform.processor() or platform.machine()


_FORMAT = "{:18} {:>11} {:>9} {:>9} {:>9} {:>8} {:>6} {:>7} {:>6} {:>6}"
_NAMES = ("job", "bars", "step ms", "best ms", "cpu ms", "bars/s", "memory", "newton", "setup", "first")
_UNITS = ("", "", "median", "", "", "", "B/bar", "/cg", "s", "step s")
HEADER = f"{_FORMAT.format(*_NAMES)}\n{_FORMAT.format(*_UNITS)}"
"""Two lines over the table."""


def line(record: Record) -> str:
    """Return a row of the table."""
    return _FORMAT.format(
        record.job,
        f"{record.bars:,}",
        f"{1e3 * record.median:.4g}",
        f"{1e3 * record.best:.4g}",
        f"{1e3 * record.cpu:.4g}",
        f"{record.rate:.3g}",
        f"{record.memory / record.bars:.0f}",
        f"{record.newton:.1f}/{record.linear:.0f}" if record.newton or record.linear else "-",
        f"{record.setup:.2f}",
        f"{record.first:.2f}",
    )


def machine_lines(bandwidth: dict[str, float], ranks: int) -> str:
    """Describe the bandwidth."""
    text = f"STREAM triad ({BYTES_PER_ELEMENT} B an element): one process {bandwidth['alone'] / 1e9:.1f} GB/s"
    if ranks > 1:
        text += f", {ranks} at once {bandwidth['together'] / 1e9:.1f} GB/s ({bandwidth['ratio']:.2f} x)"
    return text + "\n"


def memory_slopes(records: list[Record]) -> dict[str, float]:
    """Return bytes per bar from the two largest sizes of each job with at least two sizes."""
    slopes = {}
    for name in dict.fromkeys(record.job for record in records):
        *_, less, more = [None, None, *sorted((r for r in records if r.job == name), key=lambda r: r.bars)]
        if less is not None and more.bars > less.bars:
            slopes[name] = (more.memory - less.memory) / (more.bars - less.bars)
    return slopes


def document(comm: MPI.Comm, bandwidth: dict[str, float], records: list[Record], tiny: list[Record]) -> str:
    """Return all measurements as JSON."""
    from .output.layout import describe_run

    content: dict[str, Any] = {
        "machine": {"processor": processor(), "cores": os.cpu_count(), "system": platform.platform()},
        "program": describe_run(comm, {}),
        "ranks": comm.size,
        "bandwidth": bandwidth,
        "runs": [asdict(record) | {"bars_per_second": record.rate} for record in records],
        "memory_slopes": memory_slopes(records),
        "overhead": [asdict(record) for record in tiny],
    }
    return json.dumps(content, indent=1) + "\n"

"""Times and memory of the steps of a job, and the memory traffic that bounds them.

The bytes of a step are those that the loops move if they find nodes in the cache while they process their bars. As in
STREAM, an array that is overwritten counts as written only. Arrays are float64 (8 B), ends of bars 32-bit; where bars
go by runs of constant offset, their ends are not read.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import gc
import re
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from time import perf_counter, process_time
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..parallel.petsc_log import OF_BALANCE, OF_FORCE, OF_PRODUCT
from .cases import CROSSING, KINDS, Job, make_case
from .machine import Bandwidth

if TYPE_CHECKING:
    from mpi4py import MPI

    from ..mechanics.bars import Bars

_FEWEST = 4  # minimum number of timed steps, even if each takes longer than the given time
_VECTOR = 24  # B per node: three components

ASSUMED = {
    "bar in a run": 8,  # rest length 8
    "other bar": 12,  # and the far end 4
    "plastic bar": 16,  # plastic and accumulated plastic strain
    "explicit node": 4 * _VECTOR + 8,  # x, v read and written; mass read
    "kept force": 2 * _VECTOR,  # f written and read
    "node of a row": 2 * _VECTOR,  # velocity and acceleration written
    "residual node": 4 * _VECTOR + 8,  # increment, predictor, known terms read, residual written; mass read
    "linearised bar": 16,  # two stiffnesses
    "ends of a linearised bar": 8,
    "product node": _VECTOR,  # positions, from which bars have their directions
    "matrix entry": 12,  # value 8, column 4
    "conjugate gradients node": 12 * _VECTOR,  # x, r, p read and written; A p, z written and read; r . z; diagonal
}
"""Bytes per item."""

OPERATIONS = {
    "bar": OF_FORCE,
    "plastic bar": 12,  # trial stress, yield function, return
    "explicit node": OF_BALANCE + 6 + 6 + 6,  # balance; position, velocity, work of the internal forces
    "residual node": 15,
    "linearised bar": 20,
    "product": OF_PRODUCT,
    "matrix entry": 2,
    "conjugate gradients node": 36,  # three sums of vectors, two products, the diagonal
}
"""Floating-point operations per item, of linear elastic bars."""

PARTS = {
    "mesh": "mesh",
    "state": "state",
    "bars": "model.bars",
    "model": "model",
    "stepper": "stepper",
    "output": "outputs",
}
"""Part to the object of a simulation that makes it up; an array that several hold belongs to the first part."""


class Work(NamedTuple):
    """What a step does.

    Attributes
    ----------
    bars, nodes : of the whole mesh
    implicit, assembled, plastic : kind of the step
    newton, linear : iterations of an implicit step
    runs : share of the bars that go by runs of constant offset
    rows : rows of the history a step
    """

    bars: int
    nodes: int
    implicit: bool = False
    assembled: bool = False
    plastic: bool = False
    newton: float = 0.0
    linear: float = 0.0
    runs: float = 0.0
    rows: float = 0.0

    @property
    def entries(self) -> int:
        """Entries of an assembled matrix."""
        return 9 * (self.nodes + 2 * self.bars)

    def bytes(self) -> float:
        """Return the number of bytes that a step moves, over all ranks."""
        size, bars, nodes = ASSUMED, self.bars, self.nodes
        far = (1.0 - self.runs) * (size["other bar"] - size["bar in a run"])
        bar = size["bar in a run"] + far + self.plastic * size["plastic bar"]
        # forces that no row reads stay in the cache, if all bars go by runs and keep nothing
        unread = self.runs == 1.0 and not self.plastic and not self.implicit
        node = size["explicit node"] + self.rows * size["node of a row"]
        node += size["kept force"] * (self.rows if unread else 1.0)
        if self.assembled:
            matrix = self.entries * size["matrix entry"]
            update = bars * (bar + 16) + 8 * self.entries  # indices of a bar's four blocks, and their values
        else:
            matrix = bars * (far + size["linearised bar"]) + nodes * size["product node"]
            update = bars * (bar + size["ends of a linearised bar"] + size["linearised bar"])
        solves = self._solves(
            bars * bar + nodes * size["residual node"], update, matrix + nodes * size["conjugate gradients node"]
        )
        return float(bars * bar + nodes * node + solves)

    def operations(self) -> float:
        """Return the number of floating-point operations of a step, over all ranks."""
        size, bars, nodes = OPERATIONS, self.bars, self.nodes
        forces = bars * (size["bar"] + self.plastic * size["plastic bar"])
        product = self.entries * size["matrix entry"] if self.assembled else bars * size["product"]
        solves = self._solves(
            forces + nodes * size["residual node"],
            bars * size["linearised bar"],
            product + nodes * size["conjugate gradients node"],
        )
        return float(forces + nodes * size["explicit node"] + solves)

    def _solves(self, evaluation: float, update: float, iteration: float) -> float:
        """Of an implicit step: residuals, updates of the Hessian, and iterations of conjugate gradients."""
        if not self.implicit:
            return 0.0
        return (self.newton + 1.0) * evaluation + self.newton * update + self.linear * iteration


def share_in_runs(bars: Bars) -> float:
    """Return the share of this rank's bars that go by runs of constant offset."""
    here = 0
    for block in bars.blocks:
        sweep = block.sweep
        firsts = sweep.bars if hasattr(sweep, "bars") else sweep.starts[sweep.chunks[:-1]]
        sizes = np.diff(np.append(firsts, block.stop).astype(np.int64))
        here += int(sizes[sweep.diagonal].sum())
    return here / max(len(bars.ends), 1)


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


def held_by_parts(simulation: Any) -> dict[str, float]:
    """Return part to the bytes of its arrays on this rank; those of PETSc are not among them.

    Counted are the arrays with memory of their own that an object holds, directly or through others, each once.
    """
    seen: set[int] = set()
    found = dict.fromkeys(PARTS, 0.0)
    for part, path in PARTS.items():
        waiting = [functools.reduce(lambda held, name: getattr(held, name, None), path.split("."), simulation)]
        while waiting:
            held = waiting.pop()
            while isinstance(held, np.ndarray) and isinstance(held.base, np.ndarray):
                held = held.base
            if id(held) in seen:
                continue
            seen.add(id(held))
            if isinstance(held, np.ndarray):
                found[part] += held.nbytes if held.base is None else 0.0
            elif isinstance(held, dict):
                waiting += held.values()
            elif isinstance(held, list | tuple | set):
                waiting += held
            elif type(held).__module__.startswith("pfem_petsc") and not isinstance(held, type):
                waiting += getattr(held, "__dict__", {}).values()
    return found


@dataclass(frozen=True)
class Record:
    """Measurements of a job on a lattice. Times in seconds, over steps after the first; memory in bytes.

    Attributes
    ----------
    median, best : of a step, wall clock on rank 0
    cpu : processor time of a step, all ranks together
    setup, first : wall clock of the set-up, and from there to the end of the first step (with output opened)
    newton, linear : mean number of iterations of a step
    traffic : number of bytes that a step moves
    share : percent of the bandwidth of all ranks that this traffic needs at the median
    memory : maximum growth of resident memory, all ranks together
    held : bytes of the arrays that each part of the simulation holds at the end, all ranks together
    operations : floating-point operations of a step
    runs : share of the bars that go by runs of constant offset
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
    traffic: float
    share: float
    memory: float
    held: dict[str, float]
    operations: float
    runs: float
    ghosts: int
    neighbours: int
    evaluated: int
    solver: str

    @property
    def rate(self) -> float:
        """Bar updates per second: bars over the median step."""
        return self.bars / self.median


def time_job(
    job: Job, kind: str, cells: int, comm: MPI.Comm, bandwidth: Bandwidth | None, seconds: float, most: int = 100_000
) -> Record:
    """Run a job for about ``seconds``, at most ``most`` steps. Collective."""
    from ..simulation import Simulation

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
        last = next(running).step  # loads the loop of batches
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
        held = {part: comm.allreduce(size) for part, size in held_by_parts(simulation).items()}
        plan, mesh = simulation.plan, simulation.mesh
        if hasattr(simulation.stepper, "destroy"):
            simulation.stepper.destroy()
    finally:
        comm.Barrier()
        if comm.rank == 0:
            shutil.rmtree(folder, ignore_errors=True)
    middle = comm.bcast(median(times))
    implicit = plan.linear is not None
    work = Work(
        mesh.n_bars,
        mesh.n_nodes,
        implicit=implicit,
        assembled=implicit and not plan.linear.matrix_free,
        plastic=job.plastic,
        newton=newton / len(times),
        linear=linear / len(times),
        runs=comm.allreduce(share_in_runs(simulation.model.bars)) / comm.size,
        rows=1.0 / job.history_every,
    )
    return Record(
        job=job.name,
        kind=kind,
        bars=KINDS[kind](cells),
        nodes=mesh.n_nodes,
        ranks=comm.size,
        steps=len(times),
        median=middle,
        best=comm.bcast(min(times)),
        cpu=comm.allreduce(cpu),
        setup=comm.bcast(ready - start),
        first=comm.bcast(first),
        newton=work.newton,
        linear=work.linear,
        traffic=work.bytes(),
        share=100.0 * work.bytes() / bandwidth.together / middle if bandwidth else 0.0,
        memory=grown,
        held=held,
        operations=work.operations(),
        runs=work.runs,
        ghosts=max(comm.allgather(mesh.n_local - mesh.n_owned)),
        neighbours=max(comm.allgather(mesh.n_neighbours)),
        evaluated=comm.allreduce(len(mesh.bars)),
        solver=plan.linear.why if implicit else "none",
    )

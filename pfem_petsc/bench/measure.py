"""Times the steps of a job on a lattice through the public interface."""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import dataclass
from statistics import median
from time import perf_counter, process_time
from typing import TYPE_CHECKING

from .bandwidth import Bandwidth
from .cases import PITCH, WAVE_SPEED, Job, bars_of, make_case
from .holdings import held_by_parts
from .memory import PeakMemory
from .traffic import Work, bytes_per_step, operations_per_step, share_in_runs

if TYPE_CHECKING:
    from mpi4py import MPI

__all__ = ["Record", "time_job"]

_FEWEST = 4  # minimum number of timed steps, even if each takes longer than the given time


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
    lasting = int(2.0 * cells * PITCH / WAVE_SPEED / job.step) if job.contact else most
    steps = max(min(most, lasting), _FEWEST + 2)
    case = make_case(job, kind, cells, steps)
    folder = comm.bcast(tempfile.mkdtemp(prefix="pfem_bench_") if comm.rank == 0 else None)
    memory = PeakMemory()
    try:
        start = perf_counter()
        simulation = Simulation(case, comm, output=folder, quiet=True)
        ready = perf_counter()
        times, cpu, newton, linear = [], 0.0, 0, 0
        count = None
        running = simulation.batches(min_steps=1)  # as in a long run
        next(running)
        first = perf_counter() - ready
        last = next(running).step  # loads the fused loop
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
    middle = median(times)
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
    traffic = bytes_per_step(work)
    return Record(
        job=job.name,
        kind=kind,
        bars=bars_of(kind, cells),
        nodes=mesh.n_nodes,
        ranks=comm.size,
        steps=len(times),
        median=comm.bcast(middle),
        best=comm.bcast(min(times)),
        cpu=comm.allreduce(cpu),
        setup=comm.bcast(ready - start),
        first=comm.bcast(first),
        newton=newton / len(times),
        linear=linear / len(times),
        traffic=traffic,
        share=100.0 * traffic / bandwidth.together / comm.bcast(middle) if bandwidth else 0.0,
        memory=grown,
        held=held,
        operations=operations_per_step(work),
        runs=work.runs,
        ghosts=max(comm.allgather(mesh.n_local - mesh.n_owned)),
        neighbours=max(comm.allgather(mesh.n_neighbours)),
        evaluated=comm.allreduce(len(mesh.bars)),
        solver=plan.linear.why if plan.linear is not None else "none",
    )

"""Summary before a run, and estimates of its memory, time and disk space."""

from __future__ import annotations

import resource
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..files import memory_of_machine
from ..output.units import duration, engineering

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..fields import Fields
    from ..mesh.distribution import DistributedMesh
    from ..stepping.model import Model
    from ..stepping.plan import Plan

# Resident memory of a rank per bar, in excess of an empty process [B]; measured with lattices: 54 explicit, 74 if bars
# yield on a floor, 170 matrix-free (between 10^6 and 4 x 10^6 bars), 510 assembled, 1580 with GAMG (10^5 to 5 x 10^5);
# factorised by MUMPS 4,200 at 2.7 x 10^4 and 8,200 at 1.7 x 10^5 bars.
_PER_BAR = {
    "": 80.0,
    "jacobi": 200.0,
    "multigrid": 350.0,
    "pbjacobi": 550.0,
    "icc": 800.0,
    "ilu": 800.0,
    "gamg": 1700.0,
}
_PER_BAR_FACTORISED, _FACTORISED_AT = 4200.0, 2.7e4
_EMPTY = 2.2e8  # of a process with all libraries loaded [B]
# Seconds per bar and step or iteration on one core, and additional seconds per step.
_SECONDS_EXPLICIT = 1.5e-8
_SECONDS_PER_ITERATION = 4e-8
_SECONDS_PER_STEP = 2.5e-4

_THICK = 0.3
"""Relative density above which struts are no lattice of slender bars (Gibson and Ashby, Cellular Solids, 1997)."""


def forecast(
    case: Case,
    model: Model,
    plan: Plan,
    fields: Fields,
    columns: Mapping[str, np.dtype],
) -> dict[str, str]:
    """Return label and text of the estimates of memory and, if the steps are known, of time and disk. Collective."""
    plans = plan.stages or (plan,)
    held = model.comm.allreduce(max(_needed(model, each) for each in plans))
    entries = {"memory needed": f"about {engineering(held, 'B', 3)} by the end of the run, on all ranks"}
    known = [(stage, each) for stage, each in zip(case.stages, plans, strict=True) if each.steps is not None]
    if known:
        seconds = sum(_seconds(model, each) for _, each in known)
        size = result_bytes(known, model.mesh, fields.points, fields.cells, columns)
        counted = [stage for stage, _ in known]
        unknown = [f"stage {stage.name!r}" for stage in case.stages if stage not in counted]
        if seconds:  # modes alone have no steps
            entries["run time"] = (
                f"about {duration(seconds)} of steps on idle cores, within a factor of 3; start, "
                "compilation and output are extra"
            )
        most = "at most " if case.output.compression != "none" else "about "
        entries["result file"] = f"{most}{engineering(size, 'B', 3)}"
        if unknown:
            entries["not included"] = f"run time and results of {', '.join(unknown)}: the number of steps is not known"
    if case.output.checkpoint_every or case.output.checkpoint_minutes:
        entries["checkpoints"] = f"two of about {engineering(checkpoint_bytes(model), 'B', 3)}"
    return entries


def result_bytes(
    stages: Sequence[tuple[Case, Plan]],
    mesh: DistributedMesh,
    point_fields: Collection[str],
    cell_fields: Collection[str],
    columns: Mapping[str, np.dtype],
) -> float:
    """Return the size of the result file [B]: snapshots, history rows, and the structure of the file."""
    item = 4 if stages[0][0].output.precision == "float32" else 8
    snapshots = rows = 1
    for case, plan in stages:
        every = case.output.fields_every
        snapshots += 1 + ((plan.steps - 1) // every if every else 0)
        rows += 1 + (plan.steps - 1) // case.output.history_every
    a_snapshot = mesh.n_nodes * (24 + 3 * item * len(point_fields)) + mesh.n_bars * item * len(cell_fields)
    a_row = sum(dtype.itemsize for dtype in columns.values())
    # a chunk of the history is allocated as a whole
    chunks = -(-rows // 512) * 512
    return 1e5 + 33.0 * mesh.n_bars + snapshots * (a_snapshot + 80.0) + chunks * a_row


def checkpoint_bytes(model: Model) -> float:
    """Return the size of a checkpoint [B]."""
    return 1e4 + model.mesh.n_nodes * 24.0 * 8 + 8.0 * len(model.bars.kept_names) * model.mesh.n_bars


def memory_warning(model: Model, plan: Plan, source: str) -> list[str]:
    """Return a warning if the ranks on a machine need more memory than it has. Collective."""
    comm = model.comm
    machine = comm.Split_type(MPI.COMM_TYPE_SHARED)
    needed, available, ranks = machine.allreduce(_needed(model, plan)), memory_of_machine(), machine.size
    machine.Free()
    mine = (needed / available, needed, available, ranks, MPI.Get_processor_name())
    ratio, needed, available, ranks, name = max(comm.allgather(mine))
    if ratio <= 1.0:
        return []
    return [
        f"{source}the {ranks} ranks on {name} will need about {engineering(needed, 'B', 3)} of memory, and it "
        f"has {engineering(available, 'B', 3)}: the system may end the run; use more machines, a smaller mesh, or an "
        "explicit scheme"
    ]


def _needed(model: Model, plan: Plan) -> float:
    """Return the maximum memory of this rank until the end of the run [B]."""
    kind = "" if plan.linear is None else plan.linear.preconditioner
    each = _PER_BAR.get(kind, max(_PER_BAR.values()))
    if plan.linear is not None and plan.linear.factorises or model.case.modes is not None:
        # fill-in in three dimensions: the factors of n unknowns have O(n^(4/3)) entries
        each = _PER_BAR_FACTORISED * (model.mesh.n_bars / _FACTORISED_AT) ** (1.0 / 3.0)
    return max(_used(), _EMPTY + each * len(model.mesh.bars))


def _used() -> float:
    """Return the maximum memory of this rank so far [B]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024.0  # kibibytes on Linux


def _seconds(model: Model, plan: Plan) -> float:
    """Return the time of all steps on the slowest rank [s], an order of magnitude only for implicit schemes."""
    bars = model.comm.allreduce(len(model.mesh.bars), op=MPI.MAX)
    if plan.linear is None:
        return plan.steps * (_SECONDS_PER_STEP + _SECONDS_EXPLICIT * bars)
    iterations = 100.0 if plan.linear.factorises else 50.0
    return plan.steps * (10.0 * _SECONDS_PER_STEP + _SECONDS_PER_ITERATION * iterations * bars)


def summarise(case: Case, model: Model, plan: Plan) -> dict[str, str]:
    """Return label and text of sizes, distribution, time step and solver. Collective."""
    mesh, comm = model.mesh, model.comm
    owned, ghosts = np.array(comm.allgather((mesh.n_owned, mesh.n_local - mesh.n_owned))).T
    ranks = f"{comm.size}"
    if comm.size > 1:
        most = f"{owned.max():,} nodes"
        own = f"{most} each" if owned.min() == owned.max() else f"{owned.min():,} to {most}"
        ranks += f", owning {own} ({mesh.partitioner}), at most {ghosts.max():,} ghosts"
    walls = [
        wall.name if wall.mass is None else f"{wall.name} ({engineering(wall.mass, 'kg')})" for wall in case.every_wall
    ]
    modes = {}
    if model.case.modes is not None:
        from ..modes.find import describe_modes

        modes = describe_modes(model)
    return {
        "nodes": f"{mesh.n_nodes:,}",
        "bars": f"{mesh.n_bars:,}",
        "ranks": ranks,
        "extent": " x ".join(engineering(float(d), "m") for d in model.high - model.low),
        **_density(model),
        "mass": engineering(model.total_mass, "kg") + f" ({case.mass})",
        "wave speed": engineering(model.wave_speed, "m/s"),
        **plan.texts,
        **modes,
        "walls": ", ".join(walls) or "none",
        **({"contact pairs": ", ".join(pair.name for pair in case.contact_pair)} if case.contact_pair else {}),
        **({"constraints": ", ".join(f"{c.name} ({c.kind})" for c in case.constraint)} if case.constraint else {}),
        "memory": f"{engineering(comm.allreduce(_used()), 'B', 3)} used so far, on all ranks",
    }


def _density(model: Model) -> dict[str, str]:
    """Return the relative density of a lattice, the volume of its bars over that of what it fills, and how much of a
    surface its cells fill. Collective."""
    mesh = model.mesh
    if mesh.volume is None:
        return {}
    lengths = model.bars.mesh_lengths
    own = [float((each.counted_area * lengths[each.start : each.counted]).sum()) for each in model.bars.blocks]
    ratio = model.comm.allreduce(sum(own)) / mesh.volume
    thick = "; struts so thick overlap at nodes, where this counts them more than once" if ratio > _THICK else ""
    texts = {"relative density": f"{ratio:.4g} (volume of bars over {engineering(mesh.volume, 'm3')}){thick}"}
    if mesh.filled is not None:
        inside = engineering(mesh.volume, "m3")
        texts["filled"] = f"{engineering(mesh.filled, 'm3')} by the cells of its struts, of {inside} inside the surface"
    return texts

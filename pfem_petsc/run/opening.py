"""Opens the progress report and the result file at the start of a run."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from ..case.schema import Case
from ..errors import printable
from ..output.progress import Progress
from ..output.vtkhdf import ResultWriter
from ..preflight.forecast import summarise
from ..preflight.inspection import warnings_before
from ..preflight.values import odd_accelerations
from ..recording.fields import Fields
from ..recording.history import History
from ..recording.recorder import Recorder
from ..restart.folder import RESULT, Restart
from ..stepping.model import Model
from ..stepping.plan import Plan

__all__ = ["open_progress", "open_result_file"]


def open_progress(
    case: Case,
    model: Model,
    plan: Plan,
    start: tuple[int, float],
    folder: Path,
    quiet: bool,
    notes: Iterable[str],
) -> Progress:
    """Open the progress report and write summary, warnings and notes. Collective.

    ``start``: step and time [s] from which the run continues.
    """
    progress = Progress(
        model.comm,
        printable(case.title),
        plan.steps,
        plan.end or 0.0,
        quiet,
        folder / "log.txt",
        start_step=start[0],
        start_time=start[1],
        axis=plan.axis,
    )
    progress.summary(summarise(case, model, plan))
    own = plan.plans[model.case.number] if case.stage else plan
    for warning in model.warnings + odd_accelerations(case) + warnings_before(model.case, model, own):
        progress.warning(warning)
    if plan.scheme.notice:
        progress.message(plan.scheme.notice)
    for note in notes:
        progress.message(note)
    return progress


def open_result_file(
    case: Case,
    model: Model,
    plan: Plan,
    history: History,
    fields: Fields,
    events: Mapping[str, Any],
    folder: Path,
    restart: Restart | None,
    step: int,
) -> ResultWriter:
    """Open the result file, new or, if a restart continues it, truncated after ``step``. Collective."""
    continues = restart is not None and restart.continues
    return ResultWriter(
        folder / RESULT,
        model.comm,
        model.mesh,
        point_fields=fields.points,
        cell_fields=fields.cells,
        columns=history.columns,
        column_types=history.types,
        case_text=case.to_toml(),
        attributes=_attributes(case, model, plan, history.recorder),
        precision=case.output.precision,
        compressed=case.output.compression == "gzip",
        append_after_step=step if continues else None,
        last=restart.last if continues else None,
        modes=case.modes.kind if case.modes is not None else None,
        events=events,
    )


def _attributes(case: Case, model: Model, plan: Plan, recorder: Recorder) -> dict[str, Any]:
    attributes: dict[str, Any] = {
        "name": case.name,
        "folder": str(case.folder.resolve()),
        "overrides": list(case.overrides),
        "axis": plan.axis.symbol,
        "time_step": plan.step,
        "linear_solver": plan.linear.why if plan.linear is not None else "none",
        "partitioner": model.mesh.partitioner,
    }
    if case.stage:
        attributes["stages"] = [stage.name for stage in case.stage]
    if plan.steps is not None:
        attributes["steps"] = plan.steps
    for name, nodes in recorder.probe_nodes.items():
        attributes[f"probe_nodes/{name}"] = nodes.tolist()
    return attributes | _wave_times(case, model)


def _wave_times(case: Case, model: Model) -> dict[str, float]:
    """Return the time [s] of a wave through the shortest bar at each wall, and at the supports, of all stages.

    Collective.
    """
    sets: dict[str, list[str | None]] = {}
    for stage in case.stages:
        for wall in stage.wall:
            sets.setdefault(f"wall/{wall.name}/force", []).append(wall.node_set)
        for support in stage.support:
            sets.setdefault("support_force", []).append(support.node_set)
    mesh, bars, found = model.mesh, model.bars, {}
    for column, names in sets.items():
        members = np.zeros((mesh.n_local, 1))
        for name in names:
            members[: mesh.n_owned][slice(None) if name is None else model.nodes[name]] = 1.0
        mesh.update_ghosts(members)
        times = [np.inf]
        for block in bars.blocks:
            own = slice(block.start, block.stop)
            near = (members[bars.ends[own], 0] > 0.0).any(axis=1)
            if block.density > 0.0 and near.any():
                shortest = float(bars.mesh_lengths[own][near].min())
                times.append(shortest * float(np.sqrt(block.density / block.modulus)))
        found[f"wave_time/{column}"] = model.comm.allreduce(min(times), op=MPI.MIN)
    return found

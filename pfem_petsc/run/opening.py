"""What a run opens at its start: the report of its progress, and the result file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..errors import printable
from ..output.progress import Progress
from ..output.vtkhdf import ResultWriter
from ..preflight.inspection import warnings_before
from ..restart.folder import RESULT

__all__ = ["open_progress", "open_result_file"]


def open_progress(simulation, aside: Path | None) -> Progress:
    """The report, with summary, warnings and notes told. Collective.

    ``aside``: where results went that the folder held.
    """
    case, model, plan, state = simulation.case, simulation.model, simulation.plan, simulation.state
    progress = Progress(
        simulation.comm,
        printable(case.title),
        plan.steps,
        plan.step * plan.steps,
        simulation.quiet,
        simulation.folder / "log.txt",
        start_step=state.step,
        start_time=state.time,
    )
    progress.summary(simulation.summary())
    for warning in model.warnings + warnings_before(case, model, plan):
        progress.warning(warning)
    if plan.scheme.notice:
        progress.message(plan.scheme.notice)
    for note in simulation.notes:
        progress.message(note)
    if aside is not None:
        progress.message(f"{simulation.folder}: held results, which are in {aside} now")
    return progress


def open_result_file(simulation, continues: bool) -> ResultWriter:
    """The result file, new or, where it ``continues``, with what came after the checkpoint cut off. Collective."""
    case, recorder, fields = simulation.case, simulation.recorder, simulation.fields
    return ResultWriter(
        simulation.folder / RESULT,
        simulation.comm,
        simulation.mesh,
        point_fields=fields.points,
        cell_fields=fields.cells,
        columns=recorder.columns,
        column_types=recorder.types,
        case_text=case.to_toml(),
        attributes=_attributes(simulation),
        precision=case.output.precision,
        append_after_step=simulation.state.step if continues else None,
        last=simulation.restart.last if continues else None,
    )


def _attributes(simulation) -> dict[str, Any]:
    case, plan = simulation.case, simulation.plan
    attributes: dict[str, Any] = {
        "name": case.name,
        "folder": str(case.folder.resolve()),
        "overrides": list(case.overrides),
        "time_step": plan.step,
        "steps": plan.steps,
        "linear_solver": plan.linear.why if plan.linear is not None else "none",
        "partitioner": simulation.mesh.partitioner,
    }
    for name, nodes in simulation.recorder.probe_nodes.items():
        attributes[f"probe_nodes/{name}"] = nodes.tolist()
    return attributes

"""Converts a case to nested tables with the keys of the case file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel

if TYPE_CHECKING:
    from .schema import Case

__all__ = ["tables_of"]


def tables_of(case: Case) -> dict[str, Any]:
    """Return the tables of a case with all defaults, without absent tables."""
    data = _every_table(case)
    if not case.output.probe:
        del data["output"]["probe"]
    data["stage"] = [_stage_table(stage) for stage in case.stage]
    return {key: value for key, value in data.items() if value not in ({}, [])}


def _stage_table(stage: Case) -> dict[str, Any]:
    """Return name, analysis and given tables of a stage, as its case has them."""
    tables = _every_table(stage)
    tables["output"] = {key: tables["output"][key] for key in ("fields_every", "history_every")}
    named = {name: stage.section[name].prestressed for name in stage.stressed}
    tables["section"] = {name: {key: tables["section"][name][key]} for name, key in named.items()}
    analysis = "time" if stage.time is not None else "static"
    return {"name": stage.name, **{key: tables[key] for key in (*stage.given, analysis)}}


def _every_table(case: Case) -> dict[str, Any]:
    """All tables by name, those without content included."""
    everywhere = [entry for entry in case.initial if entry.node_set is None]
    initial = _table(everywhere[0]) if everywhere else {}
    on = [_table(entry) for entry in case.initial if entry.node_set is not None]
    parameters = case.mesh.parameters
    mesh = parameters.table() if hasattr(parameters, "table") else _table(parameters)
    return {
        "title": case.title,
        "mesh": {**_table(case.mesh), **mesh},
        "node_set": {name: _table(entry) for name, entry in case.node_set.items()},
        "material": {name: _table(entry) for name, entry in case.material.items()},
        "section": {name: _table(entry) for name, entry in case.section.items()},
        "initial": {**initial, "on": on} if on else initial,
        "support": [_table(entry) for entry in case.support],
        "mass": [_table(entry) for entry in case.point_mass],
        "spring": [_table(entry) for entry in case.spring],
        "dashpot": [_table(entry) for entry in case.dashpot],
        "load": [_table(entry) for entry in case.load],
        "gravity": _table(case.gravity),
        "wind": _table(case.wind),
        "temperature": [_table(entry) for entry in case.temperature],
        "wall": [_table(entry) for entry in case.wall],
        "contact_pair": [_table(entry) for entry in case.contact_pair],
        "constraint": [_table(entry) for entry in case.constraint],
        "remove": [_table(entry) for entry in case.remove],
        "contact": _table(case.contact),
        "time": {**_table(case.time), **_table(case.time.scheme)} if case.time is not None else {},
        "static": {**_table(case.static), **_table(case.static.parameters)} if case.static is not None else {},
        "modes": _table(case.modes),
        "output": _table(case.output),
        "solver": _table(case.solver),
    }


def _table(model: BaseModel | None) -> dict[str, Any]:
    if model is None:
        return {}
    data = model.model_dump(exclude_none=True, exclude={"scheme", "parameters"})
    return {key: str(value) if isinstance(value, Path) else value for key, value in data.items()}

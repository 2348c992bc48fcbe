"""Load cases and their combinations, as stages that all start from the same state.

Each load case is solved by itself, nonlinearly, from the state at the end of the last stage, or, in a case without
stages, from the equilibrium under what the case has outside of load cases: its pretension, gravity, loads. These remain
in force, with the factor 1. A combination is solved in the same way, with the loads of its load cases times factors;
nothing is superposed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from .base import has_rows

PERMANENT = "permanent"
"""Name of the stage before the load cases of a case that gives no stages."""

METHODS = ("newton", "relaxation")
"""Methods of static analyses that end at a load factor."""

TABLES = ("load", "gravity", "wind", "temperature", "support")
"""Tables of a load case."""


class UnsuitableError(ValueError):
    """Why load cases cannot be combined."""


def stage_rows(
    cases: Sequence[Any], combinations: Sequence[Any], common: Mapping[str, Any]
) -> Iterator[dict[str, Any]]:
    """Yield the tables of a stage for each load case and then for each combination.

    Parameters
    ----------
    cases, combinations : the validated tables ``[[load_case]]`` and ``[[combination]]``
    common : the tables in force at the end of the stage that they start from, by :func:`at_end`

    Raises
    ------
    UnsuitableError
        If a combination has no meaning, such as of two winds.
    """
    own = {case.name: _tables(case) for case in cases}
    for case in cases:
        yield {"name": case.name, **_joined(common, {case.name: own[case.name]})}
    for combination in combinations:
        scaled = {name: _scaled(own[name], factor) for name, factor in combination.factors.items() if factor}
        yield {"name": combination.name, **_joined(common, scaled)}


def at_end(stage: Any) -> dict[str, Any]:
    """Return the tables in force at the end of a static stage, a validated one: what varies has its value there, and
    supports are at rest."""
    last = getattr(stage.static.parameters, "end", 1.0)
    tables = _tables(stage)
    for key, of in (("load", "force"), ("temperature", "value")):
        tables[key] = [_constant(row, "table", of, last) for row in tables.get(key, [])]
    if "gravity" in tables:
        tables["gravity"] = _constant(tables["gravity"], "acceleration", "acceleration", last)
    motion = ("motion", "velocity", "acceleration", "interpolation")
    still = [{key: value for key, value in row.items() if key not in motion} for row in tables.get("support", [])]
    return {**tables, "support": still}


def _constant(row: Mapping[str, Any], key: str, of: str, time: float) -> dict[str, Any]:
    """Return a row whose ``key`` has rows over time as it is at one, with the value of ``of`` then."""
    if not has_rows(row.get(key)):
        return dict(row)
    from ..mechanics.motion import Table

    values = Table(row[key], row.get("interpolation") == "smooth")(time).tolist()
    kept = {name: value for name, value in row.items() if name not in (key, "interpolation")}
    return {**kept, of: values if key == of else _times(row[of], values[0]) if of in row else values[0]}


def _tables(case: Any) -> dict[str, Any]:
    tables = {key: getattr(case, key) for key in TABLES}
    lists = {key: [row.as_table(given=True) for row in value] for key, value in tables.items() if type(value) is list}
    single = {key: value.as_table() for key, value in tables.items() if type(value) is not list and value is not None}
    return {key: value for key, value in {**lists, **single}.items() if value}


def _scaled(tables: Mapping[str, Any], factor: float) -> dict[str, Any]:
    """Return the tables of a load case times a factor."""
    made: dict[str, Any] = {}
    for key, value in tables.items():
        if key == "wind":  # its drag is proportional to the density
            text = f"a wind cannot have the factor {factor:g} < 0: turn its velocity"
            if factor < 0.0:
                raise UnsuitableError(text)
            made[key] = {**value, "density": factor * value["density"]}
        elif key == "gravity":
            made[key] = {**value, "acceleration": _times(value["acceleration"], factor)}
        else:
            made[key] = [_scaled_row(key, row, factor) for row in value]
    return made


def _scaled_row(key: str, row: Mapping[str, Any], factor: float) -> dict[str, Any]:
    text = "a support with acceleration cannot be combined: give its motion"
    if key == "support" and row.get("acceleration") is not None:
        raise UnsuitableError(text)
    scaled = dict(row)
    for of in {"load": ("force",), "temperature": ("value", "table"), "support": ("motion", "velocity")}[key]:
        if row.get(of) is not None:
            scaled[of] = _times(row[of], factor)
    if key == "load" and "file" in row:
        scaled["scale"] = factor * row.get("scale", 1.0)
    return scaled


def _times(value: Any, factor: float) -> Any:
    """Return a number, a vector, or rows over time times a factor, which the times do not get."""
    if has_rows(value):
        return [[row[0], *(factor * each for each in row[1:])] for row in value]
    return [factor * each for each in value] if isinstance(value, list | tuple) else factor * value


def _joined(common: Mapping[str, Any], parts: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the tables of what is in force and of load cases, by their names, together."""
    made: dict[str, Any] = {}
    for key in TABLES:
        given = [part[key] for part in parts.values() if key in part]
        if not given:
            continue
        if key == "load":
            made[key] = [row for rows in (common.get(key, []), *given) for row in rows]
        elif key == "support":
            made[key] = _supports(common.get(key, []), given)
        elif key == "gravity":
            made[key] = _gravity([*([common[key]] if common.get(key) else []), *given])
        elif len(given) > 1 or (key == "wind" and common.get(key)):
            of = [repr(each) for each, part in parts.items() if key in part]
            of += ["what acts in all load cases"] if common.get(key) else []
            raise UnsuitableError(f"adds the {key} of {' and '.join(of)}, of which one can act: leave out the others")
        else:
            made[key] = given[0] if key == "wind" else [*common.get(key, []), *given[0]]
    return made


def _gravity(tables: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    accelerations = [table["acceleration"] for table in tables]
    text = "adds a gravity with rows to another gravity: give constant accelerations"
    if len(tables) > 1 and any(map(has_rows, accelerations)):
        raise UnsuitableError(text)
    if len(tables) == 1:
        return dict(tables[0])
    return {"acceleration": [sum(each) for each in zip(*accelerations, strict=True)]}


def _supports(common: Sequence[Mapping[str, Any]], given: Sequence[Sequence[Any]]) -> list[dict[str, Any]]:
    """Return the supports in force, with those of load cases in the place of those of the same name or node set."""
    rows = [dict(row) for row in common]
    taken: dict[str, dict[str, Any]] = {}
    for row in [row for each in given for row in each]:
        key = f"name {row['name']}" if row.get("name") else f"node set {row['node_set']}"
        text = f"moves the support of {key} in two load cases: give one that moves it"
        if key in taken:
            raise UnsuitableError(text)
        same = "name" if row.get("name") else "node_set"
        found = next((k for k, other in enumerate(rows) if other.get(same) == row[same]), len(rows))
        taken[key] = dict(row)
        rows[found : found + 1] = [taken[key]]
    return rows

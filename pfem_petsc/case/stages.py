"""Stages of a case: each is a case of its own, made of the tables in force, so that all checks of a case serve.

A table that a stage gives replaces that table from this stage on; the others stay in force. ``initial`` and ``remove``
are exceptions: velocities are added at the start of the stage that gives them, and at no later one, and what a
stage removes is gone in later ones, which may not even know the supports. ``section`` has the prestress of the sections
that a stage stresses; all else of a section is the same in all stages.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from ..registry import nearest
from .model import ANALYSES, ONE_STAGE, STAGE_TABLES, StageName, StageOutput
from .problems import Problems
from .tables import PRESTRESSES
from .toml import KeyPath


class StageTables(NamedTuple):
    """A stage as read.

    Attributes
    ----------
    name : of the stage
    data : the tables of the case that are in force
    given : the tables that the stage gives itself; stressed : names of the sections whose prestress it gives
    owner : the number of the stage that gave each table that is not the case's own
    """

    name: str
    data: dict[str, Any]
    given: tuple[str, ...]
    stressed: tuple[str, ...]
    owner: Mapping[str, int]

    def place(self, path: KeyPath) -> KeyPath:
        """Return the path in the case of a key of the tables in force: ``stage[1].static.step``."""
        return ("stage", self.owner[str(path[0])], *path) if path and path[0] in self.owner else path


def stages_of(data: Mapping[str, Any], problems: Problems) -> list[StageTables]:
    """The stages of a case's nested tables; rejected ones are reported in ``problems`` and left out."""
    rows = data["stage"]
    if not isinstance(rows, list) or not rows:
        problems.add(("stage",), "expected a list of at least one table, each under a heading [[stage]]", rows)
        return []
    for key in ANALYSES:
        if key in data:
            problems.add((), f"[{key}] and [[stage]] exclude each other: give [stage.{key}]")
    last = len(rows) - 1
    common = {key: value for key, value in data.items() if key not in ("stage", "modes", *ANALYSES)}
    owner: dict[str, int] = {}
    found: list[StageTables] = []
    for k, row in enumerate(rows):
        if not isinstance(row, Mapping):
            problems.add(("stage", k), "expected a table", row)
            continue
        name = _name(row, k, problems)
        if name in [stage.name for stage in found]:
            problems.add(("stage", k, "name"), "another stage has this name", name)
        known = ["name", *ANALYSES, *STAGE_TABLES]
        for key in [key for key in row if key not in known]:
            problems.add(("stage", k, key), f"unknown key of a stage{nearest(key, known)}")
        given = tuple(key for key in STAGE_TABLES if key in row)
        tables = {key: row[key] for key in given}
        if "output" in tables:
            tables["output"] = _output(tables["output"], common.get("output", {}), k, problems)
        if "section" in tables:
            tables["section"] = _sections(tables["section"], common.get("section"), k, problems)
        for key in ONE_STAGE if k else ():
            common.pop(key, None)
        common |= tables
        owner |= dict.fromkeys((*given, *ANALYSES), k)
        owner.pop("output", None)
        chosen = [key for key in ANALYSES if key in row]
        if len(chosen) != 1:
            got = "not both" if chosen else "it has none"
            problems.add(("stage", k), f"expected one of the tables [stage.time], [stage.static]; {got}")
            continue
        here = {**common, chosen[0]: row[chosen[0]]}
        if k == last and "modes" in data:
            here["modes"] = data["modes"]
        stressed = tuple(row["section"]) if isinstance(row.get("section"), Mapping) else ()
        found.append(StageTables(name, here, given, stressed, dict(owner)))
    return found


def _name(row: Mapping[str, Any], k: int, problems: Problems) -> str:
    name = row.get("name", f"stage{k + 1}")
    read = problems.validated(StageName, {"name": name}, None, lambda path: ("stage", k, *path))
    return read.name if read is not None else f"stage{k + 1}"


def _sections(given: Any, common: Any, k: int, problems: Problems) -> Any:
    """The sections of a stage: those of the case, with the prestress that it gives."""
    if not isinstance(given, Mapping) or not isinstance(common, Mapping):
        problems.add(("stage", k, "section"), "expected tables by the names of sections", given)
        return common
    merged = dict(common)
    for name, table in given.items():
        path = ("stage", k, "section", str(name))
        if not isinstance(common.get(name), Mapping):
            problems.add(path, f"there is no section of this name{nearest(str(name), list(common))}")
        elif not isinstance(table, Mapping) or len(table) != 1 or not set(table) <= set(PRESTRESSES):
            known = ", ".join(PRESTRESSES)
            problems.add(path, f"a stage can only change the prestress of a section: expected one of {known}")
        else:
            kept = {key: value for key, value in common[name].items() if key not in PRESTRESSES}
            merged[name] = {**kept, **table}
    return merged


def _output(given: Any, common: Any, k: int, problems: Problems) -> Any:
    """The output of a stage: its keys over those of the case."""
    read = problems.validated(StageOutput, given, None, lambda path: ("stage", k, "output", *path))
    if read is None or not isinstance(common, Mapping):
        return common
    return {**common, **read.model_dump(exclude_none=True)}

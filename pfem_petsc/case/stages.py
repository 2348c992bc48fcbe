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
from .base import Name, NonNegativeInt, PositiveInt, StrictModel
from .problems import Path, Problems
from .tables import PRESTRESSES

__all__ = ["ANALYSES", "ONE_STAGE", "TABLES", "StageOutput", "StageTables", "stages_of"]

ANALYSES = ("time", "static")
"""Tables of which a stage has exactly one."""

TABLES = (
    "initial",
    "support",
    "load",
    "gravity",
    "wind",
    "temperature",
    "wall",
    "remove",
    "contact",
    "output",
    "solver",
    "section",
)
"""Tables that a stage may give."""


ONE_STAGE = ("initial", "remove")
"""Tables that are in force in the stage alone that gives them."""


class _Named(StrictModel):
    name: Name


class StageOutput(StrictModel):
    """The keys of [stage.output]; what else is written is the same for all stages."""

    fields_every: NonNegativeInt | None = None
    """steps between field snapshots, counted from the start of the run; 0: none but the last of the stage"""
    history_every: PositiveInt | None = None
    """steps between rows of the history"""


class StageTables(NamedTuple):
    """A stage as read.

    Attributes
    ----------
    name : of the stage
    data : the tables of the case that are in force
    given : the tables that the stage gives itself; stressed : names of the sections whose prestress it gives
    problems : takes what is wrong with them
    """

    name: str
    data: dict[str, Any]
    given: tuple[str, ...]
    stressed: tuple[str, ...]
    problems: Problems


class _Located(Problems):
    """Problems of a stage's case, told where the table was given: ``stage[1].static.step``."""

    def __init__(self, problems: Problems, owner: Mapping[str, int]) -> None:
        super().__init__(problems.source)
        self._problems, self._owner = problems, dict(owner)

    def add(self, path: Path, message: str, value: Any = None) -> None:
        """See :meth:`~pfem_petsc.case.problems.Problems.add`."""
        if path and path[0] in self._owner:
            path = ("stage", self._owner[path[0]], *path)
        self._problems.add(path, message, value)


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
        _refuse_unknown(row, k, problems)
        given = tuple(key for key in TABLES if key in row)
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
        found.append(StageTables(name, here, given, stressed, _Located(problems, owner)))
    return found


def _name(row: Mapping[str, Any], k: int, problems: Problems) -> str:
    name = row.get("name", f"stage{k + 1}")
    read = problems.read(_Named, {"name": name}, ("stage", k))
    return read.name if read is not None else f"stage{k + 1}"


def _refuse_unknown(row: Mapping[str, Any], k: int, problems: Problems) -> None:
    known = ["name", *ANALYSES, *TABLES]
    for key in row:
        if key not in known:
            problems.add(("stage", k, key), f"unknown key of a stage{nearest(key, known)}")


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
    read = problems.read(StageOutput, given, ("stage", k, "output"))
    if read is None or not isinstance(common, Mapping):
        return common
    return {**common, **read.model_dump(exclude_none=True)}

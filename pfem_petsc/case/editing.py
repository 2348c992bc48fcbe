"""Changes of a case that was read: each is validated with the whole case, as a file is.

The tables of a :class:`~pfem_petsc.case.schema.Case` know their place in it. A change is put into the nested tables
that were given, without defaults; these are read again, and the objects of the case then take the values that were
read, so that references to tables stay valid. A rejected change has no effect.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel

from ..errors import InputError
from .base import StrictModel
from .containers import KeyPath, Place, Rows, Tables
from .overrides import put, split_key, take_out
from .problems import key_text
from .stages import ANALYSES, ONE_STAGE, StageOutput

if TYPE_CHECKING:
    from .schema import Case

__all__ = ["attribute_of", "changed_data", "copied", "given_table", "key_path", "merge", "merged_stages", "settle"]

_FLAT = ("scheme", "parameters")
"""Tables whose keys stand among those of the table that has them."""

_MODELS = ("gravity", "wind", "contact", "time", "static", "modes", "output", "solver")
_LISTS = ("support", "mass", "spring", "dashpot", "load", "temperature", "wall", "contact_pair", "constraint", "remove")
_NAMED = ("node_set", "material", "section")


def attribute_of(key: str) -> str:
    """Return the attribute of a case for a top-level key."""
    return "point_mass" if key == "mass" else key


def given_table(model: BaseModel | None) -> dict[str, Any]:
    """Return the keys of a table that were given, those of its scheme or generator among them."""
    if model is None:
        return {}
    data = model.model_dump(exclude_unset=True, exclude_none=True, exclude=set(_FLAT))
    for key in _FLAT:
        if key in model.__dict__ and model.__dict__[key] is not None:
            data |= given_table(model.__dict__[key])
    return {key: str(value) if isinstance(value, Path) else value for key, value in data.items()}


def given_tables(case: Case) -> dict[str, Any]:
    """Return the nested tables of a case as they were given, with rows instead of files with tables over time."""
    data = _tables(case)
    if case.stage:
        data["stage"] = [_stage(case, stage) for stage in case.stage]
    return data


def _tables(case: Case) -> dict[str, Any]:
    everywhere = {k: v for entry in case.initial if entry.node_set is None for k, v in given_table(entry).items()}
    on = [given_table(entry) for entry in case.initial if entry.node_set is not None]
    data: dict[str, Any] = {
        "title": case.title,
        "mesh": given_table(case.mesh),
        "initial": {**everywhere, "on": on} if on else everywhere,
    }
    for key in _NAMED:
        data[key] = {name: given_table(table) for name, table in case.__dict__[key].items()}
    for key in _LISTS:
        data[key] = [given_table(table) for table in case.__dict__[attribute_of(key)]]
    for key in _MODELS:
        data[key] = given_table(case.__dict__[key])
    present = {key: case.__dict__[key] is not None for key in ("static", "modes", "time", "gravity", "wind")}
    return {key: value for key, value in data.items() if value not in ({}, []) or present.get(key, False)}


def _stage(case: Case, stage: Case) -> dict[str, Any]:
    tables = _tables(stage)
    analysis = "time" if stage.time is not None else "static"
    row = {"name": stage.name, **{key: tables.get(key, _nothing(key)) for key in (*stage.given, analysis)}}
    if "output" in row:
        keys = StageOutput.model_fields
        own = {key: value for key, value in given_table(stage.output).items() if key in keys}
        row["output"] = {key: value for key, value in own.items() if value != getattr(case.output, key)}
    if "section" in row:  # a stage gives the prestress alone
        named = {name: stage.section[name].prestressed for name in _stressed(stage)}
        row["section"] = {name: {key: getattr(stage.section[name], str(key))} for name, key in named.items()}
    return row


def _stressed(stage: Case) -> Sequence[str]:
    """Names of the sections whose prestress a stage gives itself."""
    return stage.__dict__.get("stressed", ())


def _nothing(key: str) -> Any:
    return [] if key in _LISTS else {}


def changed_data(case: Case, changes: Iterable[tuple[KeyPath, Any]]) -> dict[str, Any]:
    """Return the nested tables of a case with changes: values, tables or models at key paths; None removes a key.

    Raises
    ------
    InputError
        If a path leads through a value, or beyond the end of a list.
    """
    data = given_tables(case)
    for path, value in changes:
        value = _plain_tables(value)
        if path[-1:] == ("initial",) and isinstance(value, list):
            value = _initial(value)
        parts = [str(part) for part in path]
        if value is None:
            take_out(data, parts)
        else:
            put(data, parts, value, f"{case.source}: {key_text(path)}")
    return data


def _initial(entries: Sequence[Any]) -> dict[str, Any]:
    """Return the table [initial] of a list of its entries."""
    everywhere = [entry for entry in entries if not isinstance(entry, Mapping) or "node_set" not in entry]
    if len(everywhere) > 1 or not all(isinstance(entry, Mapping) for entry in everywhere):
        raise InputError("initial: expected tables, at most one of which has no node_set")
    on = [entry for entry in entries if "node_set" in entry]
    return {**(everywhere[0] if everywhere else {}), **({"on": on} if on else {})}


def _plain_tables(value: Any) -> Any:
    """Replace models by the keys that they were given."""
    if isinstance(value, StrictModel):
        return given_table(value)
    if isinstance(value, Mapping):
        return {key: _plain_tables(item) for key, item in value.items()}
    if isinstance(value, list | tuple) and any(isinstance(item, StrictModel | Mapping) for item in value):
        return [_plain_tables(item) for item in value]
    return value


def key_path(case: Case, key: str) -> KeyPath:
    """Return the parts of a dotted key such as ``wall[0].point``; the attribute ``point_mass`` is the key ``mass``.

    Raises
    ------
    InputError
        If it is malformed.
    """
    parts = split_key(key) if isinstance(key, str) else None
    if parts is None:
        raise InputError(f"{case.source}: {key!r}: expected a key like time.step or wall[0].point")
    parts[0] = "mass" if parts[0] == "point_mass" else parts[0]
    return tuple(int(part) if part.isascii() and part.isdigit() else part for part in parts)


def merge(old: Any, new: Any) -> Any:
    """Return ``new`` as far as possible in the objects of ``old``, which take its values."""
    if type(old) is not type(new):
        return new
    if isinstance(old, StrictModel):
        for key, value in new.__dict__.items():
            old.__dict__[key] = merge(old.__dict__.get(key), value)
        object.__setattr__(old, "__pydantic_fields_set__", new.__pydantic_fields_set__)
        return old
    if type(old) is dict:
        return {name: merge(old.get(name), item) for name, item in new.items()}
    if isinstance(old, Tables):
        tables = {name: merge(old.get(name), table) for name, table in new.items()}
        dict.clear(old)
        dict.update(old, tables)
        return old
    if isinstance(old, Rows):
        if len(old) == len(new):
            rows = [merge(one, other) for one, other in zip(old, new, strict=True)]
        else:
            left = list(old)
            rows = []
            for row in new:
                same = next((k for k, one in enumerate(left) if one == row), None)
                rows.append(row if same is None else left.pop(same))
        list.__setitem__(old, slice(None), rows)
        return old
    return new


def merged_stages(old: tuple[Case, ...], new: tuple[Case, ...]) -> tuple[Case, ...]:
    """Return the stages of ``new``, in the objects of ``old`` where their numbers agree."""
    if len(old) != len(new):
        return new
    for one, other in zip(old, new, strict=True):
        for key, value in other.__dict__.items():
            one.__dict__[key] = merge(one.__dict__.get(key), value)
    return old


def copied(case: Case) -> Case:
    """Return a case with tables of its own, without places."""
    made = case.__new__(type(case))
    made.__dict__.update({key: _copied(value) for key, value in case.__dict__.items() if key != "editor"})
    made.__dict__["stage"] = tuple(copied(stage) for stage in case.stage)
    return made


def _copied(value: Any) -> Any:
    if isinstance(value, StrictModel):
        value = value.model_copy()
        value.__dict__.update({key: _copied(item) for key, item in value.__dict__.items()})
        return value
    if isinstance(value, dict):
        return {name: _copied(table) for name, table in value.items()}
    if isinstance(value, list):
        return [_copied(row) for row in value]
    if isinstance(value, tuple) and value and isinstance(value[0], StrictModel):
        return tuple(_copied(item) for item in value)
    return value


def settle(case: Case, attached: bool = True) -> None:
    """Give all tables of a case their places in it, or take these away."""
    for k, stage in enumerate(case.stage):
        _settle(stage, case if attached else None, lambda key, k=k: _of_stage(case, k, key))
    _settle(case, case if attached else None, lambda key: (key,))


def _of_stage(case: Case, k: int, key: str) -> KeyPath:
    """The place of a table that is in force in stage k: in the stage that gives it, or in the case."""
    if key == "section":  # of which a stage gives the prestress alone
        return (key,)
    if key in case.stage[k].given or key in (*ANALYSES, "name"):
        return "stage", k, key
    for j in range(k - 1, -1, -1) if key not in ONE_STAGE else ():
        if key in case.stage[j].given:
            return "stage", j, key
    return ("stage", k, key) if key in ONE_STAGE and k else (key,)


def _settle(case: Case, owner: Case | None, place: Callable[[str], KeyPath]) -> None:
    case.__dict__["editor"] = (case if owner is None else owner), place
    for key in (*_NAMED, "initial", *_LISTS, *_MODELS, "mesh"):
        attribute, path = attribute_of(key), place(key)
        content = case.__dict__[attribute]
        if isinstance(content, dict) and not isinstance(content, Tables):
            content = case.__dict__[attribute] = Tables(content)
        elif isinstance(content, list) and not isinstance(content, Rows):
            content = case.__dict__[attribute] = Rows(content)
        if isinstance(content, Tables | Rows):
            content._place = None if owner is None else Place(owner, path)
        for table, where in _inside(content, path, key):
            _settle_model(table, owner, where)
    for k in range(case.number, -1, -1) if owner is not None and owner is not case else ():
        for name in _stressed(owner.stage[k]):
            if case.section[name]._place.path[0] != "stage":
                _settle_model(case.section[name], owner, ("stage", k, "section", name))


def _inside(content: Any, path: KeyPath, key: str) -> Iterator[tuple[StrictModel, KeyPath]]:
    if isinstance(content, StrictModel):
        yield content, path
    elif isinstance(content, dict):
        yield from ((table, (*path, name)) for name, table in content.items())
    elif key == "initial":
        on = 0
        for entry in content:
            yield entry, path if entry.node_set is None else (*path, "on", on)
            on += entry.node_set is not None
    elif isinstance(content, list):
        yield from ((table, (*path, i)) for i, table in enumerate(content))


def _settle_model(table: StrictModel, owner: Case | None, path: KeyPath) -> None:
    object.__setattr__(table, "_place", None if owner is None else Place(owner, path))
    for key, value in table.__dict__.items():
        if isinstance(value, StrictModel):
            _settle_model(value, owner, path if key in _FLAT else (*path, key))
        elif isinstance(value, dict):
            for name, item in value.items():
                if isinstance(item, StrictModel):
                    _settle_model(item, owner, (*path, key, name))
        elif isinstance(value, tuple) and value and isinstance(value[0], StrictModel):
            for i, item in enumerate(value):
                _settle_model(item, owner, (*path, key, i))

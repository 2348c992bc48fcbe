"""Changes of a case, each validated with the whole case as a file is: by ``key=value``, and as tables of objects.

The tables of a :class:`~pfem_petsc.case.schema.Case` know their place in it. A change is put into the nested tables
that were given, without defaults; these are read again, and the objects of the case then take the values that were
read, so that references to tables stay valid. A rejected change has no effect.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

from ..errors import InputError
from ..registry import nearest
from .base import StrictModel
from .model import ANALYSES, LISTS, NUMBERED, ONE_STAGE, CaseModel, StageOutput, shape_of
from .toml import DEEPEST, KeyPath, key_text, plain, pointed, split_key

V = TypeVar("V")


def apply_overrides(data: dict[str, Any], overrides: Iterable[str]) -> list[KeyPath]:
    """Apply ``key=value`` texts to the tables of a case, in place; missing tables are created.

    Parameters
    ----------
    data : the case as nested tables
    overrides : texts ``path=value``; the value is TOML, or else used as a plain string; without a value, the key is
        removed if it exists

    Returns
    -------
    The paths that were set.

    Raises
    ------
    InputError
        If a text has no ``=``, its value begins as a list, a table or a text in quotes and is none, or its path passes
        through a value that is not a table, beyond the end of a list, or to a name that no entry of a list has.
    """
    paths = []
    for text in overrides:
        key, equals, value = text.partition("=")
        parts = split_key(key.strip())
        if parts is not None and len(parts) > DEEPEST:
            raise InputError(f"--set {text[:40]} ...: a key of more than {DEEPEST} parts")
        if not equals or parts is None:
            raise InputError(f"--set {text}: expected KEY=VALUE, like time.step=1e-5 or wall.0.point=[1.0, 0.0, 0.0]")
        where = f"--set {text}"
        found = _value(value.strip(), where) if value.strip() else None
        path = put(data, parts, found, where)
        paths += [path] if found is not None else []
    return paths


_NUMBER = re.compile(r"([-+]?)(\d*)[.,](\d*)((?:[eE][-+]?\d+)?)")
"""What is meant as a number: a comma, or no digit beside the point."""


def _value(text: str, where: str) -> Any:
    try:
        read = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError) as error:  # a syntax error, too many digits, nested too deep
        if text[0] in "[{\"'" and isinstance(error, tomllib.TOMLDecodeError):
            about = f"this is not valid TOML, and text that begins with {text[0]} must be in quotes"
            raise InputError(f"{where}: {about}: {pointed(f'value = {text}', error, 8)}") from error
        found = _NUMBER.fullmatch(text)
        if found is not None:
            right = f"{found[1]}{found[2] or '0'}.{found[3] or '0'}{found[4]}"
            raise InputError(
                f"{where}: {text} is not a number in TOML, write {right}; a text would be in quotes"
            ) from None
        return text
    return read["value"] if len(read) == 1 else text


def _place_of(rows: list[Any], part: str, table: str, where: str) -> int:
    """Return the index in a list that a part of a key means: a number, or the name of one of the ``rows`` of a table.

    Raises
    ------
    InputError
        Beginning with ``where``, if no row has the name, or several.
    """
    if part.isascii() and part.isdigit() and len(part) <= 18:
        return int(part)
    default = NUMBERED.get(table)
    names = [
        row.get("name", f"{default}{k + 1}" if default else None) if isinstance(row, Mapping) else None
        for k, row in enumerate(rows)
    ]
    found = [k for k, name in enumerate(names) if name == part]
    if len(found) == 1:
        return found[0]
    if found:
        raise InputError(
            f"{where}: {len(found)} entries of {table} have the name {part!r}: give an index, "
            f"{' or '.join(map(str, found))}"
        )
    known = [name for name in names if isinstance(name, str)]
    if known:
        raise InputError(
            f"{where}: no entry of {table} has the name {part!r}{nearest(part, known).rstrip('?')}; or give an index, "
            f"0 to {len(rows)}, where the last one appends an item"
        )
    raise InputError(_no_index(part, rows, where))


def _no_index(part: str, rows: list[Any], where: str) -> str:
    return f"{where}: {part!r} is not an index of this list: 0 to {len(rows)}, where the last one appends an item"


def put(data: dict[str, Any], parts: Sequence[str], value: Any, where: str) -> KeyPath:
    """Set the value at the parts of a key, or remove it (None), and return its path; missing tables are created.

    Entries of a list of tables are meant by their index, or by their name.

    Raises
    ------
    InputError
        Beginning with ``where``, if the key leads through a value, beyond the end of a list, or to a name that none or
        several entries have.
    """
    path: KeyPath = ()
    here: Any = data
    for k, part in enumerate(parts):
        names = tuple(p for p in path if isinstance(p, str))
        if not isinstance(here, list | dict):
            if value is None:
                return path
            raise InputError(f"{where}: {'.'.join(map(str, path))} is a value, not a table")
        key = _place_of(here, part, names[-1], where) if isinstance(here, list) else part
        if key not in (range(len(here)) if isinstance(here, list) else here):
            if value is None:
                return path
            if isinstance(here, list) and key > len(here):
                raise InputError(_no_index(part, here, where))
            if isinstance(here, list):
                here.append({})
            else:
                here[key] = [] if (*names, part) in LISTS else {}
        path = (*path, key)
        if k == len(parts) - 1:
            break
        if isinstance(here[key], tuple):  # of the objects of a case
            here[key] = list(here[key])
        here = here[key]
    if value is None:
        del here[key]
    else:
        here[key] = value
    return path


class Place(NamedTuple):
    """Where a table is: the case that is changed with it, and its key path there."""

    case: CaseModel
    path: KeyPath

    def change(self, key: str | int, value: Any) -> None:
        """Set a key of the table; see :meth:`~pfem_petsc.case.schema.Case.update`."""
        self.case.edit([((*self.path, key), value)])


def _through_copy(*names: str) -> Callable[[type], type]:
    """Decorate a list or dict whose methods ``names`` change a copy, with which the case is then validated."""

    def decorate(cls: Any) -> Any:
        plain = cls.__mro__[1]
        for name in names:

            def method(self: Any, *arguments: Any, name: str = name, **named: Any) -> Any:
                changed = plain(self)
                result = getattr(changed, name)(*arguments, **named)
                self._place.case.edit(self._changes(changed))
                if name == "setdefault":
                    return self[arguments[0]]
                return self if result is changed else result

            method.__name__, method.__doc__ = name, getattr(plain, name).__doc__
            setattr(cls, name, method)
        cls.__reduce__ = lambda self: (plain, (plain(self),))
        return cls

    return decorate


@_through_copy("__setitem__", "__delitem__", "__ior__", "pop", "popitem", "setdefault", "update", "clear")
class Tables(dict[str, V]):
    """Tables by name, such as the materials of a case; changes are validated at once."""

    __slots__ = ("_place",)
    _place: Place

    def _changes(self, changed: Mapping[str, Any]) -> list[tuple[KeyPath, Any]]:
        named = {**dict.fromkeys(self), **changed}
        return [((*self._place.path, name), table) for name, table in named.items() if table is not self.get(name)]


@_through_copy(
    *("__setitem__", "__delitem__", "__iadd__", "__imul__", "append", "extend", "insert", "pop", "remove", "clear"),
    *("reverse", "sort"),
)
class Rows(list[V]):
    """A list of tables, such as the walls of a case; changes are validated at once."""

    __slots__ = ("_place",)
    _place: Place

    def _changes(self, changed: list[Any]) -> list[tuple[KeyPath, Any]]:
        return [(self._place.path, changed)]


def attribute_of(key: str) -> str:
    """Return the attribute of a case for a top-level key."""
    return "point_mass" if key == "mass" else key


TABLES = {key: attribute_of(key) for key, field in CaseModel.model_fields.items() if shape_of(field).models}
"""Attributes of a case that are tables, by top-level key."""


def tables_of(case: CaseModel, given: bool = False) -> dict[str, Any]:
    """Return the nested tables of a case with all defaults, or as they were given; without absent tables.

    Tables over time from files have rows instead.
    """
    data = {"title": case.title, **({"plugins": list(case.plugins)} if case.plugins else {}), **_tables(case, given)}
    stages = [stage for stage in case.stage if not stage.derived]
    if stages:
        data["stage"] = [_stage(case, stage, given) for stage in stages]
    return data


def _tables(case: CaseModel, given: bool) -> dict[str, Any]:
    data: dict[str, Any] = {}
    for key, attribute in TABLES.items():
        content = case.__dict__[attribute]
        if isinstance(content, dict):
            data[key] = {name: table.as_table(given) for name, table in content.items()}
        elif isinstance(content, list):
            data[key] = [table.as_table(given) for table in content]
        elif content is not None:
            data[key] = content.as_table(given)
    data["initial"] = _initial(data["initial"])
    data["output"] = {key: value for key, value in data["output"].items() if value or not key.endswith("probe")}
    optional = [key for key in data if CaseModel.model_fields[key].default is None]
    return {key: value for key, value in data.items() if value or key in optional}


def _stage(case: CaseModel, stage: CaseModel, given: bool) -> dict[str, Any]:
    """Return name, analysis and given tables of a stage."""
    tables = _tables(stage, given)
    analysis = "time" if stage.time is not None else "static"
    empty = {key: [] if (key,) in LISTS else {} for key in stage.given}
    row = {"name": stage.name, **empty, **{key: tables[key] for key in (*stage.given, analysis) if key in tables}}
    if "output" in row:
        own = {key: row["output"][key] for key in StageOutput.model_fields if key in row["output"]}
        row["output"] = {k: v for k, v in own.items() if not given or v != getattr(case.output, k)}
    if "section" in row:  # a stage gives the prestress alone
        named = {name: str(stage.section[name].prestressed) for name in stage.stressed}
        row["section"] = {name: {key: getattr(stage.section[name], key)} for name, key in named.items()}
    return row


def _initial(entries: Sequence[Any]) -> dict[str, Any]:
    """Return the table [initial] of a list of its entries."""
    everywhere = [entry for entry in entries if not isinstance(entry, Mapping) or "node_set" not in entry]
    if len(everywhere) > 1 or not all(isinstance(entry, Mapping) for entry in everywhere):
        raise InputError("initial: expected tables, at most one of which has no node_set")
    on = [entry for entry in entries if "node_set" in entry]
    return {**(everywhere[0] if everywhere else {}), **({"on": on} if on else {})}


def changed_data(case: CaseModel, changes: Iterable[tuple[KeyPath, Any]]) -> dict[str, Any]:
    """Return the nested tables of a case with changes: values, tables or models at key paths; None removes a key.

    Raises
    ------
    InputError
        If a path leads through a value, or beyond the end of a list.
    """
    data = tables_of(case, given=True)
    for path, value in changes:
        value = plain(value)
        if path[-1:] == ("initial",) and isinstance(value, list):
            value = _initial(value)
        put(data, [str(part) for part in path], value, f"{case.source}: {key_text(path)}")
    return data


def key_path(case: CaseModel, key: str) -> KeyPath:
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
    if isinstance(old, dict):
        items = {name: merge(old.get(name), item) for name, item in new.items()}
        dict.clear(old)
        dict.update(old, items)
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


def merged_stages(old: tuple[CaseModel, ...], new: tuple[CaseModel, ...]) -> tuple[CaseModel, ...]:
    """Return the stages of ``new``, in the objects of ``old`` where their numbers agree."""
    if len(old) != len(new):
        return new
    for one, other in zip(old, new, strict=True):
        for key, value in other.__dict__.items():
            one.__dict__[key] = merge(one.__dict__.get(key), value)
    return old


def settle(case: CaseModel, attached: bool = True) -> None:
    """Give all tables of a case their places in it, or take these away."""
    owner = case if attached else None
    for k, stage in enumerate(case.stage):
        _settle(stage, None if stage.derived else owner, lambda key, k=k: _of_stage(case, k, key))
        stage.__dict__["editor"] = (case if attached else stage), stage.__dict__["editor"][1]
    _settle(case, owner, lambda key: (key,))


def _of_stage(case: CaseModel, k: int, key: str) -> KeyPath:
    """The place of a table that is in force in stage k: in the stage that gives it, or in the case."""
    if key == "section":  # of which a stage gives the prestress alone
        return (key,)
    if key in case.stage[k].given or key in (*ANALYSES, "name"):
        return "stage", k, key
    for j in range(k - 1, -1, -1) if key not in ONE_STAGE else ():
        if key in case.stage[j].given:
            return "stage", j, key
    return ("stage", k, key) if key in ONE_STAGE and k else (key,)


def _settle(case: CaseModel, owner: CaseModel | None, place: Callable[[str], KeyPath]) -> None:
    case.__dict__["editor"] = (case if owner is None else owner), place
    for key, attribute in TABLES.items():
        content = case.__dict__[attribute]
        if type(content) in (dict, list):
            content = case.__dict__[attribute] = Tables(content) if isinstance(content, dict) else Rows(content)
        for table, path in _placed(content, place(key)):
            object.__setattr__(table, "_place", None if owner is None else Place(owner, path))
    for k in range(case.number, -1, -1) if owner is not None and owner is not case else ():
        for name in owner.stage[k].stressed:
            section = case.section[name]
            if section._place.path[0] != "stage":
                object.__setattr__(section, "_place", Place(owner, ("stage", k, "section", name)))


def _placed(content: Any, path: KeyPath) -> Iterator[tuple[Any, KeyPath]]:
    """Yield the tables of some content of a case, and what has them, with their places."""
    if isinstance(content, Tables | Rows | StrictModel):
        yield content, path
    inner: Iterable[tuple[Any, KeyPath]] = ()
    if isinstance(content, StrictModel):
        slot = getattr(type(content), "slot", "")
        inner = ((item, path if key == slot else (*path, key)) for key, item in content.__dict__.items())
    elif isinstance(content, dict):
        inner = ((item, (*path, name)) for name, item in content.items())
    elif isinstance(content, list | tuple) and content and isinstance(content[0], StrictModel):
        everywhere = path[-1] == "initial" and content[0].node_set is None
        first = (*path, "on") if path[-1] == "initial" else path
        inner = ((item, (*first, i - everywhere)) for i, item in enumerate(content))
        if everywhere:
            inner = [(content[0], path), *list(inner)[1:]]
    for item, where in inner:
        yield from _placed(item, where)

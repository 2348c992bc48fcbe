"""The problems of a case in one message: file, key, value, what is expected. Errors of pydantic are translated here."""

from __future__ import annotations

import re
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from pydantic import ValidationError
from pydantic.fields import FieldInfo

from ..errors import InputError
from ..registry import nearest
from .base import DIGEST, StrictModel, WithFiles
from .files import TableFile
from .model import CaseModel, Chosen, Family, plain_type, shape_of
from .toml import KeyPath, key_text, short_text

MOST = 10
"""Maximum number of problems listed in a message; the others are counted."""

SI_HINT = "expected a number in SI units, without quotes and unit"


class Problems:
    """The list of problems of one case.

    Parameters
    ----------
    source : file or name of the case, for the message
    overridden : key paths that were set on the command line, which the message states if one of them is wrong
    named : names of tables by top-level key before that
    """

    def __init__(
        self, source: str, overridden: Iterable[KeyPath] = (), named: Mapping[str, Sequence[str]] | None = None
    ) -> None:
        self.source = source
        self.overridden, self._named = list(overridden), named or {}
        self.lines: list[str] = []

    def add(self, path: KeyPath, message: str, value: Any = None) -> None:
        """Add a problem; ``value`` is shown if given."""
        key = key_text(path)
        shown = f"{key} = {short_text(value)}" if value is not None else key
        origin = " (given by --set)" if any(path[: len(p)] == p for p in self.overridden) else ""
        line = f"{self.source}: {shown}{origin}: {message}" if key else f"{self.source}: {message}"
        known = self._named.get(str(path[0]), ()) if path else ()
        if known and len(path) > 2 and path[1] not in known and path[:2] in [p[:2] for p in self.overridden]:
            line += f"; --set makes a new table {key_text(path[:2])}, the case has {', '.join(known)}"
        if line not in self.lines:
            self.lines.append(line)

    def raise_if_any(self) -> None:
        """Raise one :class:`InputError` with every problem on its own line."""
        if not self.lines:
            return
        lines = self.lines[:MOST]
        if len(self.lines) > MOST:
            lines.append(f"{self.source}: ... and {len(self.lines) - MOST} more")
        raise InputError("\n".join(lines))

    def validated(
        self, model: type[StrictModel], data: Any, context: Any, place: Callable[[KeyPath], KeyPath] = tuple
    ) -> Any:
        """Return a validated table; if it is rejected, add the problems and return None.

        Parameters
        ----------
        model : the model of the table
        data : the table as read
        context : of the validation
        place : path in the case of a path within the table
        """
        try:
            return model.model_validate(data, context=context)
        except ValidationError as error:
            found = error.errors(include_url=False)
            for item in found:
                # a list is counted without its wrong items
                counted = item["type"] in ("too_short", "too_long")
                if counted and any(other["loc"][: len(item["loc"])] == item["loc"] != other["loc"] for other in found):
                    continue
                self._describe(_owner(model, item["loc"], data), item, place)
        return None

    def _describe(self, owner: Owner, item: Any, place: Callable[[KeyPath], KeyPath]) -> None:
        where, field = place(owner.path), owner.field
        kind, value, context = item["type"], item["input"], item.get("ctx", {})
        about = f" ({_unended(owner.about)})" if owner.about else ""
        if kind == "extra_forbidden":
            text = owner.unknown(str(where[-1]))
            if owner.taker and where not in self.overridden and any(p[:-1] == where[:-1] for p in self.overridden):
                text += f"; --set {key_text(where)}= removes it"
            self.add(where, text)
        elif kind == "missing" and owner.model is CaseModel:
            self.add((), f"the table [{key_text(where)}] is missing")
        elif kind == "missing" and isinstance(value, Mapping):
            self.add(where, f"this key is missing{about}")
        elif kind in ("missing", "too_long", "too_short") and isinstance(value, list | tuple):
            whole = where[:-1] if kind == "missing" else where
            bound = {"too_short": ("min_length", "at least"), "too_long": ("max_length", "at most")}.get(kind)
            size = f", {bound[1]} {context[bound[0]]}" if bound and not re.search(r"\d", _list_text(field)) else ""
            self.add(
                whole,
                f"expected {_list_text(field)}{size}, got {len(value)} value{'s' * (len(value) != 1)}{about}",
                value,
            )
        elif kind == "refused":
            self.add(where, context["text"], value)
        elif kind in ("value_error", "assertion_error"):
            self.add(where, str(context["error"]), None if isinstance(value, Mapping) else value)
        else:
            self.add(where, _tables_text(kind, owner) or _expected(kind, value, context, field) + about, value)


class Owner(NamedTuple):
    """The table that has a key, or lacks it.

    Attributes
    ----------
    model : of the table
    field : the last of the fields on the way to the key
    path : of the key in the case
    taker : what has these keys, if they are those of a module found by name
    family : to which the module belongs
    about : text of the field
    """

    model: type[StrictModel]
    field: FieldInfo | None
    path: KeyPath
    taker: str = ""
    family: Family | None = None
    about: str = ""

    def unknown(self, key: str) -> str:
        """Return the message for a key that the table does not have."""
        own = list(self.model.model_fields)
        if self.family is None:
            return f"unknown key{nearest(key, own)}"
        keys = ", ".join(own) if own else "no parameters"
        owners = [name for name, known in self.family.keys().items() if key in known]
        if owners:
            return f"a key of {', '.join(owners)}, not of {self.taker}, which takes {keys}"
        hint = nearest(key, [*own, *self.family.models[0].model_fields])
        return f"unknown key; {self.taker} takes {keys}" + (hint if hint.startswith(", did") else "")


def _owner(model: type[StrictModel], loc: KeyPath, data: Any) -> Owner:
    """Follow the path of an error through the models and the data to the table that it is about."""
    owner, rest = Owner(model, None, ()), [part for part in loc if part != "[key]"]  # which marks names of a table
    while rest:
        part = rest.pop(0)
        field = owner.model.model_fields.get(str(part))
        inner = field is not None and part == getattr(owner.model, "slot", None)  # its keys stand beside the others
        owner = owner._replace(path=owner.path if inner else (*owner.path, part))
        if field is None:  # an unknown key, or an index of numbers
            continue
        many, models, chosen = shape_of(field)
        data = data if inner else _item(data, part)
        owner = owner._replace(field=field, about=owner.model.description(str(part)))
        if many is not None and models and rest:
            data = _item(data, rest[0])
            owner = owner._replace(path=(*owner.path, rest.pop(0)))
        if not rest:
            break
        if issubclass(owner.model, WithFiles) and str(part).endswith("_file"):
            owner = owner._replace(model=TableFile, family=None)
        elif isinstance(chosen, Chosen) and isinstance(data, Mapping):
            found, family = chosen.found(data), chosen if isinstance(chosen, Family) else None
            owner = owner._replace(model=found or owner.model, family=family)
            if found is not None and family is not None:
                owner = owner._replace(taker=family.taker.format(family.name(data)))
        elif models:
            owner = owner._replace(model=models[0], family=None)
    return owner


def _tables_text(kind: str, owner: Owner) -> str:
    """Describe lists of tables and tables by name, where there is something else."""
    tables = owner.field is not None and shape_of(owner.field).models
    if tables and kind in ("list_type", "tuple_type"):
        return f"expected a list of tables, each under a heading [[{key_text(owner.path)}]]"
    if tables and kind == "dict_type":
        return f"expected tables, each under a heading [{key_text(owner.path)}.NAME]"
    return ""


def _unended(text: str) -> str:
    """Return a text in one line, without the full stop at its end; an ellipsis remains."""
    line = " ".join(text.split())
    return line if line.endswith("...") else line.removesuffix(".")


def _item(data: Any, key: str | int) -> Any:
    try:
        return data[key]
    except (LookupError, TypeError):
        return None


def _list_text(field: FieldInfo | None) -> str:
    """Describe the content of a list field by its type: ``a list of 3 numbers``."""
    annotation = plain_type(field.annotation) if field is not None else None
    arguments = typing.get_args(annotation)
    if typing.get_origin(annotation) is not tuple or not arguments:
        return "a list"
    words = {float: "numbers", int: "integers", str: "texts"}.get(plain_type(arguments[0]), "lists")
    return f"a list of {words}" if arguments[-1] is Ellipsis else f"a list of {len(arguments)} {words}"


_SIMPLE = {
    "too_short": "expected at least one entry",
    "float_type": "expected a number",
    "int_type": "expected an integer",
    "string_type": "expected a text in quotes",
    "bool_type": "expected true or false",
    "model_type": "expected a table",
    "finite_number": "expected a finite number",
    "string_too_short": "expected a non-empty text",
    "string_pattern_mismatch": "expected a name without slashes and control characters",
}
_BOUNDS = {"greater_than": ">", "greater_than_equal": ">=", "less_than": "<", "less_than_equal": "<="}


def _expected(kind: str, value: Any, context: Mapping[str, Any], field: FieldInfo | None) -> str:
    if kind in ("float_type", "int_type") and isinstance(value, str):
        return SI_HINT
    if kind == "float_type" and isinstance(value, int) and not isinstance(value, bool):
        return "expected a number that fits in double precision"
    if context.get("pattern") == DIGEST:
        return "expected 64 hexadecimal digits, as sha256sum prints them; without this key any file is accepted"
    if kind in _SIMPLE:
        return _SIMPLE[kind]
    if kind in _BOUNDS:
        (bound,) = (v for k, v in context.items() if k in ("gt", "ge", "lt", "le"))
        return f"expected a value {_BOUNDS[kind]} {bound:g}"
    if kind == "literal_error":
        choices = re.findall(r"'([^']*)'", context["expected"]) or [str(context["expected"]).lower()]
        hint = nearest(value, choices) if isinstance(value, str) else f"; known: {', '.join(choices)}"
        return "unknown value" + hint
    if kind in ("tuple_type", "list_type"):
        return f"expected {_list_text(field)}" + (
            ", in SI units without quotes and unit" if isinstance(value, str) else ""
        )
    return f"rejected ({kind.replace('_', ' ')})"

"""Collects all problems of a case and reports them in one message: file, key, value, what is expected."""

from __future__ import annotations

import re
import types
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypeVar

from pydantic import ValidationError
from pydantic.fields import FieldInfo

from ..errors import InputError
from ..registry import nearest
from .base import StrictModel
from .toml import value_text

__all__ = ["Path", "Problems", "key_text", "table_list"]

Path = tuple[str | int, ...]
"""Path of a value in the case: keys of tables and indices of lists."""

M = TypeVar("M", bound=StrictModel)

MOST = 10
"""Maximum number of problems listed in a message; the others are counted."""

SI_HINT = "expected a number in SI units, without quotes and unit"


def key_text(path: Path) -> str:
    """Return a key path as users write it: ``wall[0].normal``."""
    text = ""
    for part in path:
        if isinstance(part, int):
            text += f"[{part}]"
        else:
            text += ("." if text else "") + (part if re.fullmatch(r"[\w-]+", part) else value_text(part))
    return text


class Problems:
    """The list of problems of one case.

    Parameters
    ----------
    source : file or name of the case, for the message
    overridden : key paths that were set on the command line, which the message states if one of them is wrong
    """

    def __init__(self, source: str, overridden: Iterable[Path] = ()) -> None:
        self.source = source
        self.overridden = list(overridden)
        self.lines: list[str] = []

    def add(self, path: Path, message: str, value: Any = None) -> None:
        """Add a problem; ``value`` is shown if given."""
        key = key_text(path)
        shown = f"{key} = {_short(value)}" if value is not None else key
        origin = " (given by --set)" if any(path[: len(p)] == p for p in self.overridden) else ""
        line = f"{self.source}: {shown}{origin}: {message}" if key else f"{self.source}: {message}"
        if line not in self.lines:
            self.lines.append(line)

    def refer(self, path: Path, name: str, known: Sequence[str], what: str) -> None:
        """Add a problem if ``name`` is not one of the ``known`` names of a ``what``."""
        if name not in known:
            hint = nearest(name, list(known)) if known else "; the case defines none"
            if what == "node set":
                hint += f'; a group of the mesh becomes one by node_set.NAME = {{ group = "{name}" }}'
            self.add(path, f"there is no {what} of this name{hint}", name)

    def raise_if_any(self) -> None:
        """Raise one :class:`InputError` with every problem on its own line."""
        if not self.lines:
            return
        lines = self.lines[:MOST]
        if len(self.lines) > MOST:
            lines.append(f"{self.source}: ... and {len(self.lines) - MOST} more")
        raise InputError("\n".join(lines))

    def read(
        self,
        model: type[M],
        data: Any,
        path: Path,
        *,
        known: Sequence[str] = (),
        taker: str = "",
        siblings: Callable[[], Mapping[str, Sequence[str]]] = dict,
    ) -> M | None:
        """Validate a table; if it is rejected, add the problems and return None.

        Parameters
        ----------
        model : the model of the table
        data : the table as read
        path : of the table
        known : keys of the same table that do not belong to the model (for hints)
        taker : name of the scheme, generator or wall with these keys, for messages about unknown keys
        siblings : returns the alternatives by name with their keys, to identify the owner of a key
        """
        if not isinstance(data, Mapping):
            self.add(path, "expected a table", data)
            return None
        try:
            return model.model_validate(dict(data))
        except InputError as error:
            self.add(path, str(error))
        except ValidationError as error:
            for item in error.errors(include_url=False):
                self._describe(model, item, path, known, taker, siblings)
        return None

    def _describe(
        self,
        model: type[StrictModel],
        item: Any,
        path: Path,
        known: Sequence[str],
        taker: str,
        siblings: Callable[[], Mapping[str, Sequence[str]]],
    ) -> None:
        where: Path = (*path, *item["loc"])
        kind, value, context = item["type"], item["input"], item.get("ctx", {})
        inner, field = _innermost(model, item["loc"])
        about = (
            f" ({' '.join(field.description.split()).rstrip('.')})" if field is not None and field.description else ""
        )
        if kind == "extra_forbidden":
            key = str(item["loc"][-1])
            owners = [name for name, keys in siblings().items() if key in keys] if inner is model else []
            taker = taker if inner is model else ""
            text = _unknown_key(key, list(inner.model_fields), known, taker, owners)
            if taker and where not in self.overridden and any(p[:-1] == where[:-1] for p in self.overridden):
                text += f"; --set {key_text(where)}= removes it"
            self.add(where, text)
        elif kind == "missing" and isinstance(value, Mapping):
            self.add(where, f"this key is missing{about}")
        elif kind in ("missing", "too_long", "too_short") and isinstance(value, list | tuple):
            whole = where[:-1] if kind == "missing" else where
            self.add(whole, f"expected {_shape(field)}, got {len(value)} value{'s' * (len(value) != 1)}{about}", value)
        elif kind in ("value_error", "assertion_error"):
            self.add(where, str(context["error"]), None if isinstance(value, Mapping) else value)
        else:
            self.add(where, _expected(kind, value, context, field) + about, value)


def _innermost(model: type[StrictModel], path: Path) -> tuple[type[StrictModel], FieldInfo | None]:
    """Return the model of the table that a path within a table leads to, and the last of its fields on the way."""
    field = None
    for part in path:
        if isinstance(part, str) and part in model.model_fields:
            field = model.model_fields[part]
            annotation = _plain(field.annotation)
            if typing.get_origin(annotation) is dict:  # tables by name
                annotation = _plain(typing.get_args(annotation)[1])
            if isinstance(annotation, type) and issubclass(annotation, StrictModel):
                model = annotation
    return model, field


def _short(value: Any, most: int = 60) -> str:
    text = value_text(value)
    return text if len(text) <= most else f"{text[: most - 4]} ..."


def _unknown_key(key: str, own: list[str], shared: Sequence[str], taker: str, owners: Sequence[str]) -> str:
    if not taker:
        return f"unknown key{nearest(key, own)}"
    keys = ", ".join(own) if own else "no parameters"
    if owners:
        return f"a key of {', '.join(owners)}, not of {taker}, which takes {keys}"
    hint = nearest(key, [*own, *shared])
    return f"unknown key; {taker} takes {keys}" + (hint if hint.startswith(", did") else "")


def _plain(annotation: Any) -> Any:
    """Return a type without ``Annotated`` and ``None``."""
    while True:
        if typing.get_origin(annotation) is typing.Annotated:
            annotation = typing.get_args(annotation)[0]
        elif typing.get_origin(annotation) in (typing.Union, types.UnionType):
            annotation = next(a for a in typing.get_args(annotation) if a is not type(None))
        else:
            return annotation


def _shape(field: FieldInfo | None) -> str:
    """Describe the content of a list field by its type: ``a list of 3 numbers``."""
    annotation = _plain(field.annotation) if field is not None else None
    arguments = typing.get_args(annotation)
    if typing.get_origin(annotation) is not tuple or not arguments:
        return "a list"
    words = {float: "numbers", int: "integers", str: "texts"}.get(_plain(arguments[0]), "lists")
    return f"a list of {words}" if arguments[-1] is Ellipsis else f"a list of {len(arguments)} {words}"


_SIMPLE = {
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
        return f"expected {_shape(field)}" + (", in SI units without quotes and unit" if isinstance(value, str) else "")
    return f"rejected ({kind.replace('_', ' ')})"


def table_list(data: Any, path: Path, problems: Problems) -> Sequence[Any]:
    """Return the items of an optional list of tables."""
    if data is None:
        return ()
    if not isinstance(data, list | tuple):
        problems.add(path, f"expected a list of tables, each under a heading [[{'.'.join(map(str, path))}]]", data)
        return ()
    return data

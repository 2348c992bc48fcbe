"""Overrides of values of a case file: ``time.step=1e-5``, ``wall.0.point=[1.0, 0.0, 0.0]``, ``time.beta=``."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable
from typing import Any

from ..errors import InputError

__all__ = ["apply_overrides", "put", "split_key", "take_out"]

LISTS = {
    ("load",),
    ("support",),
    ("mass",),
    ("spring",),
    ("dashpot",),
    ("remove",),
    ("temperature",),
    ("wall",),
    ("contact_pair",),
    ("constraint",),
    ("initial", "on"),
    ("output", "probe"),
    ("stage",),
    *(("stage", *key) for key in (("load",), ("support",), ("temperature",), ("wall",), ("initial", "on"))),
}
"""Keys under which a missing value is created as a list of tables."""

DEEPEST = 100
"""Parts of a key."""

_PART = re.compile(r"""(?:"((?:[^"\\]|\\.)*)"|([^.\[\]"]+))|\[(\d+)\]""")


def apply_overrides(data: dict[str, Any], overrides: Iterable[str]) -> list[tuple[str | int, ...]]:
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
        If a text has no ``=``, or its path passes through a value that is not a table, or beyond the end of a list.
    """
    paths = []
    for text in overrides:
        key, equals, value = text.partition("=")
        parts = split_key(key.strip())
        if parts is not None and len(parts) > DEEPEST:
            raise InputError(f"--set {text[:40]} ...: a key of more than {DEEPEST} parts")
        if not equals or parts is None:
            raise InputError(f"--set {text}: expected KEY=VALUE, like time.step=1e-5 or wall.0.point=[1.0, 0.0, 0.0]")
        if not value.strip():
            take_out(data, parts)
            continue
        paths.append(put(data, parts, _value(value.strip()), f"--set {text}"))
    return paths


def _value(text: str) -> Any:
    try:
        read = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError):  # a syntax error, too many digits, nested too deep
        return text
    return read["value"] if len(read) == 1 else text


def split_key(key: str) -> list[str] | None:
    """Return the parts of a dotted path, including indices in brackets; None if it is malformed."""
    parts, position = [], 0
    while position < len(key):
        match = _PART.match(key, position)
        if match is None:
            return None
        quoted, bare, index = match.groups()
        parts.append(next(p.strip() for p in (quoted, bare, index) if p is not None))
        position = match.end()
        if position < len(key) and key[position] == ".":
            position += 1
            if position == len(key):
                return None
        elif position < len(key) and key[position] != "[":
            return None
    return parts if parts and all(parts) else None


def take_out(data: dict[str, Any], parts: list[str]) -> None:
    """Remove the value at the parts of a key, if it is there."""
    here: Any = data
    for k, part in enumerate(parts):
        key = int(part) if isinstance(here, list) and _is_place(part) else part
        if not (key in here if isinstance(here, dict) else isinstance(here, list) and key in range(len(here))):
            return
        if k == len(parts) - 1:
            del here[key]
        else:
            here = here[key]


def _is_place(part: str) -> bool:
    return part.isascii() and part.isdigit() and len(part) <= 18


def put(data: dict[str, Any], parts: list[str], value: Any, where: str) -> tuple[str | int, ...]:
    """Set the value at the parts of a key, and return its path; missing tables are created.

    Raises
    ------
    InputError
        Beginning with ``where``, if the key leads through a value, or beyond the end of a list.
    """
    path: tuple[str | int, ...] = ()
    here: Any = data
    for k, part in enumerate(parts):
        last = k == len(parts) - 1
        if isinstance(here, list):
            if not _is_place(part) or int(part) > len(here):
                raise InputError(
                    f"{where}: {part!r} is not an index of this list: 0 to {len(here)}, where the last one "
                    "appends an item"
                )
            key: str | int = int(part)
            if key == len(here):
                here.append({})
        elif isinstance(here, dict):
            key = part
            names = tuple(p for p in (*path, part) if isinstance(p, str))
            if key not in here:
                here[key] = [] if names in LISTS else {}
        else:
            raise InputError(f"{where}: {'.'.join(map(str, path))} is a value, not a table")
        path = (*path, key)
        if last:
            here[key] = value
        else:
            here = here[key]
    return path

"""Reads and writes TOML: tables of numbers, strings, booleans, lists and tables, as in case files."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from itertools import chain
from pathlib import PurePath
from typing import Any

import numpy as np

__all__ = ["cut_rows", "plain", "put_rows_back", "table_text", "value_text"]

_PLAIN = {float, int, str, bool}


def plain(value: Any, copied: bool = True) -> Any:
    """A copy of nested tables and lists in Python's own types, those of NumPy, tuples, ranges and paths resolved.

    Unless ``copied``, rows of numbers are not copied, of which tables over time may have many.
    """
    if isinstance(value, Mapping):
        return {key: plain(item, copied) for key, item in value.items()}
    if isinstance(value, list | tuple | range):
        if _has_rows(value):
            return list(map(list, value)) if copied else value
        return [item if type(item) in _PLAIN else plain(item, copied) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return str(value) if isinstance(value, PurePath) else value


def _has_rows(value: Any) -> bool:
    """Whether a value is a list of lists of plain values."""
    return (
        type(value) is list and set(map(type, value)) == {list} and set(map(type, chain.from_iterable(value))) <= _PLAIN
    )


_ROWS = re.compile(r"=\s*(\[\s*\[[-+0-9eE.,\s\[\]]{2000,}\])[ \t]*(?=[\r\n,}]|$)")


def cut_rows(text: str) -> tuple[str, list[Any]]:
    """Return TOML text with marks, which are texts, in the place of long lists of rows of numbers; and these lists.

    Such a list is mostly valid JSON, whose reader is fifty times as fast as that of TOML. Others stay in the text.
    """
    rows: list[Any] = []

    def cut(match: re.Match[str]) -> str:
        try:
            rows.append(json.loads(match[1]))
        except (ValueError, RecursionError):  # no JSON, or nested too deep
            return match[0]
        return f'= "{_MARK}{len(rows) - 1}"'

    return (text, []) if _MARK in text else (_ROWS.sub(cut, text), rows)


_MARK = "rows cut out: "


def put_rows_back(data: Any, rows: list[Any]) -> bool:
    """Replace the marks in nested tables by their lists; return False if one is missing, or part of a text."""
    found = 0
    left = [data]
    while left:
        here = left.pop()
        for key, item in here.items() if isinstance(here, dict) else enumerate(here):
            if isinstance(item, dict | list):
                left.append(item)
            elif isinstance(item, str) and _MARK in item:
                number = item.removeprefix(_MARK)
                if not number.isdigit():
                    return False
                here[key] = rows[int(number)]
                found += 1
    return found == len(rows)


def value_text(value: Any) -> str:
    """Return a value on one line of TOML, exact to the last digit."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007F")
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_key(k)} = {value_text(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(value_text(v) for v in value) + "]"
    if isinstance(value, int) and abs(value) >= 1 << 4096:
        return hex(value)  # Python limits the number of decimal digits of integers
    return repr(value) if isinstance(value, int | float) else str(value)


def table_text(table: Mapping[str, Any], path: str = "") -> str:
    """Return a table as TOML lines: values first, then tables and lists of tables under their own headings."""
    blocks = []
    lines = [f"{_key(k)} = {value_text(v)}\n" for k, v in table.items() if not _is_nested(v)]
    if lines:
        blocks.append("".join(lines))
    for key, value in table.items():
        if not _is_nested(value):
            continue
        name = f"{path}{_key(key)}"
        if isinstance(value, Mapping):
            only_tables = bool(value) and all(_is_nested(v) for v in value.values())
            blocks.append(("" if only_tables else f"[{name}]\n") + table_text(value, f"{name}."))
        else:
            blocks.extend(f"[[{name}]]\n" + table_text(item, f"{name}.") for item in value)
    return "\n".join(blocks)


def _is_nested(value: Any) -> bool:
    """Return whether a value gets its own heading: a table, or a list of tables (never an empty list)."""
    many = isinstance(value, list | tuple) and len(value) > 0 and all(isinstance(v, Mapping) for v in value)
    return isinstance(value, Mapping) or many


def _key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", str(key)) else value_text(key)

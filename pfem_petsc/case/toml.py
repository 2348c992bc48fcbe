"""Writes TOML: tables of numbers, strings, booleans, lists and tables, as in case files."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import PurePath
from typing import Any

import numpy as np

__all__ = ["plain", "table_text", "value_text"]


def plain(value: Any) -> Any:
    """A copy of nested tables and lists in Python's own types, those of NumPy, tuples, ranges and paths resolved."""
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | range):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return str(value) if isinstance(value, PurePath) else value


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
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else value_text(key)

"""The text of case files: the built-in ones, TOML that is read and written, and dotted keys."""

from __future__ import annotations

import difflib
import json
import re
import tomllib
from collections.abc import Mapping
from itertools import chain
from pathlib import Path, PurePath
from typing import Any

from ..errors import InputError
from ..files import readable_whole

FOLDER = Path(__file__).parent.parent / "cases"

KeyPath = tuple[str | int, ...]
"""Path of a value in a case: keys of tables and indices of lists."""

DEEPEST = 100
"""Largest number of parts of a dotted key; the parsing time grows with their square."""


def built_in_cases() -> list[str]:
    """Return the names of the built-in cases."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def built_in_path(name: str) -> Path | None:
    """Return the file of a built-in case, or None if there is no such case."""
    return FOLDER / f"{name}.toml" if name in built_in_cases() else None


def read_text(path: Path) -> str:
    """Return the text of a case file.

    Raises
    ------
    InputError
        If it cannot be read; the nearest built-in case is named.
    """
    try:
        return readable_whole(path).read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise InputError(f"{path}: line {line}: this is not UTF-8 text; a case file is TOML in UTF-8") from error
    except FileNotFoundError as error:
        names = built_in_cases()
        near = difflib.get_close_matches(str(path), names, n=1)
        hint = f"did you mean '{near[0]}'?" if near else f"the built-in cases are {', '.join(names)}"
        raise InputError(f"{path}: there is no such case file or built-in case; {hint}") from error
    except IsADirectoryError as error:
        raise InputError(
            f"{path}: this is a folder; name a case file or a built-in case, and the folder of its results by -o"
        ) from error
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: this case file cannot be read: {error}") from error


_LONG_KEY = re.compile(r"""(?:(?:[\w-]+|"[^"\n]*"|'[^'\n]*')[ \t]*\.[ \t]*)""" + f"{{{DEEPEST}}}")


def parse_toml(text: str, source: str) -> dict[str, Any]:
    """Parse TOML text to nested tables.

    Raises
    ------
    InputError
        On a syntax error; the message names line and column, and shows the line.
    """
    if (found := _LONG_KEY.search(text)) is not None:
        line = text.count("\n", 0, found.start()) + 1
        raise InputError(f"{source}: line {line}: this is not a case: a key of more than {DEEPEST} parts")
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{source}: this is not valid TOML{_both_headings(text)}: {pointed(text, error)}") from error
    except ValueError as error:
        # Python limits the number of digits of integers
        raise InputError(f"{source}: this is not a case: it has an integer of more than 4,300 digits") from error
    except RecursionError as error:
        raise InputError(f"{source}: this is not a case: its lists or tables are nested too deep") from error


def _both_headings(text: str) -> str:
    """Return a remark about headings of a table and of lists of tables with the same name."""
    single, double = (
        set(re.findall(rf"^[ \t]*{left}[ \t]*([\w.-]+)[ \t]*{right}", text, re.MULTILINE))
        for left, right in ((r"\[", r"\]"), (r"\[\[", r"\]\]"))
    )
    both = sorted(single & double)
    return f" ([{both[0]}] stands beside [[{both[0]}]], which each entry of the list has as heading)" if both else ""


_PLACE = re.compile(r" \(at (?:line (\d+), column (\d+)|end of document)\)$")
_SHOWN = 100  # letters of a line


def pointed(text: str, error: tomllib.TOMLDecodeError, start: int = 0) -> str:
    """Return what a parser found wrong in a text, and the line with a mark below the column.

    What it finds at the beginning of a line, such as a list that is still open, has its cause before: the line before
    is shown too. If the text begins at ``start``, with a value that was not read from a file, lines have no numbers.
    """
    found, lines = _PLACE.search(str(error)), text.replace("\r\n", "\n").rstrip().split("\n")
    line, column = (int(found[1]), int(found[2])) if found and found[1] else (len(lines), len(lines[-1]) + 1)
    if line > len(lines):
        line, column = len(lines), len(lines[-1]) + 1
    column -= start if line == 1 else 0
    lines[0] = lines[0][start:]
    first = max(0, column - _SHOWN * 3 // 4)
    before = [k for k in range(line - 1, 0, -1) if lines[k - 1].strip()][:1] if column == 1 else []
    heads = {k: "  " if start else f"  {k:{len(str(line))}} | " for k in (*before, line)}
    shown = [head + lines[k - 1].expandtabs(1)[first : first + _SHOWN] for k, head in heads.items()]
    mark = " " * (len(heads[line]) + column - 1 - first) + "^"
    return "\n".join([_PLACE.sub("", str(error)) if start else str(error), *shown, mark])


def plain(value: Any) -> Any:
    """Return nested tables and lists in Python's own types; NumPy's, tuples, ranges, paths and tables are resolved."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | range):
        if set(map(type, value)) == {list} and set(map(type, chain.from_iterable(value))) <= {float, int, str, bool}:
            return list(map(list, value))  # tables over time may have many rows
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):
        return value.tolist()
    if hasattr(value, "as_table"):  # a table of a case
        return plain(value.as_table(given=True))
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


def short_text(value: Any, most: int = 60) -> str:
    """Return a value on one line of TOML, or its beginning, for messages."""
    text = value_text(value)
    return text if len(text) <= most else f"{text[: most - 4]} ..."


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


def key_text(path: KeyPath) -> str:
    """Return a key path as users write it: ``wall[0].normal``."""
    text = ""
    for part in path:
        text += f"[{part}]" if isinstance(part, int) else ("." if text else "") + _key(part)
    return text


_PART = r"""(?:"(?:[^"\\]|\\.)*"|[^.\[\]"]+|\[\d+\])"""
_KEY = re.compile(rf"{_PART}(?:\.{_PART}|\[\d+\])*")


def split_key(key: str) -> list[str] | None:
    """Return the parts of a dotted path, including indices in brackets; None if it is malformed."""
    if _KEY.fullmatch(key) is None:
        return None
    parts = [part[1:-1].strip() if part[0] in '"[' else part.strip() for part in re.findall(_PART, key)]
    return parts if all(parts) else None

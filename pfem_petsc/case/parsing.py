"""Parses the TOML text of a case file to nested tables."""

from __future__ import annotations

import re
import tomllib
from typing import Any

from ..errors import InputError
from .toml import cut_rows, put_rows_back

__all__ = ["DEEPEST", "parse_toml"]

DEEPEST = 100
"""Maximum number of parts of a dotted key; the parsing time grows with their square."""
_LONG_KEY = re.compile(r"""(?:(?:[\w-]+|"[^"\n]*"|'[^'\n]*')[ \t]*\.[ \t]*)""" + f"{{{DEEPEST}}}")


def parse_toml(text: str, source: str) -> dict[str, Any]:
    """Parse TOML text to nested tables.

    Raises
    ------
    InputError
        On a syntax error; the message names line and column.
    """
    short, rows = cut_rows(text)
    if rows:
        try:
            data = tomllib.loads(_checked_keys(short, source))
        except ValueError:
            data = {}  # the whole text is read below, for the message
        if put_rows_back(data, rows):
            return data
    try:
        return tomllib.loads(_checked_keys(text, source))
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{source}: this is not valid TOML: {error}") from error
    except ValueError as error:
        # Python limits the number of digits of integers
        raise InputError(f"{source}: this is not a case: it has an integer of more than 4,300 digits") from error
    except RecursionError as error:
        raise InputError(f"{source}: this is not a case: its lists or tables are nested too deep") from error


def _checked_keys(text: str, source: str) -> str:
    if (found := _LONG_KEY.search(text)) is not None:
        line = text.count("\n", 0, found.start()) + 1
        raise InputError(f"{source}: line {line}: this is not a case: a key of more than {DEEPEST} parts")
    return text

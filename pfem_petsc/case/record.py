"""Acceleration records: text files with the columns t, ax, ay, az."""

from __future__ import annotations

import math
from pathlib import Path

from ..errors import InputError

__all__ = ["read_record"]


def read_record(path: Path) -> list[list[float]]:
    """Read rows [t, ax, ay, az] [s, m/s2] from a CSV file.

    Columns are separated by commas, semicolons, tabs or blanks; empty lines, lines that start with ``#`` and one
    heading are skipped.

    Raises
    ------
    InputError
        If the file cannot be read, or a line does not have four finite numbers; the message names the line.
    """
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError("this is not a text file; expected columns t, ax, ay, az [s, m/s2]") from error
    except (OSError, ValueError) as error:
        raise InputError(f"this file cannot be read: {error}") from error
    rows: list[list[float]] = []
    heading = False
    for number, line in enumerate(text.splitlines(), 1):
        words = line.replace(",", " ").replace(";", " ").split()
        if not words or words[0].startswith("#"):
            continue
        try:
            values = [float(word) for word in words]
        except ValueError as error:
            if not rows and not heading:
                heading = True
                continue
            raise InputError(f"line {number}: expected numbers t, ax, ay, az, got {line.strip()[:60]!r}") from error
        if len(values) != 4 or not all(map(math.isfinite, values)):
            raise InputError(f"line {number}: expected four finite numbers t, ax, ay, az, got {line.strip()[:60]!r}")
        if rows and values[0] <= rows[-1][0]:
            raise InputError(f"line {number}: times must increase, but {values[0]!r} follows {rows[-1][0]!r}")
        rows.append(values)
    if not rows:
        raise InputError("this file has no rows; expected columns t, ax, ay, az [s, m/s2]")
    return rows

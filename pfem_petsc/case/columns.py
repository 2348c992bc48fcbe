"""Columns of numbers in CSV, NPZ and NPY files."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..files import check_contents, readable_whole
from ..registry import nearest

__all__ = ["Columns", "file_columns"]


class Columns:
    """The columns of a file.

    Attributes
    ----------
    names : of the columns, None where they have none
    count : number of columns
    """

    names: list[str | None]
    count: int

    def __init__(
        self, names: list[str | None], values: Callable[[int], np.ndarray], where: Callable[[int], str]
    ) -> None:
        self.names, self.count = names, len(names)
        self._values, self.where = values, where
        self._read: dict[int, np.ndarray] = {}

    def find(self, column: str | int) -> int:
        """Return the number of a column given by name or number.

        Raises
        ------
        InputError
            If there is none, or several have the name.
        """
        if isinstance(column, int):
            if not 0 <= column < self.count:
                raise InputError(f"column {column} does not exist: the file has the columns 0 to {self.count - 1}")
            return column
        named = [name for name in self.names if name is not None]
        if column not in named:
            hint = nearest(column, named) if named else "; its columns have no names: give numbers, from 0"
            raise InputError(f"there is no column {column!r}{hint}")
        if named.count(column) > 1:
            raise InputError(f"there are {named.count(column)} columns {column!r}; give numbers, from 0")
        return self.names.index(column)

    def values(self, column: str | int) -> np.ndarray:
        """Return the numbers (n,) of a column, which may be missing or not finite where a cell is."""
        k = self.find(column)
        if k not in self._read:
            self._read[k] = self._values(k)
        return self._read[k]


def file_columns(path: Path) -> Columns:
    """Return the columns of a CSV, NPZ or NPY file.

    In CSV files, columns are separated by semicolons, commas, tabs or blanks; empty lines, lines that start with ``#``
    and headings before the first row are skipped; the last heading has the names of the columns. In NPZ files, each
    array (n,) is a column of its name, and each array (n, k) has the columns ``NAME[0]`` to ``NAME[k-1]``.

    Raises
    ------
    InputError
        If the file cannot be read, or has no rows, or rows of different lengths.
    """
    try:
        data = readable_whole(path).read_bytes()
    except (OSError, ValueError) as error:
        raise InputError(f"this file cannot be read: {error}") from error
    if data[:4] == b"PK\x03\x04" or data[:6] == b"\x93NUMPY":
        return _array_columns(path)
    try:
        return _text_columns(data.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise InputError("this is not a text file; expected CSV, NPZ or NPY") from error


def _array_columns(path: Path) -> Columns:
    try:
        found = np.load(path, allow_pickle=False)
        if not isinstance(found, np.ndarray):
            check_contents(found.zip)
        arrays = {"": found} if isinstance(found, np.ndarray) else {name: found[name] for name in found.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, KeyError) as error:
        raise InputError(f"this file cannot be read: {error}") from error
    names: list[str | None] = []
    columns: list[np.ndarray] = []
    for name, array in arrays.items():
        if array.ndim not in (1, 2) or array.dtype.kind not in "fiu":
            continue
        several = array.ndim == 2
        for k, column in enumerate(array.T if several else [array]):
            names.append((f"{name}[{k}]" if several else name) if name else None)
            columns.append(np.asarray(column, dtype=np.float64))
    if not any(len(column) for column in columns):
        raise InputError("this file has no columns of numbers: expected arrays (n,) or (n, k)")
    return Columns(names, lambda k: columns[k], lambda row: f"row {row}")


def _words(line: str) -> list[str]:
    """Split a line at semicolons, else at commas, else at white space."""
    for separator in (";", ","):
        if separator in line:
            words = [word.strip() for word in line.split(separator)]
            return words if words[-1] else words[:-1]
    return line.split()


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _is_heading(words: list[str]) -> bool:
    """Tell headings from rows, and from rows with a mistake: these start with a number, maybe with a decimal comma."""
    if any(words) and all(_is_number(word) for word in words if word):
        return False
    return not (_is_number(words[0]) or re.fullmatch(r"[-+.,eE\d]*\d[-+.,eE\d]*", words[0]))


def _text_columns(text: str) -> Columns:
    heading: list[str] = []
    rows: list[list[str]] = []
    numbers: list[int] = []
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        words = _words(line)
        if not rows and _is_heading(words):
            heading = [word.strip("\"'") for word in words]
            continue
        if rows and len(words) != len(rows[0]):
            raise InputError(
                f"line {number}: expected {len(rows[0])} columns as in line {numbers[0]}, got {line.strip()[:60]!r}; "
                "lines that are not rows must start with # or precede the first row"
            )
        rows.append(words)
        numbers.append(number)
    if not rows:
        raise InputError("this file has no rows")
    names = heading if len(heading) == len(rows[0]) else [None] * len(rows[0])

    def values(k: int) -> np.ndarray:
        found = np.empty(len(rows))
        for i, words in enumerate(rows):
            try:
                found[i] = float(words[k])
            except ValueError as error:
                shown = ", ".join(words)[:60]
                raise InputError(f"line {numbers[i]}: expected numbers, got {words[k]!r} in {shown!r}") from error
        return found

    return Columns(names, values, lambda row: f"line {numbers[row]}")

"""Tables over time from CSV, NPZ and NPY files: the columns of a key ``NAME_file`` become the rows of the key ``NAME``.

The resolved case has the rows, so that it does not depend on the file any more, and a restart compares them.
"""

from __future__ import annotations

import math
import re
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from ..errors import InputError
from ..registry import nearest
from .base import Finite, PositiveFloat, StrictModel, listed
from .problems import Path as KeyPath
from .problems import Problems

__all__ = ["COLUMNS", "Columns", "TableFile", "TableFiles", "file_columns"]

COLUMNS = {
    "acceleration": ("t", "ax", "ay", "az"),
    "motion": ("t", "dx", "dy", "dz"),
    "table": ("t", "value"),
    "velocity": ("t", "vx", "vy", "vz"),
}
"""Keys that can be given by a file, with the columns of their rows."""

_COUNTS = {2: "two", 4: "four"}


class TableFile(StrictModel):
    """A file with a table over time: columns are chosen, scaled and shifted."""

    file: Annotated[str, Field(min_length=1)]
    """CSV, NPZ or NPY file, relative to the case file"""
    columns: Annotated[tuple[str | int, ...], listed] | None = None
    """columns by name or number (from 0), the time first; "" is a column of zeros; default: all columns"""
    scale: Finite = 1.0
    """factor of the values, as 9.81 for accelerations in g"""
    offset: Finite = 0.0
    """added to the scaled values"""
    time_scale: PositiveFloat = 1.0
    """factor of the times, as 1e-3 for milliseconds"""
    time_offset: Finite = 0.0
    """added to the scaled times [s]"""


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
        data = path.read_bytes()
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
                "lines that are no rows start with #, or stand before the first row"
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


class TableFiles:
    """Replaces the keys ``NAME_file`` of tables by the rows of their files, each of which is read once.

    Parameters
    ----------
    folder : to which file names are relative
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._columns: dict[str, Columns] = {}

    def resolved(
        self, table: Any, path: KeyPath, problems: Problems, keys: tuple[str, ...], others: tuple[str, ...] = ()
    ) -> Any:
        """Return a table with rows for files, None if a file is refused.

        Parameters
        ----------
        table : as read
        path : of the table
        problems : receives what is wrong
        keys : names of :data:`COLUMNS` of which the table takes files
        others : further keys of which a table has at most one, beside one of ``keys``
        """
        if not isinstance(table, Mapping):
            return table
        for key in keys:
            name = f"{key}_file"
            if name not in table:
                continue
            exclusive = [*keys, *(f"{each}_file" for each in keys), *others]
            taken = [other for other in exclusive if other in table and other != name]
            if taken:
                problems.add(path, f"expected at most one of the keys {name}, {', '.join(taken)}")
                return None
            rows = self._rows(table[name], (*path, name), problems, COLUMNS[key])
            if rows is None:
                return None
            return {other: value for other, value in table.items() if other != name} | {key: rows}
        return table

    def _rows(self, given: Any, path: KeyPath, problems: Problems, names: tuple[str, ...]) -> list[list[float]] | None:
        if not isinstance(given, str | Mapping) or given == "":
            problems.add(path, "expected the name of a file, or a table with the key file", given)
            return None
        read = problems.read(TableFile, {"file": given} if isinstance(given, str) else given, path)
        if read is None:
            return None
        try:
            return self.rows(read, names)
        except InputError as error:
            problems.add(path, str(error), read.file)
            return None

    def rows(self, given: TableFile, names: tuple[str, ...]) -> list[list[float]]:
        """Return the rows of a file whose columns have the meanings ``names``.

        Raises
        ------
        InputError
            Without file and key; the line or row is named.
        """
        if given.file not in self._columns:
            self._columns[given.file] = file_columns(self.folder / given.file)
        file = self._columns[given.file]
        found = _chosen(file, given.columns, names)
        _check(file, found, names)
        times = found[0] if given.time_scale == 1.0 else given.time_scale * found[0]
        times = times if given.time_offset == 0.0 else times + given.time_offset
        values = found[1:] if given.scale == 1.0 else given.scale * found[1:]
        values = values if given.offset == 0.0 else values + given.offset
        return np.vstack([times, values]).T.tolist()


def _chosen(file: Columns, columns: tuple[str | int, ...] | None, names: tuple[str, ...]) -> np.ndarray:
    """Return the chosen columns (len(names), n)."""
    listed_names = ", ".join(names)
    if columns is None:
        if file.count != len(names):
            raise InputError(
                f"{file.where(0)}: expected {_COUNTS[len(names)]} finite numbers {listed_names}, got {file.count} "
                f"columns{_shown(file)}; choose columns by columns = [...]"
            )
        columns = tuple(range(file.count))
    if len(columns) != len(names):
        raise InputError(f"columns = {list(columns)}: expected {len(names)} columns, {listed_names}")
    if columns[0] == "":
        raise InputError('columns: the first column is the time, and cannot be ""')
    found = [None if column == "" else file.values(column) for column in columns]
    given = [array for array in found if array is not None]
    if len({len(array) for array in given}) > 1:
        raise InputError(f"the columns {list(columns)} have {[len(array) for array in given]} rows")
    return np.array([np.zeros(len(given[0])) if array is None else array for array in found])


def _shown(file: Columns) -> str:
    names = [name for name in file.names if name is not None]
    return f" ({', '.join(names)[:60]})" if names else ""


def _check(file: Columns, found: np.ndarray, names: tuple[str, ...]) -> None:
    bad = np.flatnonzero(~np.isfinite(found).all(axis=0))
    if len(bad):
        shown = ", ".join(f"{value:.6g}" for value in found[:, bad[0]])
        raise InputError(
            f"{file.where(int(bad[0]))}: expected {_COUNTS[len(names)]} finite numbers {', '.join(names)}, got {shown}"
        )
    late = np.flatnonzero(np.diff(found[0]) <= 0.0)
    if len(late):
        k = int(late[0])
        raise InputError(
            f"{file.where(k + 1)}: times must increase, but {found[0, k + 1].item()!r} follows {found[0, k].item()!r}"
        )
    if not len(found[0]) or not math.isfinite(found[0, 0]):
        raise InputError("this file has no rows")

"""Tables over time from CSV, NPZ and NPY files: the columns of a key ``NAME_file`` become the rows of the key ``NAME``.

The resolved case has the rows, so that it does not depend on the file any more, and a restart compares them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from ..errors import InputError
from .base import FileName, Finite, PositiveFloat, StrictModel, listed
from .columns import Columns, file_columns
from .problems import Path as KeyPath
from .problems import Problems

__all__ = ["COLUMNS", "TableFile", "TableFiles"]

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

    file: FileName
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
        """Return a table with rows for files, None if a file is rejected.

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

"""Data files of cases: columns of CSV, NPZ and NPY files, tables over time chosen from them, forces on many nodes.

Files of forces: NPZ files have the arrays ``time`` (n,) [s], ``nodes`` (m,) with node numbers of the mesh, and
``force``: (n, m, 3) [N], or (m, 3) [N] that are constant or multiplied by ``factor`` (n, m). Instead of ``nodes`` and
``force`` they may have an array (n, 3) for each node set, with its name. CSV files have a heading: the time first, then
``NAME.x``, ``NAME.y``, ``NAME.z`` for node sets or node numbers, in any order; components that are missing are zero.
"""

from __future__ import annotations

import csv
import hashlib
import re
import zipfile
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np

from ..errors import InputError
from ..files import check_contents, readable_whole
from ..registry import nearest
from .base import FileName, Finite, PositiveFloat, StrictModel, listed, refusal


class Columns:
    """The columns of a file.

    Attributes
    ----------
    names : of the columns, None where they have none; named : those that there are
    count : number of columns
    where : the line or row of a row, for messages
    """

    def __init__(
        self, names: list[str | None], values: Callable[[int], np.ndarray], where: Callable[[int], str]
    ) -> None:
        self.names, self.count = names, len(names)
        self.named = [name for name in names if name is not None]
        self._values, self.where = cache(values), where

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
        number = self.named.count(column)
        if number == 0:
            hint = nearest(column, self.named) if self.named else "; its columns have no names: give numbers, from 0"
            raise InputError(f"there is no column {column!r}{hint}")
        if number > 1:
            raise InputError(f"there are {number} columns {column!r}; give numbers, from 0")
        return self.names.index(column)

    def values(self, column: str | int) -> np.ndarray:
        """Return the numbers (n,) of a column, which may be missing or not finite where a cell is."""
        return self._values(self.find(column))


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
        raise _unreadable(path, error) from error
    if data[:4] == b"PK\x03\x04" or data[:6] == b"\x93NUMPY":
        return _array_columns(path)
    try:
        return _text_columns(data.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise InputError("this is not a text file; expected CSV, NPZ or NPY") from error


def _arrays(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of an NPZ file by name, or that of an NPY file."""
    try:
        found = np.load(path, allow_pickle=False)
        if isinstance(found, np.ndarray):
            return {"": found}
        with found:
            check_contents(found.zip)
            return {name: found[name] for name in found.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, KeyError) as error:
        raise InputError(f"this file cannot be read: {error}") from error


def _array_columns(path: Path) -> Columns:
    arrays = _arrays(path)
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
        for i in [i for i, words in enumerate(rows) if not _is_number(words[k])][:1]:
            shown = ", ".join(rows[i])[:60]
            raise InputError(f"line {numbers[i]}: expected numbers, got {rows[i][k]!r} in {shown!r}")
        return np.array([float(words[k]) for words in rows])

    return Columns(names, values, lambda row: f"line {numbers[row]}")


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


def rows_of(given: TableFile, file: Columns, names: tuple[str, ...]) -> list[list[float]]:
    """Return the rows of a file whose columns have the meanings ``names``, the time first.

    Raises
    ------
    InputError
        Without file and key; the line or row is named.
    """
    found = _chosen(file, given.columns, names)
    for k in np.flatnonzero(~np.isfinite(found).all(axis=0))[:1].tolist():
        shown = ", ".join(f"{value:.6g}" for value in found[:, k])
        raise InputError(
            f"{file.where(k)}: expected {_COUNTS[len(names)]} finite numbers {', '.join(names)}, got {shown}"
        )
    _checked_times(found[0], file.where)
    if not len(found[0]):
        raise InputError("this file has no rows")
    times, values = given.time_scale * found[0] + given.time_offset, given.scale * found[1:] + given.offset
    return np.vstack([times, values]).T.tolist()


_COUNTS = {2: "two", 4: "four"}


def _chosen(file: Columns, columns: tuple[str | int, ...] | None, names: tuple[str, ...]) -> np.ndarray:
    """Return the chosen columns (len(names), n)."""
    listed_names = ", ".join(names)
    if columns is None:
        shown = f" ({', '.join(file.named)[:60]})" if file.named else ""
        if file.count != len(names):
            raise InputError(
                f"{file.where(0)}: expected {_COUNTS[len(names)]} finite numbers {listed_names}, got {file.count} "
                f"columns{shown}; choose columns by columns = [...]"
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


_COMPONENT = re.compile(r"(.+)\.([xyz])")


class Forces(NamedTuple):
    """The content of a file.

    Attributes
    ----------
    times : (n,) [s]; one for constant forces
    targets : m node numbers, or names of node sets
    values : (n, k) columns over time
    columns : (e,) the column of each entry
    members : (e,) the target of each entry
    forces : (e, 3) [N]: an entry is a force times its column
    """

    times: np.ndarray
    targets: list[int | str]
    values: np.ndarray
    columns: np.ndarray
    members: np.ndarray
    forces: np.ndarray


def _unreadable(path: Path, error: Exception) -> InputError:
    """Return the refusal of a file, in which a file that is missing is named with its folder."""
    if isinstance(error, FileNotFoundError):
        folder = path.resolve().parent
        return InputError(f"there is no file {path.name} in {folder}; names of files are relative to the case file")
    return InputError(f"this file cannot be read: {error}")


def digest_of(path: Path) -> str:
    """Return a digest of the content of a file.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    try:
        with readable_whole(path).open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except (OSError, ValueError) as error:
        raise _unreadable(path, error) from error


def found_file(name: str, digest: str | None, folder: str | Path) -> dict[str, str]:
    """Return the keys ``file``, with its folder, and ``digest`` of a table, which is that of its content by default.

    Raises
    ------
    ValidationError
        If the file cannot be read.
    """
    path = Path(folder, name).resolve()
    try:
        return {"file": str(path), "digest": digest_of(path) if digest is None else digest}
    except InputError as error:
        raise refusal((("file",), str(error), name)) from error


def read_forces(path: Path, digest: str) -> Forces:
    """Read a file of forces.

    Parameters
    ----------
    path : CSV or NPZ file
    digest : of the content that the case was checked with

    Raises
    ------
    InputError
        If the file has changed, or is not as expected; the message does not name file and key.
    """
    if digest_of(path) != digest:
        raise InputError(
            f"this file is not the one that the case was made with (digest {digest[:12]}...): restore it, or start a "
            "new run without the key digest"
        )
    if not zipfile.is_zipfile(path):
        return _from_text(path)
    arrays = _arrays(path)
    for name, array in arrays.items():
        if array.dtype.kind not in "fiu":
            raise InputError(f"array {name!r} has the type {array.dtype}: expected numbers")
    return _from_arrays(arrays)


def _from_arrays(arrays: dict[str, np.ndarray]) -> Forces:
    if "force" not in arrays and "nodes" not in arrays:
        names = [name for name in arrays if name != "time"]
        if not names:
            raise InputError("expected the arrays time, nodes, force, or time and one array (n, 3) for each node set")
        times = _times(arrays)
        force = np.stack([_array(arrays, name, (len(times), 3)) for name in names], axis=1)
        return _histories(times, [_target(name) for name in names], force)
    for name in ("force", "nodes"):
        if name not in arrays:
            raise InputError(f"there is no array {name!r}; the file has {', '.join(arrays)}")
    for name in [name for name in arrays if name not in ("time", "nodes", "force", "factor")][:1]:
        raise InputError(f"there is an unknown array {name!r}; expected time, nodes, force, factor")
    nodes = arrays["nodes"]
    if nodes.ndim != 1 or nodes.dtype.kind not in "iu" or not len(nodes):
        raise InputError("array 'nodes': expected node numbers (m,)")
    if len(np.unique(nodes)) < len(nodes):
        raise InputError("array 'nodes': a node number is listed twice")
    every, targets = np.arange(len(nodes)), nodes.tolist()
    if arrays["force"].ndim == 3:
        if "factor" in arrays:
            raise InputError("array 'factor' requires forces (m, 3)")
        times = _times(arrays)
        return _histories(times, targets, _array(arrays, "force", (len(times), len(nodes), 3)))
    force = _array(arrays, "force", (len(nodes), 3))
    if "factor" in arrays:
        times = _times(arrays)
        return Forces(times, targets, _array(arrays, "factor", (len(times), len(nodes))), every, every, force)
    if "time" in arrays:
        raise InputError("array 'time' needs forces (n, m, 3), or an array factor (n, m)")
    return Forces(np.zeros(1), targets, np.ones((1, 1)), np.zeros_like(every), every, force)


def _array(arrays: dict[str, np.ndarray], name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Return an array of finite numbers of a shape."""
    array = np.asarray(arrays[name], dtype=np.float64)
    if array.shape != shape:
        raise InputError(f"array {name!r} has the shape {array.shape}: expected {shape}")
    for entry in np.argwhere(~np.isfinite(array))[:1].tolist():
        raise InputError(f"array {name!r}: entry {entry} is not finite")
    return array


def _from_text(path: Path) -> Forces:
    file = file_columns(path)
    targets: dict[int | str, int] = {}
    found: list[tuple[int, int, int]] = []
    for k in range(1, file.count):
        match = _COMPONENT.fullmatch(file.names[k] or "")
        if match is None:
            raise InputError(
                f"column {k} has the heading {file.names[k] or ''!r}: expected NAME.x, NAME.y or NAME.z, with a node "
                "set or a node number as NAME"
            )
        found.append((k, targets.setdefault(_target(match[1]), len(targets)), "xyz".index(match[2])))
    if not found:
        raise InputError("expected the time and columns NAME.x, NAME.y, NAME.z, with a heading")
    if len({each[1:] for each in found}) < len(found):
        raise InputError("two columns have the same heading")
    times = _checked_times(file.values(0), file.where)
    values = np.array([file.values(k) for k, _, _ in found]).T
    for row in np.flatnonzero(~np.isfinite(values).all(axis=1))[:1].tolist():
        raise InputError(f"{file.where(row)}: expected finite numbers")
    columns, members, components = np.arange(len(found)), *np.array(found).T[1:]
    return Forces(times, list(targets), values, columns, members, np.eye(3)[components])


def _target(name: str) -> int | str:
    return int(name) if re.fullmatch(r"\d{1,18}", name) else name


def _histories(times: np.ndarray, targets: list[int | str], force: np.ndarray) -> Forces:
    """Forces (n, m, 3), each component a column."""
    m = len(targets)
    every = np.arange(3 * m)
    return Forces(times, targets, force.reshape(-1, 3 * m), every, every // 3, np.tile(np.eye(3), (m, 1)))


def _times(arrays: dict[str, np.ndarray]) -> np.ndarray:
    if "time" not in arrays:
        raise InputError(f"there is no array 'time'; the file has {', '.join(arrays)}")
    times = np.asarray(arrays["time"], dtype=np.float64)
    if times.ndim != 1 or not len(times):
        raise InputError("array 'time': expected times (n,)")
    return _checked_times(times, lambda row: f"row {row}")


def _checked_times(times: np.ndarray, where: Callable[[int], str]) -> np.ndarray:
    for k in np.flatnonzero(~np.isfinite(times))[:1].tolist():
        raise InputError(f"{where(k)}: the time is not finite")
    for k in np.flatnonzero(np.diff(times) <= 0.0)[:1].tolist():
        raise InputError(
            f"{where(k + 1)}: times must increase, but {times[k + 1].item()!r} follows {times[k].item()!r}"
        )
    return times


def profile_of(path: Path, profile: str, keys: Sequence[str]) -> dict[str, float | str]:
    """Return the values of a profile in a catalogue, by key.

    The CSV file has a heading with ``profile`` and ``keys`` in SI units, and a line for each profile; cells may be
    empty, and lines that begin with ``#`` are skipped. Columns are separated by commas, semicolons or tabs.

    Raises
    ------
    InputError
        If the file cannot be read, or has another column, or not this profile, or twice.
    """
    try:
        text = readable_whole(path).read_text("utf-8-sig")
    except (OSError, ValueError) as error:
        raise _unreadable(path, error) from error
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    separator = max(",;\t", key=lines[0].count) if lines else ","
    rows = [[cell.strip() for cell in row] for row in csv.reader(lines, delimiter=separator)]
    if not rows or "profile" not in rows[0]:
        raise InputError("expected a heading with the column profile, and columns named by keys of sections")
    heading, *profiles = rows
    for column in [column for column in heading if column not in ("profile", *keys)][:1]:
        raise InputError(f"column {column!r} is no key of a section{nearest(column, list(keys))}")
    for row in [row for row in profiles if len(row) != len(heading)][:1]:
        raise InputError(f"the line {separator.join(row)!r} has {len(row)} cells, the heading {len(heading)}")
    named = [dict(zip(heading, row)) for row in profiles if row[heading.index("profile")] == profile]
    if len(named) > 1:
        raise InputError(f"{len(named)} profiles are called {profile!r}")
    if not named:
        known = [row[heading.index("profile")] for row in profiles]
        raise InputError(f"no profile is called {profile!r}{nearest(profile, known)}")
    values = {key: cell for key, cell in named[0].items() if cell and key != "profile"}
    return {key: float(cell) if _is_number(cell) else cell for key, cell in values.items()}

"""Pairs of text tables (NAME_nodes.csv, NAME_bars.csv) with names of columns in the first line.

``tower_nodes.csv`` goes with ``tower_bars.csv``; either names the mesh. Nodes have the columns ``x``, ``y``, ``z`` [m]
(``z`` may be missing), bars ``first`` and ``second``. Where the nodes have a column ``node``, its entries, numbers or
texts, name them in the other table, else they are numbered from 0. A column ``groups`` has names of groups with
semicolons between them; other columns of numbers are bar fields. Comma, semicolon (then with decimal commas as well)
or tab separates; lines that begin with # are left out.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Collection, Iterator
from itertools import islice
from pathlib import Path

import numpy as np

from ...errors import InputError
from ..whole import WholeMesh

__all__ = ["SUFFIXES", "pair", "read"]

SUFFIXES = (".csv",)

_NAMES = {
    "node": ("node", "id", "label", "name", "number", "nr", "no"),
    "x": ("x",),
    "y": ("y",),
    "z": ("z",),
    "bar": ("bar", "id", "label", "name", "number", "nr", "no", "element", "member"),
    "first": ("first", "start", "from", "a", "i", "node1", "node_1", "n1", "node_a", "node_i", "start_node"),
    "second": ("second", "end", "to", "b", "j", "node2", "node_2", "n2", "node_b", "node_j", "end_node"),
    "groups": ("groups", "group", "sets", "set"),
}
_WORDS = ("nodes", "bars")


def pair(path: Path) -> tuple[Path, Path]:
    """Return the names of the tables of nodes and of bars, one of which is ``path``.

    Raises
    ------
    InputError
        If the name has neither of the words.
    """
    for word in _WORDS:
        head, found, tail = path.stem.lower().rpartition(word)
        if found:
            start, stop = len(head), len(path.stem) - len(tail)
            both = [path.with_name(f"{path.stem[:start]}{each}{path.stem[stop:]}{path.suffix}") for each in _WORDS]
            both[_WORDS.index(word)] = path
            return both[0], both[1]
    raise InputError(
        f"{path}: a mesh in tables is a pair of files, {path.stem}_nodes.csv and {path.stem}_bars.csv: name one of them"
    )


def read(path: Path, fields: Collection[str] | None = None) -> WholeMesh:
    """Return the mesh in a pair of tables.

    Raises
    ------
    InputError
        Naming file, line and column, for any content that is not a mesh of bars.
    """
    of_nodes, of_bars = pair(path)
    nodes = _Table(of_nodes)
    points = np.stack(
        [nodes.numbers(axis) if nodes.column(axis, axis != "z") else np.zeros(nodes.n) for axis in "xyz"], axis=1
    )
    labels = list(nodes.texts("node")) if nodes.column("node", False) else [str(i) for i in range(nodes.n)]
    number: dict[str, int] = {}
    for i, label in enumerate(labels):
        number.setdefault(label, i)
    if len(number) < nodes.n:
        twice = next(i for i, label in enumerate(labels) if number[label] != i)
        raise InputError(f"{nodes.where(twice)}: node {labels[twice]!r} is listed more than once")
    of_groups = nodes.groups()
    del nodes, labels
    bars = _Table(of_bars)
    ends = np.empty((bars.n, 2), np.int64)
    for side, name in enumerate(("first", "second")):
        ends[:, side] = np.fromiter((number.get(label, -1) for label in bars.texts(name)), np.int64, bars.n)
        missing = np.flatnonzero(ends[:, side] < 0)
        if len(missing):
            row = int(missing[0])
            label = next(islice(bars.texts(name), row, None))
            raise InputError(f"{bars.where(row)}: there is no node {label!r} in {of_nodes.name}")
    mesh = WholeMesh(points, ends, of_groups, bars.groups())
    for name in bars.others():
        values = bars.maybe_numbers(name)
        if values is None:
            mesh.warnings.append(f"{of_bars}: left out column {name!r}, which has text other than numbers")
        else:
            mesh.bar_fields[name] = values
    return mesh


class _Table:
    """A table with names of columns."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            text = path.read_bytes().decode("utf-8-sig")
        except FileNotFoundError:
            raise InputError(f"{path}: there is no such file, the other table of the mesh") from None
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"{path}: cannot be read: {error}; save it as text in UTF-8") from None
        lines = text.splitlines()
        del text
        kept = [i for i, line in enumerate(lines) if line.strip(" ,;\t") and not line.lstrip().startswith("#")]
        if not kept:
            raise InputError(f"{path}: is empty: the first line has the names of the columns")
        head = lines[kept[0]]
        separator = max(";\t,", key=head.count)
        self._decimal_comma = separator == ";"
        self._lines = np.array(kept[1:], np.int64) + 1
        rows = csv.reader((lines[i] for i in kept), delimiter=separator, skipinitialspace=True, strict=True)
        self.n = len(kept) - 1
        del kept
        try:
            self._take(rows)
        except csv.Error as error:
            raise InputError(f"{path}: {error}") from None

    def _take(self, rows: Iterator[list[str]]) -> None:
        """Put the entries into columns, row by row; a large table has them once in memory, and repeated ones shared."""
        self.headings = [_without_unit(name) for name in next(rows)]
        self.names = [name.lower().replace(" ", "_") for name in self.headings]
        width, count = len(self.names), 0
        self._columns: list[list[str]] = [[] for _ in self.names]
        add = [column.append for column in self._columns]
        last = [""] * width
        for row in rows:
            if len(row) != width and (len(row) < width or any(word.strip() for word in row[width:])):
                raise InputError(f"{self.where(count)}: {len(row)} entries; expected {width}, as the first line has")
            for k in range(width):
                if row[k] != last[k]:
                    last[k] = row[k]
                add[k](last[k])
            count += 1
        if count != self.n:
            raise InputError(f"{self.path}: a text in quotes goes over several lines")

    def where(self, row: int) -> str:
        """Return file and line of a row."""
        return f"{self.path}: line {self._lines[row]}"

    def column(self, what: str, required: bool = True) -> int | None:
        """Return the place after the last of a column, so that it is true; None without it."""
        for name in _NAMES[what]:
            if name in self.names:
                return self.names.index(name) + 1
        if required:
            raise InputError(
                f"{self.path}: line 1: there is no column {what!r}; it has {', '.join(map(repr, self.names))}"
            )
        return None

    def texts(self, what: str) -> Iterator[str]:
        """Yield the entries of a column; whole numbers written as 3.0 or +3 are 3."""
        return map(_label, self._columns[self.column(what) - 1])  # type: ignore[operator]

    def numbers(self, what: str) -> np.ndarray:
        """Return the numbers of a column."""
        words = self._columns[self.column(what) - 1]  # type: ignore[operator]
        values = self._converted(words)
        if values is None:
            for row, word in enumerate(words):
                if self._converted([word]) is None:
                    raise InputError(f"{self.where(row)}: column {what!r}: {word[:40]!r} is not a number")
        return values  # type: ignore[return-value]

    def maybe_numbers(self, name: str) -> np.ndarray | None:
        """Return the numbers of a column; None if it has other text."""
        return self._converted(self._columns[self.headings.index(name)])

    def others(self) -> list[str]:
        """Return the names of columns of bars without a meaning of their own."""
        known = {self.column(what, False) for what in ("bar", "first", "second", "groups")}
        return [name for i, name in enumerate(self.headings) if name and i + 1 not in known]

    def groups(self) -> dict[str, np.ndarray]:
        """Return the members of the groups of the column ``groups``."""
        at = self.column("groups", False)
        found: dict[str, list[int]] = {}
        for row, word in enumerate(self._columns[at - 1] if at else ()):
            for name in word.split(";"):
                if name.strip():
                    found.setdefault(name.strip().replace("/", "_"), []).append(row)
        return {name: np.array(members, np.int64) for name, members in found.items()}

    def _converted(self, words: list[str]) -> np.ndarray | None:
        if self._decimal_comma:
            words = [word.replace(",", ".") for word in words]
        try:
            return np.fromiter(map(float, words), np.float64, len(words))
        except ValueError:
            return None


def _without_unit(name: str) -> str:
    """Return the name of a column without a unit in brackets; ``area`` is written in small letters."""
    name = re.sub(r"\s*[\[(].*?[\])]\s*$", "", name.strip()).strip()
    return "area" if name.lower() == "area" else name


def _label(word: str) -> str:
    word = word.strip()
    if word.isdigit() and (word[0] != "0" or word == "0"):
        return word
    try:
        value = float(word)
    except ValueError:
        return word
    return str(int(value)) if value.is_integer() and abs(value) < 2**53 else word

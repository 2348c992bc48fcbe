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

from ..errors import InputError
from ..mesh.whole import WholeMesh

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


def _pair(path: Path) -> tuple[Path, Path]:
    """Return the names of the tables of nodes and of bars, one of which is ``path``."""
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
    of_nodes, of_bars = _pair(path)
    nodes = _Table(of_nodes)
    axes = [nodes.numbers(axis) if axis != "z" or nodes.place("z") is not None else np.zeros(nodes.n) for axis in "xyz"]
    number: dict[str, int] = {}
    for i, label in enumerate(nodes.labels("node") if nodes.place("node") is not None else map(str, range(nodes.n))):
        if number.setdefault(label, i) != i:
            raise InputError(f"{nodes.where(i)}: node {label!r} is listed more than once")
    groups = nodes.groups()
    del nodes
    bars = _Table(of_bars)
    ends = np.empty((bars.n, 2), np.int64)
    for side, name in enumerate(("first", "second")):
        ends[:, side] = np.fromiter((number.get(label, -1) for label in bars.labels(name)), np.int64, bars.n)
        if (ends[:, side] < 0).any():
            row = int((ends[:, side] < 0).argmax())
            label = next(islice(bars.labels(name), row, None))
            raise InputError(f"{bars.where(row)}: there is no node {label!r} in {of_nodes.name}")
    mesh = WholeMesh(np.stack(axes, axis=1), ends, groups, bars.groups())
    known = {bars.place(what) for what in ("bar", "first", "second", "groups")}
    for place, (name, column) in enumerate(zip(bars.headings, bars.columns)):
        if name and place not in known:
            values = bars.converted(column)
            if values is None:
                mesh.warnings.append(f"{of_bars}: left out column {name!r}, which has text other than numbers")
            else:
                mesh.bar_fields[name] = values
    return mesh


class _Table:
    """A table with names of columns; ``headings`` are these without units, ``columns`` the entries."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            lines = path.read_bytes().decode("utf-8-sig").splitlines()
        except FileNotFoundError:
            raise InputError(f"{path}: there is no such file, the other table of the mesh") from None
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"{path}: cannot be read: {error}; save it as text in UTF-8") from None
        kept = [i for i, line in enumerate(lines) if line.strip(" ,;\t") and not line.lstrip().startswith("#")]
        if not kept:
            raise InputError(f"{path}: is empty: the first line has the names of the columns")
        separator = max(";\t,", key=lines[kept[0]].count)
        self._decimal_comma = separator == ";"
        self._lines = np.array(kept[1:], np.int64) + 1
        self.n = len(self._lines)
        texts = (lines[i] for i in kept)
        rows = csv.reader(texts, delimiter=separator, skipinitialspace=True, strict=True)
        try:
            self.headings = [_without_unit(name) for name in next(rows)]
            self.columns: list[list[str]] = [[] for _ in self.headings]
            count = self._fill(rows)
        except csv.Error as error:
            raise InputError(f"{path}: {error}") from None
        if count != self.n:
            raise InputError(f"{path}: a text in quotes goes over several lines")
        self._keys = [name.lower().replace(" ", "_") for name in self.headings]

    def _fill(self, rows: Iterator[list[str]]) -> int:
        """Put the entries into columns, row by row, which needs less memory and time; return the number of rows."""
        width, count = len(self.headings), 0
        for count, row in enumerate(rows, 1):
            if len(row) != width and (len(row) < width or any(word.strip() for word in row[width:])):
                where = self.where(count - 1)
                raise InputError(f"{where}: {len(row)} entries; expected {width}, as the first line has")
            for column, word in zip(self.columns, row):
                column.append(word)
        return count

    def where(self, row: int) -> str:
        """Return file and line of a row."""
        return f"{self.path}: line {self._lines[row]}"

    def place(self, what: str) -> int | None:
        """Return the place of the column of this meaning; None without it."""
        return next((self._keys.index(name) for name in _NAMES[what] if name in self._keys), None)

    def _column(self, what: str) -> list[str]:
        place = self.place(what)
        if place is None:
            has = ", ".join(map(repr, self._keys))
            raise InputError(f"{self.path}: line 1: there is no column {what!r}; it has {has}")
        return self.columns[place]

    def labels(self, what: str) -> Iterator[str]:
        """Yield the entries of a column; whole numbers written as 3.0 or +3 are 3."""
        return map(_label, self._column(what))

    def numbers(self, what: str) -> np.ndarray:
        """Return the numbers of a column."""
        words = self._column(what)
        values = self.converted(words)
        if values is None:
            row = next(row for row, word in enumerate(words) if self.converted([word]) is None)
            raise InputError(f"{self.where(row)}: column {what!r}: {words[row][:40]!r} is not a number")
        return values

    def converted(self, words: list[str]) -> np.ndarray | None:
        """Return entries as numbers; None if there is other text."""
        if self._decimal_comma:
            words = [word.replace(",", ".") for word in words]
        try:
            return np.fromiter(map(float, words), np.float64, len(words))
        except ValueError:
            return None

    def groups(self) -> dict[str, np.ndarray]:
        """Return the members of the groups of the column ``groups``."""
        found: dict[str, list[int]] = {}
        for row, word in enumerate(self._column("groups") if self.place("groups") is not None else ()):
            for name in word.split(";"):
                if name.strip():
                    found.setdefault(name.strip().replace("/", "_"), []).append(row)
        return {name: np.array(members, np.int64) for name, members in found.items()}


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


def write(path: Path, mesh: WholeMesh) -> None:
    """Write both tables, to the last digit; groups without members are not in them."""
    of_nodes, of_bars = _pair(path)
    _table(of_nodes, "node", {axis: mesh.points[:, i] for i, axis in enumerate("xyz")}, mesh.node_groups)
    columns = {"first": mesh.bars[:, 0], "second": mesh.bars[:, 1], **mesh.bar_fields}
    _table(of_bars, "bar", columns, mesh.bar_groups)


def _table(path: Path, number: str, columns: dict[str, np.ndarray], groups: dict[str, np.ndarray]) -> None:
    n = len(next(iter(columns.values())))
    texts = [""] * n
    for group, members in groups.items():
        name = group.replace(";", "_")
        for i in members.tolist():
            texts[i] += f";{name}" if texts[i] else name
    lists = [range(n), *(values.tolist() for values in columns.values()), *([texts] if groups else [])]
    with open(path, "w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow([number, *columns, *(["groups"] if groups else [])])
        table.writerows(zip(*lists, strict=True))

"""Pairs of text tables, of nodes and of bars, with names of columns in the first line.

``tower_nodes.csv`` goes with ``tower_bars.csv``, ``points.csv`` with ``edges.csv``; either names the mesh
(:func:`_pair`). Nodes have the columns ``x``, ``y``, ``z`` [m] (``z`` may be missing), bars those of their two ends.
Where the nodes have a column of ids, its entries, numbers or texts, name them in the other table, else they are
numbered from 0. :data:`_NODE_IDS`, :data:`_ENDS` and :data:`_AXES` have the names that are understood. A column
``groups`` has names of groups with semicolons between them; other columns of numbers are fields. Comma, semicolon (then
with decimal commas as well) or tab separates; lines that begin with # are left out.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Collection, Iterable, Iterator
from itertools import chain, islice
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..mesh.whole import WholeMesh

SUFFIXES = (".csv",)

_FILE_WORDS = (
    ("nodes", "node", "points", "point", "vertices", "vertex", "verts", "joints", "joint", "coordinates", "coords"),
    (
        *("bars", "bar", "elements", "element", "elems", "members", "member", "edges", "edge", "lines", "line"),
        *("frames", "frame", "beams", "beam", "rods", "rod", "struts", "strut", "links", "link", "trusses", "truss"),
        *("cables", "cable", "connectivity", "connections", "incidences", "topology"),
    ),
)
"""Words in names of tables of nodes, and of bars; the first of each are written."""


def _spellings(stems: Iterable[str], suffixes: Iterable[str]) -> list[str]:
    return [stem + suffix for stem in stems for suffix in suffixes]


_PLAIN = ("id", "label", "name", "number", "nr", "no", "num", "index", "idx", "key", "tag")
_TAILS = ("", *_PLAIN)
_OF_NODES = ("node", "point", "vertex", "joint", "vert", "pt", "nd", "grid")
_OF_BARS = ("bar", "element", "member", "edge", "line", "frame", "beam", "rod", "strut", "link", "truss", "elem")
_UNNAMED = ("", "unnamed0")  # what pandas calls the numbers of its rows
_NODE_IDS = (_spellings(_OF_NODES, _TAILS) + _spellings("nv", _PLAIN), [*_PLAIN, "n", *_UNNAMED])
"""Names of the column of ids of nodes, explicit ones first; here and below in small letters, without what separates."""
_BAR_IDS = [*_spellings((*_OF_BARS, "mem"), _TAILS), *_spellings(("e", "el", "m"), _PLAIN), *_PLAIN, *_UNNAMED]
_PLACES = ("coord", "coordinate", "coordinates", "coor", "pos", "position")
_AXES = [
    [axis, *_spellings([axis], (*_PLACES, "m")), *_spellings((*_PLACES, "node", "global"), [axis])] for axis in "xyz"
]
_SIDES = (("1", "2"), ("i", "j"), ("a", "b"), ("start", "end"), ("from", "to"), ("first", "second"))
_SIDES += (("source", "target"), ("begin", "end"), ("0", "1"), ("left", "right"), ("tail", "head"))
_ENDS = (
    [
        ("first", "second"),
        *(
            pair
            for stem in (*_OF_NODES, "end", "uniquept", *"npvjg")
            for one, two in _SIDES
            for tail in _TAILS
            for pair in ((stem + one + tail, stem + two + tail), (one + stem + tail, two + stem + tail))
        ),
    ],
    [(one + tail, two + tail) for one, two in _SIDES if len(one) > 1 for tail in _TAILS],
    [("i", "j"), ("u", "v"), ("a", "b")],
    [("I", "J"), ("U", "V"), ("A", "B")],
)
"""Pairs of names of the ends of bars, explicit ones first; letters alone count as they are written, because ``A`` and
``I`` may be areas and moments."""
_GROUPS = ["groups", "group", "sets", "set"]
_KNOWN_IDS = "node, node_id, id, nid, label, name, number, no, index"
_KNOWN_ENDS = "node1 and node2, start_node and end_node, n1 and n2, first and second, from and to, i and j, u and v"


def _pair(path: Path) -> tuple[Path, Path, list[str]]:
    """Return the tables of nodes and of bars, one of which is ``path``, and warnings.

    The other table has the same name with a word for the other kind; else it is the only other one in the folder whose
    columns are of that kind.

    Raises
    ------
    InputError
        If there is none, or more than one.
    """
    others = sorted(p for p in path.parent.iterdir() if p.suffix.lower() in SUFFIXES and p.name != path.name)
    named = {other.name.lower(): other for other in others}
    kind: int | None = None
    found: dict[tuple[int, Path], str] = {}
    for kind_of_word, start, stop in _words_in(path.stem):
        kind = kind_of_word
        names = [f"{path.stem[:start]}{word}{path.stem[stop:]}{path.suffix}" for word in _FILE_WORDS[1 - kind]]
        found |= {(kind, named[name.lower()]): "" for name in names if name.lower() in named}
    if not found:
        own = _kind(path)
        kind = kind if own is None else own
        fitting = [other for other in others if kind is not None and _kind(other) == 1 - kind]
        found = {(kind, other): f"{path}: goes with {other.name}, by the columns of both" for other in fitting}
    if len(found) == 1:
        (((kind, other), told),) = found.items()
        warnings = [told] * bool(told)
        return (path, other, warnings) if kind == 0 else (other, path, warnings)
    if found:
        names = ", ".join(other.name for _, other in found)
        hint = f"it may go with {names}: name the table of bars" if kind == 0 else f"it may go with {names}"
        raise InputError(f"{path}: a mesh in tables is a pair of files, and {hint}, or keep one pair in the folder")
    stem = path.stem if kind is None else re.sub("|".join(_FILE_WORDS[kind]), "", path.stem, flags=re.I).strip(" _-")
    pair = [f"{stem}{'_' * bool(stem)}{words[0]}.csv" for words in _FILE_WORDS]
    missing = "name one of them" if kind is None else f"there is no table of {('bars', 'nodes')[kind]} beside it"
    raise InputError(f"{path}: a mesh in tables is a pair of files, {pair[0]} and {pair[1]}: {missing}")


def _words_in(stem: str) -> list[tuple[int, int, int]]:
    """Return the words for a kind of table in a name, the last first: kind, and where it begins and ends."""
    words = [(kind, word) for kind, words in enumerate(_FILE_WORDS) for word in words]
    found = [(kind, *match.span()) for kind, word in words for match in re.finditer(word, stem.lower())]
    return sorted(found, key=lambda each: (each[2], each[2] - each[1], each[0]), reverse=True)


def _kind(path: Path) -> int | None:
    """Return 0 for a table with coordinates, 1 for one with ends of bars, None for another one."""
    try:
        table = _Table(path, head_only=True)
    except InputError:
        return None
    of_nodes = None not in (table.place(_AXES[0]), table.place(_AXES[1]))
    return 0 if of_nodes else 1 if table.pairs_of_ends() else None


def read(path: Path, fields: Collection[str] | None = None) -> WholeMesh:
    """Return the mesh in a pair of tables.

    Raises
    ------
    InputError
        Naming file, line and column, for any content that is not a mesh of bars.
    """
    of_nodes, of_bars, warnings = _pair(path)
    nodes, bars = _Table(of_nodes), _Table(of_bars)
    pair = bars.ends()
    axes = [nodes.numbers(axis, names) for axis, names in zip("xyz", _AXES)]
    ids, number = _numbers_of_ids(nodes, bars, pair)
    ends = np.empty((bars.n, 2), np.int64)
    named = (
        f"whose ids are in column {nodes.shown(ids)}, like {', '.join(islice(number, 3))}" if ids is not None else ""
    )
    for side, place in enumerate(pair):
        ends[:, side] = np.fromiter((number.get(label, -1) for label in bars.labels(place)), np.int64, bars.n)
        for row in np.flatnonzero(ends[:, side] < 0)[:1].tolist():
            label = next(islice(bars.labels(place), row, None))
            told = named or "where nodes are numbered from 0, because it has no column of ids"
            raise InputError(f"{bars.where(row)}: there is no node {label!r} in {of_nodes.name}, {told}")
    mesh = WholeMesh(np.stack(axes, axis=1), ends, nodes.groups(), bars.groups())
    coordinates = [place for place in map(nodes.place, _AXES) if place is not None]
    mesh.warnings = warnings + nodes.units(coordinates, "converts by --scale (0.001 for millimetres)")
    remedy = "converts the column area alone, by --scale squared, with the coordinates"
    mesh.warnings += bars.units([place for _, place in bars.others([])], remedy)
    used = [nodes.place(names) for names in (*_AXES, _GROUPS)]
    mesh.node_fields, texts = nodes.fields([*used, ids, *nodes.places(chain(*_NODE_IDS))])
    left = [f"left out columns {', '.join(map(repr, texts))}, which have other text than numbers"] * bool(texts)
    flat = ["has no column z: all nodes have z = 0"] * (used[2] is None)
    known = f"known are x, y, z, groups, and for ids {_KNOWN_IDS}; others are fields"
    mesh.tell(texts or (flat and mesh.node_fields), f"{of_nodes}: {'; '.join([*left, *flat, known])}")
    numbered = [place for place in bars.places(_BAR_IDS) if len(set(bars.columns[place])) == bars.n]
    mesh.bar_fields, texts = bars.fields([*pair, bars.place(_GROUPS), *numbered])
    mesh.warnings += [f"{of_bars}: left out column {name!r}, which has text other than numbers" for name in texts]
    return mesh


def _numbers_of_ids(nodes: _Table, bars: _Table, pair: tuple[int, int]) -> tuple[int | None, dict[str, int]]:
    """Return the column of ids, None for numbers from 0, and the number of the node of each.

    Raises
    ------
    InputError
        If several columns may be it, or one whose name is not understood, or a node is listed more than once.
    """

    def serves(place: int) -> bool:
        return wanted <= (labels := set(nodes.labels(place))) and len(labels) == nodes.n

    wanted = {label for place in pair for label in bars.labels(place)}
    candidates = next(filter(None, map(nodes.places, _NODE_IDS)), [])
    if len(candidates) > 1:
        candidates = list(filter(serves, candidates)) or candidates
    if len({tuple(nodes.labels(place)) for place in candidates}) > 1:
        which = " and ".join(map(nodes.shown, candidates))
        raise InputError(f"{nodes.path}: line 1: columns {which} may all be the ids of nodes: call one of them 'node'")
    if not candidates:
        rows = list(map(str, range(nodes.n)))
        for name, place in nodes.others(map(nodes.place, (*_AXES, _GROUPS))):
            if serves(place) and list(nodes.labels(place)) != rows:
                raise InputError(
                    f"{nodes.path}: line 1: column {name!r} may have the ids of nodes: call it 'node', or add a column "
                    f"'node' with the numbers from 0 if it does not (understood are {_KNOWN_IDS})"
                )
        return None, {label: i for i, label in enumerate(rows)}
    number: dict[str, int] = {}
    for i, label in enumerate(nodes.labels(candidates[0])):
        if number.setdefault(label, i) != i:
            column = nodes.shown(candidates[0])
            raise InputError(f"{nodes.where(i)}: node {label!r} is listed more than once in column {column}")
    return candidates[0], number


_UNIT = r"[\[(]\s*((?:mm|cm|dm|km|in|inch|ft|yd)[²2]?)\s*[\])]\s*$"


class _Table:
    """A table with names of columns; ``headings`` are these without units, ``columns`` the entries."""

    def __init__(self, path: Path, head_only: bool = False) -> None:
        self.path = path
        try:
            lines = path.read_bytes().decode("utf-8-sig").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"{path}: cannot be read: {error}; save it as text in UTF-8") from None
        kept = [i for i, line in enumerate(lines) if line.strip(" ,;\t") and not line.lstrip().startswith("#")]
        if not kept:
            raise InputError(f"{path}: is empty: the first line has the names of the columns")
        separator = max(";\t,", key=lines[kept[0]].count)
        above = kept[0] - 1
        # programs that write arrays put a # before the names of the columns
        words = lines[kept[0]].split(separator)
        numbers = any(re.fullmatch(r"\s*[-+]?\d*[.,]?\d+(e[-+]?\d+)?\s*", word, re.I) for word in words)
        if numbers and above >= 0 and lines[above].count(separator) == lines[kept[0]].count(separator) > 0:
            lines[above] = lines[above].lstrip("# ")
            kept.insert(0, above)
        self._decimal_comma = separator == ";"
        self._lines = np.array(kept[1:], np.int64) + 1
        self.n = len(self._lines)
        texts = (lines[i] for i in (kept[:1] if head_only else kept))
        try:
            self._given, *rows = csv.reader(texts, delimiter=separator, skipinitialspace=True, strict=True)
        except csv.Error as error:
            raise InputError(f"{path}: {error}") from None
        width = len(self._given)
        for k, row in enumerate(rows):
            if len(row) != width and (len(row) < width or any(word.strip() for word in row[width:])):
                raise InputError(f"{self.where(k)}: {len(row)} entries; expected {width}, as the first line has")
        if len(rows) != self.n and not head_only:
            raise InputError(f"{path}: a text in quotes goes over several lines")
        self.headings = [_without_unit(name) for name in self._given]
        self.columns = [list(column) for column in zip(*rows)] or [[] for _ in self._given]
        self._keys = [re.sub(r"[\W_]+", "", name.lower()) for name in self.headings]

    def where(self, row: int) -> str:
        """Return file and line of a row."""
        return f"{self.path}: line {self._lines[row]}"

    def shown(self, place: int) -> str:
        """Return the name of a column for messages."""
        return repr(self.headings[place])

    def places(self, names: Iterable[str]) -> list[int]:
        """Return the columns with one of these names; one without a name counts only as the first."""
        known = {*names}
        return [i for i, key in enumerate(self._keys) if key in known and (key or i == 0)]

    def place(self, names: Iterable[str]) -> int | None:
        """Return the first column with one of these names, in their order; None without it."""
        return next((self._keys.index(name) for name in names if name in self._keys), None)

    def pairs_of_ends(self) -> list[tuple[int, int]]:
        """Return the pairs of columns that may be the ends of bars, of the most explicit kind that there is."""
        for pairs, keys in zip(_ENDS, (self._keys, self._keys, self.headings, self.headings)):
            found = [(keys.index(one), keys.index(two)) for one, two in pairs if one in keys and two in keys]
            if found:
                return list(dict.fromkeys(found))
        return []

    def ends(self) -> tuple[int, int]:
        """Return the columns of the ends of bars."""
        found = self.pairs_of_ends()
        if len({tuple(map(tuple, (self.columns[one], self.columns[two]))) for one, two in found}) == 1:
            return found[0]
        if found:
            which = ", ".join(f"{self.shown(one)} and {self.shown(two)}" for one, two in found)
            raise InputError(f"{self.path}: line 1: {which} may be the ends of bars: call those 'node1' and 'node2'")
        raise InputError(
            f"{self.path}: line 1: there are no two columns for the ends of bars; it has {self._all()}; known are "
            f"{_KNOWN_ENDS}, with _id and the like after them"
        )

    def _all(self) -> str:
        return ", ".join(map(repr, self.headings))

    def others(self, used: Iterable[int | None]) -> Iterator[tuple[str, int]]:
        """Yield name and place of the columns that have a name and are not ``used``."""
        known = {*used}
        yield from ((name, i) for i, name in enumerate(self.headings) if name and i not in known)

    def fields(self, used: Iterable[int | None]) -> tuple[dict[str, np.ndarray], list[str]]:
        """Return the columns of numbers that are not ``used``, by name, and the names of those with other text."""
        found = {name: self.converted(self.columns[place]) for name, place in self.others(used)}
        texts = [name for name, values in found.items() if values is None]
        return {name: values for name, values in found.items() if values is not None}, texts

    def units(self, places: Iterable[int], remedy: str) -> list[str]:
        """Return a warning about columns in other units of length or area than metres; ``remedy``: of the verb mesh."""
        given = [(place, re.search(_UNIT, self._given[place])) for place in places]
        found = ", ".join(f"{self.shown(place)} in {unit[1]}" for place, unit in given if unit)
        told = "whose numbers are taken as they are; write them in metres and square metres; the verb mesh"
        return [f"{self.path}: has {found}, {told} {remedy}"] * bool(found)

    def labels(self, place: int) -> Iterator[str]:
        """Yield the entries of a column; whole numbers written as 3.0 or +3 are 3."""
        return map(_label, self.columns[place])

    def numbers(self, axis: str, names: list[str]) -> np.ndarray:
        """Return the coordinates along an axis; zero without a column z."""
        place = self.place(names)
        if place is None and axis == "z":
            return np.zeros(self.n)
        if place is None:
            known = f"known are {axis}, {axis}_coord, {axis}_coordinate, coord_{axis} and the like"
            raise InputError(f"{self.path}: line 1: there is no column {axis!r}; it has {self._all()}; {known}")
        words = self.columns[place]
        values = self.converted(words)
        for row in [k for k, word in enumerate(words) if self.converted([word]) is None][:1] if values is None else ():
            raise InputError(f"{self.where(row)}: column {self.shown(place)}: {words[row][:40]!r} is not a number")
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
        place = self.place(_GROUPS)
        for row, word in enumerate(() if place is None else self.columns[place]):
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
    kind, start, stop = next(iter(_words_in(path.stem)), (0, 0, 0))
    if not stop:
        pair = f"{path.stem}_nodes.csv and {path.stem}_bars.csv"
        raise InputError(f"{path}: a mesh in tables is a pair of files, {pair}: name one of them")
    other = path.with_name(f"{path.stem[:start]}{_FILE_WORDS[1 - kind][0]}{path.stem[stop:]}{path.suffix}")
    of_nodes, of_bars = (path, other) if kind == 0 else (other, path)
    columns = {axis: mesh.points[:, i] for i, axis in enumerate("xyz")}
    _table(of_nodes, "node", columns | mesh.node_fields, mesh.node_groups)
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

"""Abaqus input files (.inp): trusses with sets, sections, materials, supports and loads, flat or in parts.

T3D2 and T2D2 are bars; other trusses and beams are read as bars with a warning, other elements are left out with
one. Node sets and element sets are groups. Sections give the bar field ``area``; sections and materials are tables of
a case, as are fixed nodes, nodal forces and gravity up to the end of the first step, and its analysis. Included files
are read. Keywords that generate nodes and elements are rejected. Written files have T3D2 elements, sets, a section for
each area, and known materials; labels are the numbers from 1.
"""

from __future__ import annotations

import codecs
import math
import re
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import InputError
from ..files import readable_whole
from ..mesh.whole import WholeMesh
from ._numbers import number_of, numbers_of, shown, whole_numbers

SUFFIXES = (".inp",)

_MADE = "_section_"
"""Beginning of the names of element sets that the writer makes for areas."""
_REFUSED = ("NGEN", "NFILL", "NCOPY", "NMAP", "ELGEN", "ELCOPY", "SYSTEM", "PARAMETER", "SUBSTRUCTURE GENERATE")
_CONSTRAINTS = ("TIE", "EQUATION", "MPC", "COUPLING", "RIGID BODY", "EMBEDDED ELEMENT", "MULTIPLE POINT CONSTRAINT")
_PROCEDURES = (
    *("STATIC", "DYNAMIC", "FREQUENCY", "BUCKLE", "VISCO", "GEOSTATIC", "SOILS", "ANNEAL", "HEAT TRANSFER"),
    *("COUPLED TEMPERATURE-DISPLACEMENT", "DYNAMIC TEMPERATURE-DISPLACEMENT", "MODAL DYNAMIC", "DIRECT CYCLIC"),
    *("STEADY STATE DYNAMICS", "RESPONSE SPECTRUM", "RANDOM RESPONSE", "COMPLEX FREQUENCY", "MATRIX GENERATE"),
)
_PASSED_OVER = (
    *("HEADING", "PREPRINT", "RESTART", "MONITOR", "CONTROLS", "SURFACE", "ORIENTATION", "PHYSICAL CONSTANTS"),
    *("DISTRIBUTION", "DISTRIBUTION TABLE", "TRANSVERSE SHEAR STIFFNESS", "HOURGLASS STIFFNESS", "TIME POINTS"),
    *("DIAGNOSTICS", "STEP", "END STEP", "NODE", "ELEMENT", "NSET", "ELSET"),
)
"""Keywords that do not describe what a truss is or does, and those of the model, within a step; those of output are
others."""
_BARS = (
    (re.compile(r"T[23]D2[A-Z]*|TRUSS"), 2, ""),
    (re.compile(r"T[23]D3[A-Z]*"), 3, "trusses with three nodes are read as bars between their ends"),
    (re.compile(r"(B[23][13]|PIPE[23]1)[A-Z]*|FRAME[23]D"), 2, "beams are read as bars, without bending stiffness"),
    (
        re.compile(r"(B[23]2|PIPE[23]2)[A-Z]*"),
        3,
        "beams with three nodes are read as bars between their ends, without bending stiffness",
    ),
)
"""Types of elements that are bars, their numbers of nodes, and what is to be said about them."""
_ASSEMBLY = "*ASSEMBLY"
"""Key of the assembly among instances."""
_WHAT = {"NSET": "node", "ELSET": "element"}


def read(path: Path, fields: Collection[str] | None = None) -> WholeMesh:
    """Return the mesh in an Abaqus input file, with the field ``area`` if all bars have a section.

    Raises
    ------
    InputError
        Naming file and line, for any content that is not a mesh of bars.
    """
    deck = _Deck(path)
    for block in list(_blocks(path)):
        if not deck.add(block):
            break
    mesh = deck.mesh()
    if len(mesh.bars) == 0:
        raise InputError(f"{path}: has no trusses or beams, which would be bars")
    deck.add_sections(mesh)
    _Conditions(mesh, deck).add()
    if fields is None:  # of no interest to a run, which takes mesh and groups alone
        deck.add_analysis(mesh)
    lost = deck.labels_left_out
    if lost:
        text = ", ".join(map(str, lost[:5])) + (", ..." if len(lost) > 5 else "")
        mesh.warnings.append(f"{path}: left out {len(lost)} nodes where no bar ends (labels {text})")
    return mesh


# ---- keywords


_DEEPEST = 20
"""Number of files that include one another."""

_SHORT = 200
"""Number of letters up to which lines are read one by one, which is faster then."""

_COMMENT = re.compile(rb"^[ \t]*\*\*[^\n]*", re.MULTILINE)
_KEYWORD = re.compile(rb"(^[ \t]*\*(?:[^\n]*,[ \t]*\n(?![ \t]*\*))*[^\n]*\n?)", re.MULTILINE)
"""A line that begins with an asterisk, with those that continue it after a comma."""
_PARAMETERS = re.compile(r'(?:"[^"]*"|[^,"])+')
_BLANKS = bytes.maketrans(b",Dd", b" ee")  # of Fortran's exponents as well: 1.D+3


class _Piece(NamedTuple):
    """Data lines of a file, from the line of a number on."""

    path: Path
    line: int
    text: bytes


@dataclass
class _Block:
    """A keyword, in capitals without the asterisk, with its parameters and data lines."""

    path: Path
    line: int
    keyword: str
    parameters: dict[str, str]
    """Names in capitals."""
    pieces: list[_Piece] = field(default_factory=list)

    @property
    def where(self) -> str:
        """File and line, for messages."""
        return f"{self.path}: line {self.line}: *{self.keyword}"

    def get(self, name: str, default: str = "") -> str:
        """Return the value of a parameter."""
        return self.parameters.get(name, default)

    def required(self, name: str) -> str:
        """Return the value of a parameter that must be there."""
        value = self.parameters.get(name)
        if not value:
            raise InputError(f"{self.where}: the parameter {name}= is missing")
        return value

    def lines(self, *pieces: _Piece) -> Iterator[tuple[str, list[str]]]:
        """Return where it is, and the words between commas, of each data line; a last empty one is left out."""
        for path, first, text in pieces or self.pieces:
            for number, line in enumerate(text.split(b"\n"), first):
                if line.strip():
                    words = [word.strip() for word in line.decode("utf-8", "replace").split(",")]
                    some = words[:-1] if len(words) > 1 and not words[-1] else words
                    yield f"{path}: line {number}: *{self.keyword}", some

    def rows(self, width: int, least: int = 1) -> np.ndarray:
        """Return the numbers of all data lines, (lines, width): NaN where a line has fewer, and at least ``least``.

        Raises
        ------
        InputError
            Naming file and line, for anything else.
        """
        found = [np.empty((0, width))]
        for piece in self.pieces:
            alike = _alike(piece.text) if len(piece.text) > _SHORT else None
            if alike is not None and least <= alike.shape[1] <= width:
                found.append(np.pad(alike, ((0, 0), (0, width - alike.shape[1])), constant_values=np.nan))
            else:
                found += [_row(where, words, width, least) for where, words in self.lines(piece)]
        return np.concatenate(found)

    def numbers(self) -> np.ndarray | None:
        """Return all numbers of the data lines one after the other; None if there is anything else."""
        try:
            return np.concatenate([np.empty(0), *(numbers_of(piece.text.translate(_BLANKS)) for piece in self.pieces)])
        except ValueError:
            return None


def _row(where: str, words: list[str], width: int, least: int) -> np.ndarray:
    if not least <= len(words) <= width:
        raise InputError(
            f"{where}: {', '.join(words)[:60]!r} has {len(words)} values; expected {least} to {width} with commas"
        )
    row = np.full((1, width), np.nan)
    for k, word in enumerate(words):
        row[0, k] = number_of(word)
        if word and np.isnan(row[0, k]):
            raise InputError(f"{where}: {word[:40]!r} is not a number")
    return row


def _alike(text: bytes) -> np.ndarray | None:
    """Return the numbers of lines that have as many each, in a row each; None if they are not so simple."""
    text = text.rstrip(b"\n") + b"\n"
    for tail in (b", \n", b",\n", b"\n\n"):  # commas at the ends, and comments that were left out
        text = text.replace(tail, b"\n")
    try:
        values = numbers_of(text.translate(_BLANKS))
    except ValueError:
        return None
    letters = np.frombuffer(text, np.uint8)
    ends, commas = np.flatnonzero(letters == ord("\n")), np.flatnonzero(letters == ord(","))
    commas = np.diff(np.searchsorted(commas, ends), prepend=0)
    columns = int(commas[0]) + 1
    simple = (commas == commas[0]).all() and len(values) == len(commas) * columns
    return values.reshape(-1, columns) if simple else None


def _blocks(path: Path, above: tuple[Path, ...] = (), before: _Block | None = None) -> Iterator[_Block]:
    """Yield the blocks of a file, and of those that it includes; a block is complete when the next one comes.

    ``above`` are the files that include this one, and ``before`` is the block at that place, whose data may go on here.

    Raises
    ------
    InputError
        For data before the first keyword, and files that cannot be included.
    """
    try:
        content = readable_whole(path).read_bytes().removeprefix(codecs.BOM_UTF8)
    except OSError as error:
        raise InputError(f"{path}: cannot open: {error.strerror}") from None
    if b"\0" in content:
        raise InputError(f"{path}: is not text: save it as an Abaqus input file in UTF-8 or ASCII")
    content = content.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    line, block = 1, before
    for k, text in enumerate(_KEYWORD.split(_COMMENT.sub(b"", content))):
        if k % 2:
            found = _keyword(path, line, text.decode("utf-8", "replace"))
            if found.keyword != "INCLUDE":
                block = found
                yield block
            if found.keyword == "INCLUDE" or "INPUT" in found.parameters:
                for inner in _blocks(_included(found, path, above), (*above, path), block):
                    block = inner
                    yield inner
        elif text.strip():
            if block is None:
                first = shown(text.strip().split(b"\n")[0])
                raise InputError(f"{path}: line {line}: {first!r} precedes the first *KEYWORD")
            block.pieces.append(_Piece(path, line, text))
        line += text.count(b"\n")


def _keyword(path: Path, line: int, text: str) -> _Block:
    words = [word.strip() for word in _PARAMETERS.findall(text.lstrip("* \t"))]
    if not words or not words[0]:
        raise InputError(f"{path}: line {line}: {text.strip()[:60]!r} is no keyword")
    keyword, *pairs = [(" ".join(name.upper().split()), value) for name, _, value in (w.partition("=") for w in words)]
    return _Block(path, line, keyword[0], {name: value.strip().strip('"') for name, value in pairs})


def _included(block: _Block, path: Path, above: tuple[Path, ...]) -> Path:
    name = block.required("INPUT")
    file = (above[0] if above else path).parent / name
    if len(above) >= _DEEPEST or file.resolve() in {other.resolve() for other in (*above, path)}:
        raise InputError(f"{block.where}: {name} includes itself")
    if not file.is_file():
        raise InputError(f"{block.where}: there is no file {file}")
    return file


# ---- the model: parts, instances and sets, as one mesh


class _Labels(NamedTuple):
    """Members of a set: labels (n,), or first, last and step of labels, of which not all need exist."""

    labels: np.ndarray
    generated: bool = False
    instance: str = ""
    """Whose labels they are, in capitals; empty: those of the place of the set."""

    def within(self, known: np.ndarray) -> np.ndarray:
        """Return which of some labels (n,) are members."""
        if not self.generated:
            return np.isin(known, self.labels)
        first, last, step = self.labels.tolist()
        return (known >= first) & (known <= last) & ((known - first) % step == 0)


@dataclass
class _Set:
    """A set of nodes or elements."""

    name: str
    entries: list[_Labels] = field(default_factory=list)
    internal: bool = True
    """Whether the file says of all its parts that a program has made them."""


_NOTHING = np.empty(0, np.int64)


@dataclass
class _Scope:
    """A part, an instance, the assembly, or what stands outside of them, each with labels of its own."""

    name: str = ""
    nodes: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)
    """Labels (n,) and points (n, 3)."""
    elements: list[tuple[_Block, np.ndarray, np.ndarray]] = field(default_factory=list)
    """Where, labels (n,), labels of the nodes (n, 2 or 3)."""
    sets: dict[str, dict[str, _Set]] = field(default_factory=lambda: {"NSET": {}, "ELSET": {}})
    """By names in capitals."""
    sections: list[tuple[_Block, str]] = field(default_factory=list)
    """Where, and the element set."""
    place: np.ndarray = field(default_factory=lambda: np.eye(4, 3))
    at: dict[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    """Labels of nodes and bars, ascending, and their numbers in the mesh."""

    def instance(self, name: str, place: np.ndarray) -> _Scope:
        """Return an instance of a part, to which content of its own can be added."""
        sets = {
            kind: {upper: replace(one, entries=list(one.entries)) for upper, one in found.items()}
            for kind, found in self.sets.items()
        }
        return _Scope(name, list(self.nodes), list(self.elements), sets, list(self.sections), place)

    def add(self, kind: str, name: str, block: _Block, entries: Iterable[_Labels]) -> None:
        """Add members to a set."""
        members = list(entries)  # which may name this set as it is so far
        found = self.sets[kind].setdefault(name.upper(), _Set(name))
        found.entries += members
        found.internal &= "INTERNAL" in block.parameters

    def placed(self, path: Path, n_nodes: int, n_bars: int) -> tuple[np.ndarray, ...]:
        """Number nodes and bars from ``n_nodes`` and ``n_bars``; return labels and points of nodes, and bars (n, 2)."""
        labels = np.concatenate([_NOTHING, *(own for own, _ in self.nodes)])
        points = np.concatenate([np.empty((0, 3)), *(own for _, own in self.nodes)])
        known, first, at = np.unique(labels, return_index=True, return_inverse=True)
        if len(known) < len(labels):
            moved = np.flatnonzero((points != points[first[at.ravel()]]).any(axis=1))
            if len(moved):
                raise InputError(
                    f"{path}: *NODE: node {labels[moved[0]]} is listed more than once, at different positions"
                )
            keep = np.sort(first)
            labels, points = labels[keep], points[keep]
        order = np.argsort(labels, kind="stable")
        ends = [np.empty((0, 2), np.int64)]
        for block, own, wanted in self.elements:
            found, there = _found(known, wanted)
            if not there.all():
                element, side = np.argwhere(~there)[0]
                text = f"node {wanted[element, side]} of element {own[element]} is not defined"
                raise InputError(f"{block.where}: {text}")
            ends.append(_ends(order[found], points))
        bars = np.concatenate([_NOTHING, *(own for _, own, _ in self.elements)])
        sequence = np.argsort(bars, kind="stable")
        twice = np.flatnonzero(np.diff(bars[sequence]) == 0)
        if len(twice):
            raise InputError(f"{path}: *ELEMENT: element {bars[sequence[twice[0]]]} is listed more than once")
        self.at = {"NSET": (known, order + n_nodes), "ELSET": (bars[sequence], sequence + n_bars)}
        if not np.array_equal(self.place, np.eye(4, 3)):
            points = points @ self.place[:3] + self.place[3]
        return labels, points, np.concatenate(ends) + n_nodes


def _found(known: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where labels are among ascending ones, and whether they are there."""
    place = np.minimum(np.searchsorted(known, wanted), max(len(known) - 1, 0))
    return place, known[place] == wanted if len(known) else np.zeros(wanted.shape, bool)


def _ends(nodes: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the ends (n, 2) of elements with nodes (n, 2 or 3): of three nodes, those that are farthest apart."""
    if nodes.shape[1] == 2:
        return nodes
    pairs = np.array([[1, 2], [0, 2], [0, 1]])
    span = np.linalg.norm(points[nodes[:, pairs[:, 1]]] - points[nodes[:, pairs[:, 0]]], axis=2)
    return np.take_along_axis(nodes, pairs[span.argmax(axis=1)], axis=1)


def _labels(values: np.ndarray, block: _Block, what: str) -> np.ndarray:
    refused = "{}: {} is not the label of a {}: a whole number from 1 on"
    return whole_numbers(values, 1, 2**53, lambda found: refused.format(block.where, found, what))


def _union(parts: list[np.ndarray]) -> np.ndarray:
    """Return the members (n,) of sets, ascending; files with a set for each bar have very many of one member."""
    if len(parts) == 1 and len(parts[0]) == 1:
        return parts[0]
    return np.unique(np.concatenate([_NOTHING, *parts]))


def _placing(block: _Block) -> np.ndarray:
    """The place of an instance: (4, 3), a rotation applied to rows from the right, then a translation.

    The first data line has the translation, the second two points of an axis and an angle [degrees] about it, which
    turns the instance after the translation.
    """
    from scipy.spatial.transform import Rotation  # takes longer than most files

    rows = np.nan_to_num(block.rows(7, 3))
    move = rows[0, :3] if len(rows) else np.zeros(3)
    if len(rows) < 2:
        return np.vstack([np.eye(3), move])
    start, axis = rows[1, :3], rows[1, 3:6] - rows[1, :3]
    if not axis.any():
        raise InputError(f"{block.where}: the axis of the rotation has no length")
    turn = Rotation.from_rotvec(np.radians(rows[1, 6]) * axis / np.linalg.norm(axis)).as_matrix()
    return np.vstack([turn.T, (move - start) @ turn.T + start])


class _Deck:
    """What the keywords up to the end of the first step say."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.parts: dict[str, _Scope] = {}
        self.scopes = {"": _Scope()}
        """What has nodes and elements: outside of parts, instances by their names in capitals, and the assembly."""
        self.assembly = _Scope()
        self.conditions: list[_Block] = []
        self.warnings: list[str] = []
        self._scope = self._outer = self.scopes[""]
        self._in_step = self._ended = False
        self._procedure = self._beyond = None
        self._notes: dict[str, int] = {}
        self._other_types: set[str] = set()
        self._constraints: dict[str, None] = {}
        self._unread: dict[str, None] = {}
        self._materials: dict[str, tuple[str, dict[str, Any]]] = {}
        self._material: dict[str, Any] = {}

    def add(self, block: _Block) -> bool:
        """Read a keyword; return whether to go on."""
        keyword = block.keyword
        if self._ended:
            self._beyond = block if keyword == "STEP" else None
        elif keyword in ("BOUNDARY", "CLOAD", "DLOAD"):
            self.conditions.append(block)
        elif keyword == "STEP":
            self._in_step = True
        elif self._in_step:
            self._ended = keyword == "END STEP"
            if self._procedure is None and keyword in _PROCEDURES:
                self._procedure = block
            else:
                self._leave_out(keyword)
        else:
            self._add_to_model(block)
        return self._beyond is None

    def _leave_out(self, keyword: str) -> None:
        if keyword not in _PASSED_OVER and not {"OUTPUT", "PRINT", "FILE"} & set(keyword.split()):
            self._unread[f"*{keyword}"] = None

    def _add_to_model(self, block: _Block) -> None:
        match block.keyword:
            case "PART" | "INSTANCE" | "ASSEMBLY" | "END PART" | "END INSTANCE" | "END ASSEMBLY":
                self._open_scope(block)
            case "NODE":
                self._add_nodes(block)
            case "ELEMENT":
                self._add_elements(block)
            case "NSET" | "ELSET" as kind:
                self._scope.add(kind, block.required(kind), block, self._entries(kind, block))
            case "SOLID SECTION" | "BEAM SECTION" | "BEAM GENERAL SECTION":
                self._scope.sections.append((block, block.required("ELSET")))
            case "MATERIAL":
                name = block.required("NAME")
                _, self._material = self._materials.setdefault(name.upper(), (name, {}))
            case "ELASTIC" | "DENSITY" | "EXPANSION" | "PLASTIC" | "DAMPING":
                told = _material_value(block, self._material)
                self.warnings += [f"{block.where}: {told}"] if told else []
            case keyword if keyword in _CONSTRAINTS:
                self._constraints[f"*{keyword}"] = None
            case keyword if keyword in _REFUSED:
                raise InputError(
                    f"{block.where} is not read: write the nodes and elements one by one (Abaqus/CAE and most "
                    "preprocessors do)"
                )
            case keyword:
                self._leave_out(keyword)

    def _open_scope(self, block: _Block) -> None:
        """Make what follows the content of a part, an instance or the assembly, or of what is around it."""
        name, scope = block.get("NAME"), self._scope
        match block.keyword:
            case "PART":
                self._scope = _Scope(block.required("NAME"))
                if self.parts.setdefault(name.upper(), self._scope) is not self._scope:
                    raise InputError(f"{block.where}: there are two parts of the name {name}")
            case "INSTANCE":
                part = self.parts.get(block.required("PART").upper())
                if part is None:
                    raise InputError(f"{block.where}: there is no part {block.get('PART')}")
                self._outer, self._scope = scope, part.instance(block.required("NAME"), _placing(block))
                if self.scopes.setdefault(name.upper(), self._scope) is not self._scope:
                    raise InputError(f"{block.where}: there are two instances of the name {name}")
            case "ASSEMBLY":
                self._scope = self.assembly
            case "END INSTANCE":
                self._scope = self._outer
            case _:
                self._scope = self.scopes[""]

    def _add_nodes(self, block: _Block) -> None:
        system = block.get("SYSTEM", "R").upper()
        if system != "R":
            raise InputError(f"{block.where}: SYSTEM={system} is not read: write the nodes in Cartesian coordinates")
        rows = block.rows(7)[:, :4]
        labels = _labels(rows[:, 0], block, "node")
        self._scope.nodes.append((labels, np.nan_to_num(rows[:, 1:], posinf=np.inf, neginf=-np.inf)))
        if block.get("NSET"):
            self._scope.add("NSET", block.get("NSET"), block, [_Labels(labels)])

    def _add_elements(self, block: _Block) -> None:
        kind = block.required("TYPE").upper()
        count, note = next(((n, note) for pattern, n, note in _BARS if pattern.fullmatch(kind)), (0, ""))
        if count == 0:
            self._other_types.add(kind)
            return
        rows = block.rows(count + 3, count + 1)[:, : count + 1]
        labels = _labels(rows[:, 0], block, "element")
        nodes = _labels(rows[:, 1:].ravel(), block, "node").reshape(len(rows), count)
        self._scope.elements.append((block, labels, nodes))
        if note:
            self._notes[f"{kind}: {note}"] = self._notes.get(f"{kind}: {note}", 0) + len(rows)
        if block.get("ELSET"):
            self._scope.add("ELSET", block.get("ELSET"), block, [_Labels(labels)])

    def _entries(self, kind: str, block: _Block) -> Iterator[_Labels]:
        """Yield the members that ``*NSET`` or ``*ELSET`` names."""
        instance = block.get("INSTANCE").upper()
        if instance and instance not in self.scopes:
            raise InputError(f"{block.where}: there is no instance {instance}")
        numbers = None
        if kind == "NSET" and block.get("ELSET"):
            for entry in self._named("ELSET", block, block.get("ELSET"), self._scope, instance):
                elements = (self.scopes[entry.instance] if entry.instance else self._scope).elements
                of_set = [nodes[entry.within(labels)].ravel() for _, labels, nodes in elements]
                yield _Labels(_union(of_set), instance=entry.instance)
        elif "GENERATE" in block.parameters:
            rows = block.rows(3, 2)
            for row in _labels(np.where(np.isnan(rows), 1.0, rows).ravel(), block, "member").reshape(-1, 3):
                if row[1] < row[0]:
                    raise InputError(f"{block.where}: {row[0]}, {row[1]}, {row[2]} are not first, last and step")
                yield _Labels(row, True, instance)
        elif (numbers := block.numbers()) is not None:
            yield _Labels(_labels(numbers, block, "member"), instance=instance)
        else:
            for word in (word for _, words in block.lines() for word in words if word):
                yield from self._named(kind, block, word, self._scope, instance)

    def _named(self, kind: str, block: _Block, word: str, scope: _Scope, instance: str = "") -> list[_Labels]:
        """Return the members of a set that is named as NAME or INSTANCE.NAME, or of LABEL or INSTANCE.LABEL."""
        name = word.strip('"')
        first, dot, rest = name.partition(".")
        if dot and first.upper() in self.scopes:
            instance, name = first.upper(), rest
        if name.isdecimal():
            return [_Labels(_labels(np.array([float(name)]), block, "member"), instance=instance)]
        found = (self.scopes[instance] if instance else scope).sets[kind].get(name.upper())
        if found is None:
            raise InputError(f"{block.where}: {name!r} is neither a number nor an existing {_WHAT[kind]} set")
        return [entry._replace(instance=entry.instance or instance) for entry in found.entries]

    def mesh(self) -> WholeMesh:
        """Return nodes and bars of all instances in their order, without nodes where no bar ends, and their groups."""
        told = [f"{self.path}: {n} elements {note}" for note, n in self._notes.items()]
        if self._other_types:
            told.append(f"{self.path}: left out elements of the types {', '.join(sorted(self._other_types))}")
        self.scopes[_ASSEMBLY] = self.assembly
        labels, points, bars = [_NOTHING], [np.empty((0, 3))], [np.empty((0, 2), np.int64)]
        for scope in self.scopes.values():
            parts = scope.placed(self.path, sum(map(len, points)), sum(map(len, bars)))
            for whole, part in zip((labels, points, bars), parts):
                whole.append(part)
        all_points, all_bars = np.concatenate(points), np.concatenate(bars)
        used = np.zeros(len(all_points), bool)
        used[all_bars] = True
        self.labels_left_out = np.concatenate(labels)[~used].tolist()
        number = np.where(used, np.cumsum(used) - 1, -1)
        for scope in self.scopes.values():
            known, at = scope.at["NSET"]
            scope.at["NSET"] = known, number[at]
        self.groups = {}
        for kind, what in _WHAT.items():
            self._lost: dict[int, int] = {}  # a set that another one names counts once
            self.groups[kind] = self._groups(kind)
            lost = sum(self._lost.values())
            if lost and (kind == "NSET" or not self._other_types):
                told.append(f"{self.path}: {lost} members of {what} sets are not there, and are left out")
        mesh = WholeMesh(all_points[used], number[all_bars], self.groups["NSET"], dict(self.groups["ELSET"]))
        mesh.warnings = told + self.warnings
        if self._constraints:
            text = "nodes that they connect are joined by `mesh clean` if they are at the same place"
            mesh.warnings.append(f"{self.path}: left out {', '.join(self._constraints)}; {text}")
        if self._materials:
            mesh.tables["material"] = {name: _material_keys(values) for name, values in self._materials.values()}
        return mesh

    def _groups(self, kind: str) -> dict[str, np.ndarray]:
        """Return the node sets (``NSET``) or element sets (``ELSET``) as groups.

        A set of a part has its own name where no other set has it, and INSTANCE.NAME otherwise; with several instances
        NAME is the set of all of them.
        """
        found = {one.name: self._members(kind, _ASSEMBLY, one.entries) for one in self.assembly.sets[kind].values()}
        common: dict[str, tuple[str, list[np.ndarray]]] = {}
        taken = {name.upper() for name in found}
        for key, scope in self.scopes.items():
            for upper, one in scope.sets[kind].items() if key != _ASSEMBLY else ():
                members = self._members(kind, key, one.entries)
                common.setdefault(upper, (one.name, []))[1].append(members)
                if key and (upper in taken or len(self.scopes) > 3):
                    found[f"{scope.name}.{one.name}"] = members
        found |= {name: _union(parts) for upper, (name, parts) in common.items() if upper not in taken}
        return {name.replace("/", "_"): members for name, members in found.items()}

    def members_of(self, kind: str, block: _Block, target: str) -> np.ndarray:
        """Return the members (n,) of a set, or that of a label, which a keyword outside of parts names."""
        key = _ASSEMBLY if len(self.scopes) > 2 else ""
        return self._members(kind, key, self._named(kind, block, target, self.scopes[key]))

    def _members(self, kind: str, key: str, entries: list[_Labels]) -> np.ndarray:
        """Return the members of a set in the mesh, ascending."""
        parts: list[np.ndarray] = []
        for entry in entries:
            known, at = self.scopes[entry.instance or key].at[kind]
            if entry.generated:
                members = at[entry.within(known)]
            else:
                place, there = _found(known, entry.labels)
                members = at[place[there]]
                self._lost[id(entry.labels)] = len(entry.labels) - len(members)
            parts.append(members[members >= 0])  # without nodes where no bar ends
        return _union(parts)

    # ---- sections

    def add_sections(self, mesh: WholeMesh) -> None:
        """Add the tables of the sections, and the areas of bars as a field."""
        areas = np.full(len(mesh.bars), np.nan)
        sections: dict[str, dict[str, Any]] = {}
        for block, group, members in self._section_members():
            if len(members) == 0:
                continue
            found = _section_keys(block)
            if not found.get("area", 0.0) > 0.0:
                what = f"SECTION={block.get('SECTION')}" if block.get("SECTION") else "the data line"
                mesh.warnings.append(f"{block.where}: no area is known from {what}")
                found.pop("area", None)
            areas[members] = found.get("area", np.nan)
            material = block.get("MATERIAL")
            if material:
                found["material"] = self._materials.get(material.upper(), (material, {}))[0]
            sections[group] = {"bars": group, **found}
        whole = bool(len(areas)) and bool((areas > 0.0).all())
        if sections:
            mesh.tables["section"] = self._without_made(mesh, sections) if whole else sections
        if whole:
            mesh.bar_fields["area"] = areas
        elif sections and np.isnan(areas).any():
            text = f"{int(np.isnan(areas).sum())} bars have no area: there is no field area"
            mesh.warnings.append(f"{self.path}: {text}")

    def _section_members(self) -> Iterator[tuple[_Block, str, np.ndarray]]:
        """Yield each section with the name of a bar group, and its bars.

        That of a part is one for all instances if the set of its name has these bars, else one for each instance.
        """
        groups = self.groups["ELSET"]
        names = {name.upper(): name for name in groups}
        found: dict[int, tuple[_Block, str, list[tuple[str, np.ndarray]]]] = {}
        for key, scope in self.scopes.items():
            for block, name in scope.sections:
                if name.upper() not in scope.sets["ELSET"]:
                    raise InputError(f"{block.where}: there is no element set {name}")
                full = f"{scope.name}.{name}".upper().replace("/", "_")
                members = self._members("ELSET", key, scope.sets["ELSET"][name.upper()].entries)
                found.setdefault(id(block), (block, name, []))[2].append((full, members))
        for block, name, parts in found.values():
            short = names.get(name.upper().replace("/", "_"))
            if short is not None and np.array_equal(groups[short], _union([members for _, members in parts])):
                yield block, short, groups[short]
            else:
                yield from ((block, names.get(full, short or name), members) for full, members in parts)

    def _without_made(self, mesh: WholeMesh, sections: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
        """Return one section with the areas of the field in the place of those whose sets the writer has made for
        areas, which are no groups then."""
        own = self.scopes[""].sets["ELSET"]
        made = [name for name in sections if name.startswith(_MADE) and own.get(name.upper(), _Set("")).internal]
        materials = {sections[name].get("material") for name in made}
        if len(materials) != 1:
            return sections
        for name in made:
            mesh.bar_groups.pop(name, None)
        material = materials.pop()
        kept = {name: keys for name, keys in sections.items() if name not in made}
        return kept | {"bars": {"area_field": "area", **({"material": material} if material else {})}}

    # ---- the first step

    def add_analysis(self, mesh: WholeMesh) -> None:
        """Add the table ``analysis`` to a mesh, and warnings about what is left out."""
        if self._unread:
            mesh.warnings.append(f"{self.path}: left out {', '.join(self._unread)}: keywords that are not read")
        if self._beyond is not None:
            mesh.warnings.append(f"{self._beyond.where}: left out with all that follows: only the first step is read")
        if self._procedure is None:
            return
        tables, told = _analysis(self._procedure)
        if tables:
            mesh.tables["analysis"] = tables
        if told:
            mesh.warnings.append(f"{self._procedure.where}: {told}")


# ---- materials and sections

_PROPERTIES = {"ELASTIC": ("young_modulus", 2), "DENSITY": ("density", 1), "EXPANSION": ("thermal_expansion", 1)}
"""Keys of keywords with one value, and the column of the temperature."""


def _material_value(block: _Block, material: dict[str, Any]) -> str:
    """Read what belongs to a material; return what is to be said about it."""
    if block.keyword == "DAMPING":
        for name, key in (("ALPHA", "alpha"), ("BETA", "stiffness_damping")):
            material[key] = number_of(block.get(name)) if name in block.parameters else material.get(key, 0.0)
            if np.isnan(material[key]):
                material[key] = 0.0
                return f"{block.get(name)!r} is not a number: left out"
        return ""
    if block.get("TYPE", "ISOTROPIC").upper() not in ("ISOTROPIC", "ISO"):
        return f"TYPE={block.get('TYPE')}: left out"
    key, column = _PROPERTIES.get(block.keyword, ("plastic", 2))
    rows = block.rows(8, 1)
    if len(rows) == 0 or not np.isfinite(rows[0, 0]):
        return "no values: left out"
    if block.keyword in ("ELASTIC", "DENSITY") and rows[0, 0] <= 0.0:
        return f"{rows[0, 0]:g} is not positive: left out"
    first = rows[:, column]
    cold = np.isnan(first) | (first == first[0]) if key == "plastic" else np.arange(len(rows)) == 0
    told = "" if cold.all() else f"values at {first[0]:g} degrees are taken for all temperatures"
    if key != "plastic":
        material[key] = float(rows[0, 0])
        return told
    hardening = block.get("HARDENING", "ISOTROPIC").upper()
    stress, strain = np.nan_to_num(rows[cold, :2]).T
    known = hardening == "ISOTROPIC" or (hardening == "KINEMATIC" and len(stress) <= 2)
    if not known or "RATE" in block.parameters:
        return f"HARDENING={hardening}: left out" if not known else "RATE: left out"
    if strain[0] != 0.0 or stress[0] <= 0.0 or (np.diff(strain) <= 0.0).any() or (np.diff(stress) < 0.0).any():
        return "a curve that does not start at plastic strain 0, or that falls: left out"
    material["plastic"] = hardening, stress, strain
    return told


def _material_keys(values: dict[str, Any]) -> dict[str, Any]:
    """A material's keys; rows of stress over plastic strain are a curve over strain, constant after the last row."""
    keys = {key: values[key] for key in ("young_modulus", "density", "thermal_expansion") if key in values}
    if values.get("alpha") and "density" in values:
        keys["damping"] = values["alpha"] * values["density"]
    if values.get("stiffness_damping"):
        keys["stiffness_damping"] = values["stiffness_damping"]
    if "plastic" not in values:
        return keys
    hardening, stress, strain = values["plastic"]
    if len(stress) == 1:
        keys["yield_stress"] = float(stress[0])
    elif hardening == "KINEMATIC":
        slope = (stress[1] - stress[0]) / strain[1]
        keys |= {"yield_stress": float(stress[0]), "kinematic_hardening": float(slope)}
    elif "young_modulus" in keys:
        curve = np.stack([stress / keys["young_modulus"] + strain, stress], axis=1)
        keys |= {"law": "multilinear", "curve": curve.tolist()}
    return keys


def _section_keys(block: _Block) -> dict[str, Any]:
    """Return ``area``, and ``shape`` and ``thickness`` of round bars and tubes, as far as a section tells them."""
    rows = block.rows(16, 1)
    values = rows[0] if len(rows) else np.full(16, np.nan)
    first = float(values[0])
    if block.keyword == "SOLID SECTION":
        return {"area": first if np.isfinite(first) else 1.0}
    kind = block.get("SECTION", "GENERAL" if block.keyword == "BEAM GENERAL SECTION" else "").upper()
    a, b = float(values[0]), float(values[1])
    found: dict[str, Any] = {}
    if kind == "GENERAL":
        found = {"area": first}
    elif kind == "CIRC":
        found = {"area": math.pi * a * a, "shape": "round"}
    elif kind == "PIPE":
        found = {"area": math.pi * (2.0 * a - b) * b, "shape": "tube", "thickness": b}
    elif kind == "RECT":
        found = {"area": a * b}
    elif kind == "BOX":
        left, top, right, bottom = (float(value) for value in values[2:6])
        found = {"area": a * b - (a - left - right) * (b - top - bottom)}
    return found if np.isfinite(found.get("area", np.nan)) else {}


# ---- supports, forces and gravity

_FIXED = {"PINNED": "xyz", "ENCASTRE": "xyz", "XSYMM": "x", "YSYMM": "y", "ZSYMM": "z"}
_FIXED |= {"XASYMM": "yz", "YASYMM": "xz", "ZASYMM": "xy"}


class _Conditions:
    """Supports, nodal forces and gravity as tables of a case; those of single nodes make groups."""

    def __init__(self, mesh: WholeMesh, deck: _Deck) -> None:
        self._mesh, self._deck = mesh, deck
        self._fixed: dict[str, str] = {}
        self._forces: dict[str, list[float]] = {}
        self._gravity = np.zeros(3)

    def add(self) -> None:
        """Add ``support``, ``load`` and ``gravity`` to the tables of the mesh.

        What is not zero displacement of nodes, a nodal force, or gravity is left out, with a warning.
        """
        mesh = self._mesh
        kinds = {"DLOAD": self._weight, "CLOAD": self._force, "BOUNDARY": self._support}
        for block in self._deck.conditions:
            if block.get("AMPLITUDE"):
                text = f"AMPLITUDE={block.get('AMPLITUDE')} is left out: give the table over time in the case"
                mesh.warnings.append(f"{block.where}: {text}")
            for where, words in block.lines():
                told = kinds[block.keyword](block, words)
                if told:
                    mesh.warnings.append(f"{where}: {', '.join(words)[:60]!r} is left out: {told}")
        if self._fixed:
            mesh.tables["support"] = {
                name: {"node_set": name, "fix": "".join(axis for axis in "xyz" if axis in axes)}
                for name, axes in self._fixed.items()
            }
        if self._forces:
            mesh.tables["load"] = {name: {"node_set": name, "force": force} for name, force in self._forces.items()}
        if self._gravity.any():
            mesh.tables["gravity"] = {"gravity": {"acceleration": self._gravity.tolist()}}

    def _weight(self, block: _Block, words: list[str]) -> str:
        if len(words) < 2 or words[1].upper() != "GRAV":
            return "only GRAV is read of distributed loads"
        values = np.array([_value(words, at) for at in range(2, 6)])
        if not np.isfinite(values).all():
            return "expected numbers"
        if words[0] and len(self._deck.members_of("ELSET", block, words[0])) < len(self._mesh.bars):
            return "the gravity of a case acts on all bars"
        self._gravity += values[0] * values[1:]
        return ""

    def _force(self, block: _Block, words: list[str]) -> str:
        axis, value = _value(words, 1), _value(words, 2)
        if axis not in (1.0, 2.0, 3.0) or not np.isfinite(value):
            return "only forces along x, y and z are read"
        name = self._group(block, words[0])
        if name:
            self._forces.setdefault(name, [0.0, 0.0, 0.0])[int(axis) - 1] += value
        return "" if name else "it names no node"

    def _support(self, block: _Block, words: list[str]) -> str:
        axes = _FIXED.get(words[1].upper() if len(words) > 1 else "", "")
        if not axes:
            first = _value(words, 1)
            last = _value(words, 2) or first
            if not 1.0 <= first <= last < 100.0:
                return "expected degrees of freedom"
            if _value(words, 3) != 0.0:
                return "prescribed displacements are those of the case"
            axes = "xyz"[int(first) - 1 : int(last)]  # bars have no rotations
        name = self._group(block, words[0])
        if name and axes:
            self._fixed[name] = self._fixed.get(name, "") + axes
        return "" if name else "it names no node"

    def _group(self, block: _Block, target: str) -> str:
        """Return the name of the node group with the nodes of a set, or of the node of a label; empty without nodes."""
        members, groups = self._deck.members_of("NSET", block, target), self._mesh.node_groups
        if len(members) == 0:
            return ""
        wanted = target.strip('"').upper().replace("/", "_")
        for name, own in groups.items():
            if name.upper() in (wanted, wanted.rpartition(".")[2]) and np.array_equal(own, members):
                return name
        name = f"node_{target}".replace("/", "_") if len(members) == 1 else target.replace("/", "_")
        while name in groups and not np.array_equal(groups[name], members):
            name += "_"
        groups[name] = members
        return name


def _value(words: list[str], at: int) -> float:
    """Return a number, 0 for one that is missing, NaN for another text."""
    return number_of(words[at]) if at < len(words) and words[at] else 0.0


# ---- the analysis of the first step


def _analysis(block: _Block) -> tuple[dict[str, dict[str, Any]], str]:
    """Return the tables of a case for a procedure, and what is to be said; none for one that the program lacks."""
    words = next((words for _, words in block.lines()), [])
    first, period, least, most, end = (value if (value := _value(words, k)) > 0.0 else 0.0 for k in range(5))
    match block.keyword:
        case "STATIC":
            return _static(block, first / (period or 1.0), least / (period or 1.0), most / (period or 1.0), end)
        case "DYNAMIC" if not period:
            return {}, "the period is missing: the first step is left out"
        case "DYNAMIC" if "EXPLICIT" in block.parameters:
            step: float | str = _short(first) if first and "DIRECT USER CONTROL" in block.parameters else "auto"
            return {"time": {"integrator": "central_differences", "step": step, "end": period}}, ""
        case "DYNAMIC":
            step = _short(first or period / 100)
            told = f"step = {step:g} s is {'the first increment' if first else 'a hundredth of the period'}"
            return {"time": {"integrator": "generalized_alpha", "step": step, "end": period}}, f"{told}, for all steps"
        case "FREQUENCY" | "BUCKLE" as keyword:
            told = "" if first else "a limit of the frequencies is not supported: modes.count = 10"
            modes = {"count": int(first) or 10, "kind": "vibration" if keyword == "FREQUENCY" else "buckling"}
            # buckling factors are those of the loads of the step, which a static analysis applies
            return ({"static": {"step": 1.0}} if keyword == "BUCKLE" else {}) | {"modes": modes}, told
    return {}, f"the first step is left out: the program has no *{block.keyword}"


def _static(
    block: _Block, first: float, least: float, most: float, end: float
) -> tuple[dict[str, dict[str, Any]], str]:
    """Increments over the period are those of the load factor, which goes from 0 to 1."""
    keys: dict[str, Any] = {"step": _short(min(first or 1.0, 1.0))}
    if "RIKS" in block.parameters:
        told = "" if end else "end = 1 of the load factor is not in the file: *STATIC, RIKS may end at a displacement"
        return {"static": {"method": "arc_length", **keys, "end": end or 1.0}}, told
    if "DIRECT" not in block.parameters and keys["step"] < 1.0:
        keys["max_step"] = _short(min(most or 1.0, 1.0))
        keys |= {"min_step": _short(least)} if 0.0 < least < first else {}
    return {
        "static": keys
    }, "STABILIZE is left out; see the key static.stabilise" if "STABILIZE" in block.parameters else ""


def _short(value: float) -> float:
    return float(f"{value:.12g}")


# ---- writing

_IN_A_LINE = 16


def write(path: Path, mesh: WholeMesh) -> None:
    """Write the mesh, to the last digit."""
    with open(path, "w", encoding="utf-8", newline="\n") as file:
        for line in _lines(mesh):
            file.write(line + "\n")


def _lines(mesh: WholeMesh) -> Iterator[str]:
    yield "*HEADING"
    yield f"{len(mesh.points)} nodes, {len(mesh.bars)} bars, in SI units"
    yield "*NODE"
    yield from (f"{i}, {x!r}, {y!r}, {z!r}" for i, (x, y, z) in enumerate(mesh.points.tolist(), 1))
    yield "*ELEMENT, TYPE=T3D2"
    yield from (f"{i}, {a}, {b}" for i, (a, b) in enumerate((mesh.bars + 1).tolist(), 1))
    node_names, bar_names = _unique_names(mesh.node_groups), _unique_names(mesh.bar_groups)
    for keyword, groups, names in (("NSET", mesh.node_groups, node_names), ("ELSET", mesh.bar_groups, bar_names)):
        for group, members in groups.items():
            yield from _set_lines(f"*{keyword}, {keyword}={names[group]}", members)
    yield from _section_lines(mesh, bar_names)
    for name, keys in mesh.tables.get("material", {}).items():
        yield from _material_lines(name, keys)


def _set_lines(head: str, members: np.ndarray) -> Iterator[str]:
    labels = (np.asarray(members) + 1).tolist()
    if len(labels) > 1 and labels[-1] - labels[0] == len(labels) - 1:
        yield from (f"{head}, GENERATE", f"{labels[0]}, {labels[-1]}, 1")
        return
    yield head
    for k in range(0, len(labels), _IN_A_LINE):
        yield ", ".join(map(str, labels[k : k + _IN_A_LINE])) + ("," if k + _IN_A_LINE < len(labels) else "")


def _section_lines(mesh: WholeMesh, names: dict[str, str]) -> Iterator[str]:
    """Return a section for all bars of the same area and material."""
    n = len(mesh.bars)
    areas = mesh.bar_fields.get("area", np.full(n, np.nan)).copy()
    material = np.full(n, -1)
    materials: list[str] = []
    tables = mesh.tables.get("section", {})
    # those without a group are for all bars that no other one names
    for keys in sorted(tables.values(), key=lambda keys: "bars" in keys):
        members = mesh.bar_groups.get(keys["bars"], np.empty(0, np.int64)) if "bars" in keys else np.arange(n)
        if "area" in keys and "area" not in mesh.bar_fields:
            areas[members] = keys["area"]
        name = keys.get("material")
        if name:
            materials += [] if name in materials else [name]
            material[members] = materials.index(name)
    pairs, which = np.unique(np.column_stack([np.nan_to_num(areas, nan=-1.0), material]), axis=0, return_inverse=True)
    which = which.ravel()
    order = np.argsort(which, kind="stable")
    starts = np.searchsorted(which[order], np.arange(len(pairs) + 1))
    taken = {text.strip('"').upper() for text in names.values()}
    free = (text for k in count(1) if (text := f"{_MADE}{k}").upper() not in taken)
    exact = {mesh.bar_groups[name].tobytes(): text for name, text in names.items()}
    for number, (area, m) in enumerate(pairs.tolist()):
        if not area > 0.0:
            continue
        members = order[starts[number] : starts[number + 1]]
        text = exact.get(members.tobytes())
        if text is None:
            text = next(free)
            yield from _set_lines(f"*ELSET, ELSET={text}, INTERNAL", members)
        of = f", MATERIAL={_quoted(materials[int(m)])}" if m >= 0 else ""
        yield from (f"*SOLID SECTION, ELSET={text}{of}", f"{area!r},")


def _material_lines(name: str, keys: dict[str, Any]) -> Iterator[str]:
    yield f"*MATERIAL, NAME={_quoted(name)}"
    density, young = keys.get("density"), keys.get("young_modulus")
    if density is not None:
        yield from ("*DENSITY", f"{density!r},")
    if young is not None:
        yield from ("*ELASTIC", f"{young!r}, 0.0")
    if keys.get("thermal_expansion"):
        yield from ("*EXPANSION", f"{keys['thermal_expansion']!r},")
    damping = f", ALPHA={keys['damping'] / density!r}" if density and keys.get("damping") else ""
    damping += f", BETA={keys['stiffness_damping']!r}" if keys.get("stiffness_damping") else ""
    if damping:
        yield f"*DAMPING{damping}"
    first = keys.get("yield_stress")
    isotropic, kinematic = keys.get("isotropic_hardening") or 0.0, keys.get("kinematic_hardening") or 0.0
    if "curve" in keys and young:
        yield "*PLASTIC"
        yield from (f"{stress!r}, {max(strain - stress / young, 0.0)!r}" for strain, stress in keys["curve"])
    elif first is not None and keys.get("law", "elastoplastic") == "elastoplastic" and not (isotropic and kinematic):
        yield "*PLASTIC, HARDENING=KINEMATIC" if kinematic else "*PLASTIC"
        yield f"{first!r}, 0.0"
        if isotropic or kinematic:
            yield f"{first + isotropic + kinematic!r}, 1.0"


def _unique_names(groups: dict[str, np.ndarray]) -> dict[str, str]:
    """Return names that differ in capitals too, quoted where need be."""
    found: dict[str, str] = {}
    taken: set[str] = set()
    for name in groups:
        own = name
        while own.upper() in taken:
            own += "_"
        taken.add(own.upper())
        found[name] = _quoted(own)
    return found


def _quoted(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z_][\w.-]*", name) else '"' + name.replace('"', "'") + '"'

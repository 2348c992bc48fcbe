"""Abaqus and CalculiX input files: keywords, with the files that they include, and the model that they describe: parts,
instances and sets as one mesh with groups."""

from __future__ import annotations

import codecs
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from io import StringIO
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..errors import InputError
from ..files import readable_whole
from ..mesh.whole import WholeMesh
from ._common import number_of, numbers_of, places_of, shown, whole_numbers

KNOWN: dict[str, tuple[str, ...]] = {
    "AMPLITUDE": ("NAME", "DEFINITION", "TIME", "VALUE"),
    "ASSEMBLY": ("NAME",),
    "BEAM GENERAL SECTION": (*("ELSET", "SECTION", "MATERIAL", "DENSITY", "POISSON", "ZERO"), "LUMPED"),
    "BEAM SECTION": (*("ELSET", "SECTION", "MATERIAL", "POISSON", "TEMPERATURE"), "LUMPED"),
    "BOUNDARY": ("OP", "TYPE", "AMPLITUDE", "FIXED"),
    "CLOAD": ("OP", "AMPLITUDE"),
    "DAMPING": ("ALPHA", "BETA"),
    "DASHPOT": ("ELSET", "NONLINEAR", "ORIENTATION"),
    "DENSITY": (),
    "DLOAD": ("OP", "AMPLITUDE"),
    "ELASTIC": ("TYPE",),
    "ELEMENT": ("TYPE", "ELSET", "INPUT"),
    "ELSET": ("ELSET", "GENERATE", "INSTANCE", "INTERNAL", "UNSORTED"),
    "EXPANSION": ("TYPE", "ZERO"),
    "FRAME SECTION": ("ELSET", "SECTION", "DENSITY", "ZERO"),
    "INITIAL CONDITIONS": ("TYPE", "INPUT"),
    "INSTANCE": ("NAME", "PART"),
    "MASS": ("ELSET", "TYPE"),
    "MATERIAL": ("NAME",),
    "NO COMPRESSION": (),
    "NO TENSION": (),
    "NODE": ("NSET", "SYSTEM", "INPUT"),
    "NSET": ("NSET", "ELSET", "GENERATE", "INSTANCE", "INTERNAL", "UNSORTED"),
    "PART": ("NAME",),
    "PLASTIC": ("HARDENING", "RATE"),
    "SOLID SECTION": ("ELSET", "MATERIAL", "CONTROLS"),
    "SPRING": ("ELSET", "NONLINEAR", "ORIENTATION"),
    "STEP": (*("NAME", "NLGEOM", "INC", "INCF", "AMPLITUDE", "PERTURBATION", "UNSYMM", "CONVERT SDI"), "EXTRAPOLATION"),
    "TEMPERATURE": ("OP", "AMPLITUDE"),
}
"""Parameters of keywords that are read, or that change nothing for bars; others are told."""
_OPEN = ("PART", "INSTANCE", "ASSEMBLY", "STEP")
"""Keywords that another one, with END, closes."""
_SPACED = {name.replace(" ", ""): name for name in (*KNOWN, *(f"END {name}" for name in _OPEN))}
"""Keywords by their letters: CalculiX ignores the blanks in them."""

_DEEPEST = 20
"""Number of files that include one another."""

_SHORT = 200
"""Number of letters up to which lines are read one by one, which is faster then."""

_COMMENT = re.compile(rb"^[ \t]*\*\*[^\n]*", re.MULTILINE)
_KEYWORD = re.compile(rb"(^[ \t]*\*(?:[^\n]*,[ \t]*\n(?![ \t]*\*))*[^\n]*\n?)", re.MULTILINE)
"""A line that begins with an asterisk, with those that continue it after a comma."""
_COMMA = re.compile(r',(?=(?:[^"]*"[^"]*")*[^"]*$)')
"""A comma outside of quotes."""
_TAIL = re.compile(rb",[ \t]*\n")
_EXPONENTS = bytes.maketrans(b"Dd", b"ee")
"""Those of Fortran: 1.D+3."""


class Piece(NamedTuple):
    """Data lines of a file, from the line of a number on."""

    path: Path
    line: int
    text: bytes


@dataclass
class Block:
    """A keyword, in capitals without the asterisk, with its parameters and data lines."""

    path: Path
    line: int
    keyword: str
    parameters: dict[str, str]
    """Names in capitals."""
    pieces: list[Piece] = field(default_factory=list)

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

    def lines(self, *pieces: Piece) -> Iterator[tuple[str, list[str]]]:
        """Return where it is, and the words between commas, of each data line; a last empty one is left out."""
        for path, first, text in pieces or self.pieces:
            for number, line in enumerate(text.split(b"\n"), first):
                if line.strip():
                    words = words_of(line.decode("utf-8", "replace"))
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
            return numbers_of(b"\n".join(piece.text for piece in self.pieces).replace(b",", b" ").translate(_EXPONENTS))
        except ValueError:
            return None


def words_of(line: str) -> list[str]:
    """Return the words between the commas of a line."""
    return [word.strip() for word in (_COMMA.split(line) if '"' in line else line.split(","))]


def _row(where: str, words: list[str], width: int, least: int) -> np.ndarray:
    if not least <= len(words) <= width:
        raise InputError(
            f"{where}: {', '.join(words)[:60]!r} has {len(words)} values; expected "
            f"{least}{'' if least == width else f' to {width}'} with commas"
        )
    values = [number_of(word) for word in words]
    for word in [word for word, value in zip(words, values) if word and np.isnan(value)][:1]:
        raise InputError(f"{where}: {word[:40]!r} is not a number")
    return np.array([values + [np.nan] * (width - len(values))])


def _alike(text: bytes) -> np.ndarray | None:
    """Return the numbers of lines that have as many each, in a row each; None if they are not so simple."""
    try:
        return np.loadtxt(
            StringIO(_TAIL.sub(b"\n", text).translate(_EXPONENTS).decode("latin1")), delimiter=",", ndmin=2
        )
    except ValueError:
        return None


def blocks(path: Path, above: tuple[Path, ...] = (), before: Block | None = None) -> Iterator[Block]:
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
                for inner in blocks(_included(found, path, above), (*above, path), block):
                    block = inner
                    yield inner
        elif text.strip():
            if block is None:
                first = shown(text.strip().split(b"\n")[0])
                raise InputError(f"{path}: line {line}: {first!r} precedes the first *KEYWORD")
            block.pieces.append(Piece(path, line, text))
        line += text.count(b"\n")


def _keyword(path: Path, line: int, text: str) -> Block:
    words = words_of(text.lstrip("* \t"))
    if not words[0]:
        raise InputError(f"{path}: line {line}: {text.strip()[:60]!r} is no keyword")
    keyword, *pairs = [(" ".join(name.upper().split()), value) for name, _, value in (w.partition("=") for w in words)]
    name = _SPACED.get(keyword[0].replace(" ", ""), keyword[0])
    return Block(path, line, name, {name: value.strip().strip('"') for name, value in pairs if name})


def _included(block: Block, path: Path, above: tuple[Path, ...]) -> Path:
    name = block.required("INPUT")
    file = (above[0] if above else path).parent / name
    if len(above) >= _DEEPEST or file.resolve() in {other.resolve() for other in (*above, path)}:
        raise InputError(f"{block.where}: {name} includes itself")
    if not file.is_file():
        raise InputError(f"{block.where}: there is no file {file}")
    return file


# ---- the model

_REFUSED = dict.fromkeys(
    ("NGEN", "NFILL", "NCOPY", "NMAP", "ELGEN", "ELCOPY", "SUBSTRUCTURE GENERATE"),
    "write the nodes and elements one by one (Abaqus/CAE and most preprocessors do)",
) | {
    "SYSTEM": "write the nodes in global coordinates",
    "PARAMETER": "write the values in the place of the names, as 1e7 for <E>",
}
"""Keywords without which a mesh would be another one, and what to do."""
_CONSTRAINTS = ("TIE", "EQUATION", "MPC", "COUPLING", "RIGID BODY", "EMBEDDED ELEMENT", "MULTIPLE POINT CONSTRAINT")
PROCEDURES = (
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
    (re.compile(r"T[23]D2[A-Z]*|TRUSS"), 2, 0, ""),
    (re.compile(r"T[23]D3[A-Z]*"), 3, 0, "trusses with three nodes are read as bars between their ends"),
    (re.compile(r"(B[23][13]|PIPE[23]1)[A-Z]*|FRAME[23]D"), 2, 1, "beams are read as bars, without bending stiffness"),
    (
        re.compile(r"(B[23]2|PIPE[23]2)[A-Z]*"),
        3,
        1,
        "beams with three nodes are read as bars between their ends, without bending stiffness",
    ),
)
"""Types of elements that are bars, their numbers of nodes and of those that only tell an orientation, and what is to be
said about them."""
_AT_NODES = {"MASS": 1, "SPRINGA": 2, "SPRING1": 1, "SPRING2": 2, "DASHPOTA": 2, "DASHPOT1": 1, "DASHPOT2": 2}
"""Types of elements that belong to nodes, and the numbers of these."""
SECTIONS = ("SOLID SECTION", "BEAM SECTION", "BEAM GENERAL SECTION", "FRAME SECTION")
OF_NODES = ("MASS", "SPRING", "DASHPOT")
"""Keywords of what elements have: bars, and those that belong to nodes."""
_ASSEMBLY = "*ASSEMBLY"
"""Key of the assembly among instances."""
_WHAT = {"NSET": "node", "ELSET": "element"}


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


class _Elements(NamedTuple):
    """Elements of a block that are bars: labels (n,), those of their nodes (n, 2 or 3), and whether they have no third
    direction."""

    block: Block
    labels: np.ndarray
    nodes: np.ndarray
    plane: bool


class AtNodes(NamedTuple):
    """An element that belongs to one or two nodes: its type and label, and the instances and labels of the nodes."""

    kind: str
    label: int
    nodes: list[tuple[str, int]]


@dataclass
class _Scope:
    """A part, an instance, the assembly, or what stands outside of them, each with labels of its own."""

    name: str = ""
    nodes: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)
    """Labels (n,) and points (n, 3)."""
    elements: list[_Elements] = field(default_factory=list)
    at_nodes: list[AtNodes] = field(default_factory=list)
    sets: dict[str, dict[str, _Set]] = field(default_factory=lambda: {"NSET": {}, "ELSET": {}})
    """By names in capitals."""
    sections: list[tuple[Block, str]] = field(default_factory=list)
    """Where, and the element set."""
    place: np.ndarray = field(default_factory=lambda: np.eye(4, 3))
    at: dict[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    """Labels of nodes and bars, ascending, and their numbers in the mesh."""

    def instance(self, name: str, place: np.ndarray) -> _Scope:
        """Return an instance of a part, to which content of its own can be added."""
        sets = {
            kind: {upper: replace(one, entries=[*one.entries]) for upper, one in found.items()}
            for kind, found in self.sets.items()
        }
        return _Scope(name, [*self.nodes], [*self.elements], [*self.at_nodes], sets, [*self.sections], place)

    def add(self, kind: str, name: str, block: Block, entries: Iterable[_Labels]) -> None:
        """Add members to a set."""
        members = list(entries)  # which may name this set as it is so far
        found = self.sets[kind].setdefault(name.upper(), _Set(name))
        found.entries += members
        found.internal &= "INTERNAL" in block.parameters

    def placed(self, path: Path, n_nodes: int, n_bars: int) -> tuple[np.ndarray, ...]:
        """Number nodes and bars from ``n_nodes`` and ``n_bars``; return labels and points of nodes, bars (n, 2), and
        which of them are plane."""
        labels = np.concatenate([_NOTHING, *(own for own, _ in self.nodes)])
        points = np.concatenate([np.empty((0, 3)), *(own for _, own in self.nodes)])
        known, first, at = np.unique(labels, return_index=True, return_inverse=True)
        if len(known) < len(labels):
            moved = labels[(points != points[first[at.ravel()]]).any(axis=1)]
            if len(moved):
                raise InputError(f"{path}: *NODE: node {moved[0]} is listed more than once, at different positions")
            keep = np.sort(first)
            labels, points = labels[keep], points[keep]
        order = np.argsort(labels, kind="stable")
        ends, plane = [np.empty((0, 2), np.int64)], [np.empty(0, bool)]
        for elements in self.elements:
            found, there = places_of(known, elements.nodes)
            for element, side in np.argwhere(~there)[:1]:
                what = f"node {elements.nodes[element, side]} of element {elements.labels[element]}"
                raise InputError(f"{elements.block.where}: {what} is not defined")
            ends.append(_ends(order[found], points))
            plane.append(np.full(len(found), elements.plane))
        bars = np.concatenate([_NOTHING, *(elements.labels for elements in self.elements)])
        sequence = np.argsort(bars, kind="stable")
        for label in bars[sequence[1:]][np.diff(bars[sequence]) == 0][:1]:
            raise InputError(f"{path}: *ELEMENT: element {label} is listed more than once")
        self.at = {"NSET": (known, order + n_nodes), "ELSET": (bars[sequence], sequence + n_bars)}
        if not np.array_equal(self.place, np.eye(4, 3)):
            points = points @ self.place[:3] + self.place[3]
        return labels, points, np.concatenate(ends) + n_nodes, np.concatenate(plane)


def listed(names: Iterable[str]) -> str:
    """Return the first few names, for messages."""
    names = list(names)
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")


def _ends(nodes: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the ends (n, 2) of elements with nodes (n, 2 or 3): of three nodes, those that are farthest apart."""
    if nodes.shape[1] == 2:
        return nodes
    pairs = np.array([[1, 2], [0, 2], [0, 1]])
    span = np.linalg.norm(points[nodes[:, pairs[:, 1]]] - points[nodes[:, pairs[:, 0]]], axis=2)
    return np.take_along_axis(nodes, pairs[span.argmax(axis=1)], axis=1)


def _labels(values: np.ndarray, block: Block, what: str) -> np.ndarray:
    return whole_numbers(
        values, 1, 2**53, f"{block.where}: ", f" is not the label of a {what}: a whole number from 1 on"
    )


def _union(parts: list[np.ndarray]) -> np.ndarray:
    """Return the members (n,) of sets, ascending; files with a set for each bar have very many of one member."""
    if len(parts) == 1 and len(parts[0]) == 1:
        return parts[0]
    return np.unique(np.concatenate([_NOTHING, *parts]))


def _placing(block: Block) -> np.ndarray:
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


class Deck:
    """What the keywords up to the end of the first step say."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.parts: dict[str, _Scope] = {}
        self.scopes = {"": _Scope()}
        """What has nodes and elements: outside of parts, instances by their names in capitals, and the assembly."""
        self.assembly = _Scope()
        self.materials: dict[str, tuple[str, list[Block]]] = {}
        """Names and keywords by names in capitals."""
        self.conditions: list[tuple[Block, bool]] = []
        """Of the model, and whether of the step."""
        self.initial: list[Block] = []
        self.amplitudes: dict[str, Block] = {}
        """By names in capitals."""
        self.step: Block | None = None
        self.procedure: Block | None = None
        self.calculix = False
        """Whether the file is one of CalculiX, where sections differ."""
        self._scope = self._outer = self.scopes[""]
        self._ended = False
        self._beyond: Block | None = None
        self._open: dict[str, None] = {}
        self._left: defaultdict[str, Counter[str]] = defaultdict(Counter)
        """How often there is what is left out or read as something else: ``types`` of elements, ``constraints``, ..."""
        self._unknown: dict[tuple[str, str], str] = {}
        self._material: list[Block] = []
        self._told: list[str] = []
        self._last: Block | None = None

    def add(self, block: Block) -> bool:
        """Read a keyword; return whether to go on."""
        keyword = block.keyword
        self._last = block
        for name in [name for name in block.parameters if name not in KNOWN.get(keyword, block.parameters)]:
            self._unknown.setdefault((keyword, name), block.where)
        if keyword in _OPEN and not self._ended:
            self._open[keyword] = None
        elif keyword.startswith("END "):
            self._open.pop(keyword.removeprefix("END "), None)
        if self._ended:
            self._beyond = block if keyword == "STEP" else None
        elif keyword in ("BOUNDARY", "CLOAD", "DLOAD", "TEMPERATURE"):
            self.conditions.append((block, self.step is not None))
        elif keyword == "AMPLITUDE":
            self.amplitudes[block.required("NAME").upper()] = block
        elif keyword == "STEP":
            self.step = block
        elif self.step is not None:
            self._ended = keyword == "END STEP"
            if self.procedure is None and keyword in PROCEDURES:
                self.procedure = block
                self.calculix |= "SOLVER" in block.parameters
            else:
                self._left["keywords"][keyword] += 1
        else:
            self._add_to_model(block)
        return self._beyond is None

    @property
    def ambiguous(self) -> bool:
        """Whether the file may be one of CalculiX: both programs have its output."""
        files = {keyword.replace(" ", "") for keyword in self._left["keywords"]}
        return not self.calculix and not files.isdisjoint(("NODEFILE", "ELFILE"))

    def _add_to_model(self, block: Block) -> None:
        match block.keyword:
            case "PART" | "INSTANCE" | "ASSEMBLY" | "END PART" | "END INSTANCE" | "END ASSEMBLY":
                self._open_scope(block)
            case "NODE":
                self._add_nodes(block)
            case "ELEMENT":
                self._add_elements(block)
            case "NSET" | "ELSET" as kind:
                self._scope.add(kind, block.required(kind), block, self._entries(kind, block))
            case keyword if keyword in SECTIONS or keyword in OF_NODES:
                self._scope.sections.append((block, block.required("ELSET")))
            case "MATERIAL":
                name = block.required("NAME")
                _, self._material = self.materials.setdefault(name.upper(), (name, []))
            case "ELASTIC" | "DENSITY" | "EXPANSION" | "PLASTIC" | "DAMPING" | "NO COMPRESSION" | "NO TENSION":
                self._material.append(block)
            case "INITIAL CONDITIONS":
                self.initial.append(block)
            case keyword if keyword in _CONSTRAINTS:
                self._left["constraints"][f"*{keyword}"] += 1
            case keyword if keyword in _REFUSED:
                raise InputError(f"{block.where} is not read: {_REFUSED[keyword]}")
            case keyword:
                self._left["keywords"][keyword] += 1

    def _open_scope(self, block: Block) -> None:
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

    def _add_nodes(self, block: Block) -> None:
        system = block.get("SYSTEM", "R").upper()
        if system != "R":
            raise InputError(f"{block.where}: SYSTEM={system} is not read: write the nodes in Cartesian coordinates")
        rows = block.rows(7)[:, :4]
        labels = _labels(rows[:, 0], block, "node")
        self._scope.nodes.append((labels, np.nan_to_num(rows[:, 1:], posinf=np.inf, neginf=-np.inf)))
        if block.get("NSET"):
            self._scope.add("NSET", block.get("NSET"), block, [_Labels(labels)])

    def _add_elements(self, block: Block) -> None:
        kind = block.required("TYPE").upper()
        found = next(((n, more, note) for pattern, n, more, note in _BARS if pattern.fullmatch(kind)), None)
        labels = _NOTHING
        if found is not None:
            count, more, note = found
            rows = block.rows(count + more + 1 + bool(more), count + 1)[:, : count + 1]
            labels = _labels(rows[:, 0], block, "element")
            nodes = _labels(rows[:, 1:].ravel(), block, "node").reshape(len(rows), count)
            plane = re.fullmatch("[A-Z]+2.*", kind) is not None  # of x and y
            self._scope.elements.append(_Elements(block, labels, nodes, plane))
            self.calculix |= kind in ("B31R", "B32R")  # beams that CalculiX alone has
            if note:
                self._left["notes"][f"{kind}: {note}"] += len(rows)
        elif kind in _AT_NODES:
            labels = np.array([self._at_nodes(kind, block, *line) for line in block.lines()], np.int64)
        else:
            self._left["types"][kind] += 1
        if block.get("ELSET"):
            self._scope.add("ELSET", block.get("ELSET"), block, [_Labels(labels)] * bool(len(labels)))

    def _at_nodes(self, kind: str, block: Block, where: str, words: list[str]) -> int:
        """Add an element that belongs to nodes, and return its label."""
        named = [entry for word in words[1:] for entry in self._named("NSET", block, word, self._scope)]
        nodes = [(entry.instance, int(entry.labels[0])) for entry in named if len(entry.labels) == 1]
        if not len(words) - 1 == len(nodes) == _AT_NODES[kind]:
            text = f"{', '.join(words)[:60]!r} has {len(words)} values"
            raise InputError(f"{where}: {text}; expected {_AT_NODES[kind] + 1} labels")
        label = _labels(np.array([number_of(words[0])]), block, "element")[0]
        self._scope.at_nodes.append(AtNodes(kind, int(label), nodes))
        return int(label)

    def _entries(self, kind: str, block: Block) -> Iterator[_Labels]:
        """Yield the members that ``*NSET`` or ``*ELSET`` names."""
        instance = block.get("INSTANCE").upper()
        if instance and instance not in self.scopes:
            raise InputError(f"{block.where}: there is no instance {instance}")
        if kind == "NSET" and block.get("ELSET"):
            named = self._named("ELSET", block, block.get("ELSET"), self._scope, instance)
            for entry in named or [_Labels(_NOTHING)]:
                elements = (self.scopes[entry.instance] if entry.instance else self._scope).elements
                of_set = _union([own.nodes[entry.within(own.labels)].ravel() for own in elements])
                if len(of_set):
                    yield _Labels(of_set, instance=entry.instance)
                else:
                    self._told.append(f"{block.where}: nodes of elements that are left out are not read")
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

    def _named(self, kind: str, block: Block, word: str, scope: _Scope, instance: str = "") -> list[_Labels]:
        """Return the members of a set that is named as NAME or INSTANCE.NAME, or of LABEL or INSTANCE.LABEL."""
        name = word.replace('"', "")
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
        told = [f"{self.path}: {n} elements {note}" for note, n in self._left["notes"].items()]
        types = sorted(self._left["types"])
        told += [f"{self.path}: left out elements of the types {', '.join(types)}"] * bool(types)
        told += [f"{where}: {name} is left out: it is not read" for (_, name), where in self._unknown.items()]
        self.scopes[_ASSEMBLY] = self.assembly
        parts, n_nodes, n_bars = [], 0, 0
        for scope in self.scopes.values():
            parts.append(scope.placed(self.path, n_nodes, n_bars))
            n_nodes, n_bars = n_nodes + len(parts[-1][0]), n_bars + len(parts[-1][2])
        labels, points, bars, self.plane = map(np.concatenate, zip(*parts))
        used = np.zeros(len(points), bool)
        used[bars] = True
        self.labels_left_out = labels[~used].tolist()
        number = np.where(used, np.cumsum(used) - 1, -1)
        for scope in self.scopes.values():
            known, at = scope.at["NSET"]
            scope.at["NSET"] = known, number[at]
        self.groups, every = {}, self.scopes.values()
        of_nodes = {s.upper() for scope in every for block, s in scope.sections if block.keyword in OF_NODES}
        others = types or any(scope.at_nodes for scope in every)
        mesh = WholeMesh(points[used], number[bars], warnings=[*told, *self._told, *self._cut_off()])
        for kind, what in _WHAT.items():
            self._lost: dict[int, int] = {}  # a set that another one names counts once
            groups = self._groups(kind)
            lost = sum(self._lost.values())
            here = kind == "NSET" or not others
            mesh.tell(lost and here, f"{self.path}: {lost} members of {what} sets are not there, and are left out")
            sets = [one for scope in every for one in scope.sets[kind].values()]
            bare = {one.name for one in sets if one.entries and not any(len(entry.labels) for entry in one.entries)}
            self.groups[kind] = {name: own for name, own in groups.items() if len(own) or name in bare}
            empty = [name for name in groups if name not in self.groups[kind]]
            empty = [name for name in empty if kind == "NSET" or name.upper().rpartition(".")[2] not in of_nodes]
            why = "no bar ends at their nodes" if kind == "NSET" else "none of their elements is a bar"
            mesh.tell(empty, f"{self.path}: left out the {what} sets {listed(empty)}: {why}")
        constraints = ", ".join(self._left["constraints"])
        way_out = "nodes that they connect are joined by `mesh clean` if they are at the same place"
        mesh.tell(constraints, f"{self.path}: left out {constraints}; {way_out}")
        mesh.node_groups, mesh.bar_groups = self.groups["NSET"], dict(self.groups["ELSET"])
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

    def members_of(self, kind: str, block: Block, target: str) -> np.ndarray:
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
                place, there = places_of(known, entry.labels)
                members = at[place[there]]
                self._lost[id(entry.labels)] = len(entry.labels) - len(members)
            parts.append(members[members >= 0])  # without nodes where no bar ends
        return _union(parts)

    def _cut_off(self) -> Iterator[str]:
        """Yield signs of a file that has been cut off."""
        if self._open:
            missing = ", ".join(f"*END {keyword}" for keyword in self._open)
            yield f"{self.path}: ends without {missing}: it may have been cut off"
        pieces = self._last.pieces if self._last else []
        if pieces and pieces[-1].path == self.path and not pieces[-1].text.endswith(b"\n"):
            line = pieces[-1].text.rpartition(b"\n")[2].decode("utf-8", "replace")
            yield f"{self.path}: ends within the line {line[:60]!r}: it may have been cut off"

    def of_nodes(self) -> Iterator[tuple[Block, list[tuple[AtNodes, list[int]]]]]:
        """Yield what masses, springs and dashpots have, with each element and the numbers of its nodes in the mesh, -1
        for a node where no bar ends."""
        sections = [(key, scope, *section) for key, scope in self.scopes.items() for section in scope.sections]
        for key, scope, block, name in sections:
            found: list[tuple[AtNodes, list[int]]] = []
            for entry in self._set(block, scope, name).entries if block.keyword in OF_NODES else ():
                own = entry.instance or key
                elements = self.scopes[own].at_nodes
                for i in np.flatnonzero(entry.within(np.array([element.label for element in elements], np.int64))):
                    if elements[i].kind.startswith(block.keyword):
                        nodes = [
                            (instance or own, [_Labels(np.array([label]))]) for instance, label in elements[i].nodes
                        ]
                        members = [self._members("NSET", *node).tolist() for node in nodes]
                        found.append((elements[i], [next(iter(each), -1) for each in members]))
            if block.keyword in OF_NODES:
                yield block, found

    def _set(self, block: Block, scope: _Scope, name: str) -> _Set:
        if name.upper() not in scope.sets["ELSET"]:
            raise InputError(f"{block.where}: there is no element set {name}")
        return scope.sets["ELSET"][name.upper()]

    def section_members(self) -> Iterator[tuple[Block, str, np.ndarray]]:
        """Yield each section with the name of a bar group, and its bars.

        That of a part is one for all instances if the set of its name has these bars, else one for each instance.
        """
        groups = self.groups["ELSET"]
        names = {name.upper(): name for name in groups}
        found: dict[int, tuple[Block, str, list[tuple[str, np.ndarray]]]] = {}
        every = [(key, scope, *section) for key, scope in self.scopes.items() for section in scope.sections]
        for key, scope, block, name in [each for each in every if each[2].keyword not in OF_NODES]:
            full = f"{scope.name}.{name}".upper().replace("/", "_")
            members = self._members("ELSET", key, self._set(block, scope, name).entries)
            found.setdefault(id(block), (block, name, []))[2].append((full, members))
        for block, name, parts in found.values():
            short = names.get(name.upper().replace("/", "_"))
            if short is not None and np.array_equal(groups[short], _union([members for _, members in parts])):
                parts, name = [(short.upper(), groups[short])], short
            yield from ((block, names.get(full, short or name), members) for full, members in parts)

    def left_out(self) -> Iterator[str]:
        """Yield what the step has that is not read."""
        silent = ("OUTPUT", "PRINT", "FILE")
        unread = [
            name for name in self._left["keywords"] if name not in _PASSED_OVER and not any(map(name.count, silent))
        ]
        if unread:
            yield f"{self.path}: left out {', '.join(f'*{name}' for name in unread)}: keywords that are not read"
        if self._beyond is not None:
            yield f"{self._beyond.where}: left out with all that follows: only the first step is read"

"""Files of surfaces and lines: Wavefront OBJ, PLY and STL. Lines, or edges, are bars; without any, those of the faces.

Polylines, and curves of degree 1, of OBJ are lines, its objects and groups bar groups. Other numbers of vertices and
edges of PLY are fields. Coincident corners of STL are one node. Coordinates are taken as metres.
"""

from __future__ import annotations

import re
import sys
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from ..errors import InputError
from ..mesh.whole import WholeMesh
from ._common import NumberStream, drop_bare_nodes, edges, numbers_of, whole_numbers

SUFFIXES = (".obj", ".ply", ".stl")


class _Polygons(NamedTuple):
    """Faces or polylines: the numbers (m,) of their corners, and where in them each begins, and the last ends."""

    corners: np.ndarray
    offsets: np.ndarray
    groups: Mapping[str, list[int]] = MappingProxyType({})
    """Numbers of faces or polylines by name."""

    @classmethod
    def of(cls, rows: list[list[int]], groups: dict[str, list[int]]) -> _Polygons:
        """Return them from the corners of each."""
        corners = [corner for row in rows for corner in row]
        return cls(np.array(corners, np.int64), np.cumsum([0, *map(len, rows)]), groups)

    def sides(self, closed: bool) -> tuple[np.ndarray, np.ndarray]:
        """Return the ends (n, 2) of all sides, of faces (``closed``) or polylines, and whose they are (n,)."""
        sizes = np.diff(self.offsets)
        owner, last = np.repeat(np.arange(len(sizes)), sizes), self.offsets[1:][sizes > 0] - 1
        following = np.arange(1, len(self.corners) + 1)
        following[last] = self.offsets[:-1][sizes > 0]
        kept = sizes[owner] > 1
        kept[last] &= closed
        return np.stack([self.corners, self.corners[following]], axis=1)[kept], owner[kept]


@dataclass
class _Content:
    """What is in a file, with points numbered from 0; ``left`` is what is not read."""

    points: np.ndarray
    """(n, 3)."""
    faces: _Polygons
    lines: _Polygons = field(default_factory=lambda: _Polygons.of([], {}))
    node_fields: dict[str, np.ndarray] = field(default_factory=dict)
    bar_fields: dict[str, np.ndarray] = field(default_factory=dict)
    left: list[str] = field(default_factory=list)


def read(path: Path, fields: Collection[str] | None = None) -> WholeMesh:
    """Return the lines, or the edges of the faces, of a file.

    Raises
    ------
    InputError
        If the file is damaged or ends early, naming the line of an OBJ file, or names a point that does not exist.
    """
    content = _READERS[path.suffix.lower()](path)
    if path.suffix.lower() == ".stl":
        content = _joined(content)
    n, faces = len(content.points), int(np.count_nonzero(np.diff(content.faces.offsets) > 1))
    of_faces = not (np.diff(content.lines.offsets) > 1).any()
    chosen = content.faces if of_faces else content.lines
    ends, owner = chosen.sides(closed=of_faces)
    if len(ends) == 0:
        raise InputError(f"{path}: has neither lines nor faces, whose edges would be bars")
    bars = whole_numbers(ends, 0, n, f"{path}: there is no point ", f": the file has {n}, numbered from 0")
    bars, number = edges(bars) if of_faces else (bars, np.arange(len(bars)))
    members = {name: np.unique(number[np.isin(owner, own)]) for name, own in chosen.groups.items()}
    mesh = WholeMesh(content.points, bars, bar_groups={name: own for name, own in members.items() if len(own)})
    mesh.node_fields, mesh.bar_fields = content.node_fields, content.bar_fields
    mesh.tell(of_faces, f"{path}: has no lines: the {len(bars)} edges of its {faces} faces are bars")
    mesh.tell(faces and not of_faces, f"{path}: the lines are bars: left out {faces} faces")
    mesh.tell(content.left, f"{path}: left out {', '.join(content.left)}: not read")
    drop_bare_nodes(path, mesh)
    return mesh


def read_faces(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points (n, 3) and the corners of the faces, see :func:`~pfem_petsc.formats.read_triangles`.

    Raises
    ------
    InputError
        As :func:`read`.
    """
    content = _READERS[path.suffix.lower()](path)
    return content.points, content.faces.corners, content.faces.offsets


# ---- Wavefront OBJ

_SILENT = ("", "vt", "vn", "vp", "usemtl", "mtllib", "s", "cstype", "parm", "end")
"""What describes how bars look, or belongs to curves."""


def _obj(path: Path) -> _Content:
    points: list[list[float]] = []
    rows: dict[str, list[list[int]]] = {"l": [], "f": []}
    groups: dict[str, dict[str, list[int]]] = {"l": {}, "f": {}}
    named: dict[str, list[str]] = {"o": [], "g": []}
    degree, other = 0, Counter[str]()
    numbers: dict[str, list[int]] = {"l": [], "f": []}  # of the lines that rows are in
    text = path.read_text(encoding="utf-8-sig", errors="replace").replace("\\\n", " ")
    for number, line in enumerate(text.splitlines(), 1):
        word, *rest = line.partition("#")[0].split() or [""]
        if word == "curv" and degree == 1:  # what Rhino writes for lines: between two parameters
            word, rest = "l", rest[2:]
        try:
            if word == "v":
                x, y, z = map(float, rest[:3])
                points.append([x, y, z])
            elif word in rows:
                ends = [int(text.partition("/")[0]) for text in rest]
                if 0 in ends:
                    raise InputError(
                        f"{path}: line {number}: {line[:60]!r}: there is no point 0: points are numbered from 1"
                    )
                ends = [end - 1 if end > 0 else len(points) + end for end in ends]
                if min(ends) < 0 or max(ends) > sys.maxsize:
                    raise IndexError
                if len(ends) == 1:
                    other[f"{word} of one point"] += 1
                for name in (*named["o"], *named["g"]):
                    groups[word].setdefault(name, []).append(len(rows[word]))
                rows[word].append(ends)
                numbers[word].append(number)
            elif word == "deg":
                degree = int(rest[0])
            elif word in named:
                named[word] = [name.replace("/", "_") for name in ([" ".join(rest)] if word == "o" else rest)]
            elif word not in _SILENT:
                other[word] += 1
        except (ValueError, IndexError):
            expected = "three numbers" if word == "v" else "the numbers of points that precede it"
            raise InputError(f"{path}: line {number}: {line[:60]!r}: expected {expected}") from None
    left = [f"{n} {word}" for word, n in other.items()]
    faces, lines = (_Polygons.of(rows[kind], groups[kind]) for kind in "fl")
    for word, polygons in (("l", lines), ("f", faces)):  # points may follow in the file
        beyond = np.flatnonzero(polygons.corners >= len(points))
        if len(beyond):
            number = numbers[word][np.searchsorted(polygons.offsets, beyond[0], side="right") - 1]
            raise InputError(
                f"{path}: line {number}: there is no point {polygons.corners[beyond[0]] + 1}: the file has "
                f"{len(points)}, numbered from 1"
            )
    return _Content(np.array(points).reshape(-1, 3), faces, lines, left=left)


# ---- PLY

_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
_TYPES |= {"float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"}
_TYPES |= {"int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8"}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


def _ply(path: Path) -> _Content:
    content = path.read_bytes()
    head = re.match(rb"(?:\xef\xbb\xbf)?ply\s*\n(.*?)end_header[ \t]*\r?\n", content, re.DOTALL)
    if head is None:
        raise InputError(f"{path}: is not PLY: it does not begin with 'ply' and a header")
    order, elements = _header(path, head[1].decode("ascii", "replace"))
    try:
        body = _Body(content[head.end() :], order)
        tables = {name: body.table(n, properties) for name, (n, properties) in elements.items()}
        points = np.stack([tables["vertex"].pop(axis) for axis in "xyz"], axis=1)
        ends, faces = tables.get("edge", {}), tables.get("face", {})
        lines = np.stack([ends.pop(key) for key in ("vertex1", "vertex2")], axis=1) if ends else np.empty((0, 2))
        corners, offsets = next((faces[key] for key in ("vertex_indices", "vertex_index") if key in faces), ([], [0]))
    except (ValueError, KeyError, EOFError) as error:
        what = f"the header has no {error}" if isinstance(error, KeyError) else error
        raise InputError(f"{path}: {what}: expected vertices with x, y and z, and edges or faces of them") from None
    left = [f"{n} {name}" for name, (n, _) in elements.items() if name not in ("vertex", "edge", "face")]
    left += [f"{body.left} {'bytes' if order else 'numbers'} after the last element"] if body.left else []
    polygons = _Polygons(np.array(corners), np.array(offsets)), _Polygons(lines.ravel(), 2 * np.arange(len(lines) + 1))
    fields = [{k: values for k, values in own.items() if isinstance(values, np.ndarray)}
              for own in (tables["vertex"], ends)]  # fmt: skip
    return _Content(points, *polygons, node_fields=fields[0], bar_fields=fields[1], left=left)


Properties = list[tuple[str, list[str]]]
"""Names and types of the properties of an element; of lists, two types."""


def _header(path: Path, text: str) -> tuple[str, dict[str, tuple[int, Properties]]]:
    """Return the byte order, empty for a text, and by name the number of vertices, faces or edges with properties."""
    order, elements, properties = None, {}, []
    for line in text.splitlines():
        match line.split():
            case ["format", name, _] if name in _ORDERS:
                order = _ORDERS[name]
            case ["element", name, count] if count.isdigit():
                elements[name] = int(count), (properties := [])
            case ["property", *types, name] if elements and all(t in _TYPES for t in types if t != "list"):
                properties.append((name, [_TYPES[t] for t in types if t != "list"]))
            case ["comment" | "obj_info", *_] | []:
                pass
            case _:
                raise InputError(f"{path}: the header has a line that is not known: {line[:60]!r}")
    if order is None:
        raise InputError(f"{path}: the header has no format; known: {', '.join(_ORDERS)}")
    return order, elements


class _Body(NumberStream):
    """The numbers after the header."""

    def table(self, n: int, properties: Properties) -> dict[str, np.ndarray | tuple[np.ndarray, np.ndarray]]:
        """Return the properties by name: numbers (n,), of lists all members and where the list of each begins."""
        if all(len(types) == 1 for _, types in properties):
            rows = self.take(n, *(types[0] for _, types in properties))
            return {name: rows[f"{k}"].astype(np.float64) for k, (name, _) in enumerate(properties)}
        found: dict[str, list[np.ndarray]] = {name: [] for name, _ in properties}
        for _ in range(n):
            for name, types in properties:
                length = int(self.take(1, types[0])["0"][0]) if len(types) == 2 else 1
                found[name].append(self.take(length, types[-1])["0"])
        whole = {name: np.concatenate([np.empty(0), *parts]) for name, parts in found.items()}
        starts = {name: np.cumsum([0, *map(len, found[name])]) for name, types in properties if len(types) == 2}
        return {name: (values, starts[name]) if name in starts else values for name, values in whole.items()}


# ---- STL


def _stl(path: Path) -> _Content:
    """Every triangle has corners of its own."""
    content = path.read_bytes()
    expected = 84 + 50 * int.from_bytes(content[80:84], "little")
    if len(content) == expected:
        rows = np.dtype([("numbers", "<f4", (4, 3)), ("attribute", "<u2")])
        points = np.frombuffer(content, rows, offset=84)["numbers"][:, 1:].reshape(-1, 3).astype(np.float64)
    elif not content[:84].lstrip().lower().startswith(b"solid"):
        raise InputError(
            f"{path}: is not STL: neither text that begins with 'solid', nor binary: the triangles that it declares "
            f"take {expected} bytes, and it has {len(content)}; is it truncated?"
        )
    else:
        words = re.findall(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", content, re.IGNORECASE)
        facets = len(re.findall(rb"\bendfacet\b", content, re.IGNORECASE))
        whole = re.search(rb"(?i)\bendsolid", content)
        if len(words) != 3 * facets or whole is None:
            found = f"{len(words)} vertices, {facets} times endfacet and {'an' if whole else 'no'} endsolid"
            raise InputError(f"{path}: has {found}; expected three vertices for each facet: is it truncated?")
        try:
            points = numbers_of(b" ".join(word for row in words for word in row)).reshape(-1, 3)
        except ValueError as error:
            raise InputError(f"{path}: vertex: {error}") from None
    return _Content(points, _Polygons(np.arange(len(points)), np.arange(0, len(points) + 1, 3)))


def _joined(content: _Content) -> _Content:
    """Return triangles whose coincident corners, in single precision, are one point, without flat ones."""
    points = content.points.astype(np.float32)
    _, first, number = np.unique(points + np.float32(0.0), axis=0, return_index=True, return_inverse=True)
    in_order = np.argsort(np.argsort(first))  # in that of the file
    corners = in_order[number.ravel()].reshape(-1, 3)
    corners = corners[(corners != np.roll(corners, 1, axis=1)).all(axis=1)]
    offsets = np.arange(0, corners.size + 1, 3)
    return _Content(points[np.sort(first)].astype(np.float64), _Polygons(corners.ravel(), offsets))


_READERS = {".obj": _obj, ".ply": _ply, ".stl": _stl}

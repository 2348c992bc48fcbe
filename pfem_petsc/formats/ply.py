"""PLY files (.ply), text and binary: edges are bars, other numbers of vertices and edges are fields.

In a file without edges, those of the faces are bars. Coordinates are taken as metres.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import InputError
from ..mesh.whole import WholeMesh
from ._numbers import numbers_of
from ._polygons import drop_bare_nodes, mesh_of, sides

SUFFIXES = (".ply",)

_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
_TYPES |= {"float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"}
_TYPES |= {"int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8"}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


class _Element(NamedTuple):
    """Vertices, faces or edges: their number, and names and types of their properties; of lists, two types."""

    name: str
    count: int
    properties: list[tuple[str, list[str]]]


class _Content(NamedTuple):
    """The elements of a file, their other properties, points (n, 3), lines (m, 2), and the corners of the faces."""

    elements: list[_Element]
    tables: dict[str, Any]
    points: np.ndarray
    lines: np.ndarray
    corners: np.ndarray
    offsets: np.ndarray


def read(path: Path, fields: Collection[str] | None = None) -> WholeMesh:
    """Return the edges, or those of the faces, of a PLY file.

    Raises
    ------
    InputError
        If the file is not PLY, or ends early.
    """
    content, body = _contents(path)
    vertices, ends = content.tables["vertex"], content.tables.get("edge", {})
    around, faces = sides(content.corners, content.offsets), len(content.offsets) - 1
    mesh = mesh_of(path, content.points, content.lines, around, faces)
    mesh.node_fields = {name: values for name, values in vertices.items() if isinstance(values, np.ndarray)}
    mesh.bar_fields = {name: values for name, values in ends.items() if isinstance(values, np.ndarray)}
    known = "vertex", "edge", "face"
    other = [f"{element.count} {element.name}" for element in content.elements if element.name not in known]
    other += [f"{body.left} {'bytes' if body.order else 'numbers'} after the last element"] if body.left else []
    if other:
        mesh.warnings.append(f"{path}: left out {', '.join(other)}: not read")
    drop_bare_nodes(path, mesh)
    return mesh


def read_faces(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points (n, 3) and the corners of the faces, see :func:`~pfem_petsc.formats.read_triangles`.

    Raises
    ------
    InputError
        If the file is not PLY, or ends early.
    """
    content, _ = _contents(path)
    return content.points, content.corners, content.offsets


def _contents(path: Path) -> tuple[_Content, _Body]:
    """Return what is in a file, and what has read it."""
    content = path.read_bytes()
    head = re.match(rb"(?:\xef\xbb\xbf)?ply\s*\n(.*?)end_header[ \t]*\r?\n", content, re.DOTALL)
    if head is None:
        raise InputError(f"{path}: is not PLY: it does not begin with 'ply' and a header")
    order, elements = _header(path, head[1].decode("ascii", "replace"))
    try:
        body = _Body(order, content[head.end() :])
        tables = {element.name: body.table(element) for element in elements}
        points = np.stack([tables["vertex"].pop(axis) for axis in "xyz"], axis=1)
        ends, faces = tables.get("edge", {}), tables.get("face", {})
        lines = np.stack([ends.pop(key) for key in ("vertex1", "vertex2")], axis=1) if ends else np.empty((0, 2))
        corners, offsets = next((faces[key] for key in ("vertex_indices", "vertex_index") if key in faces), ([], [0]))
    except (ValueError, KeyError) as error:
        what = f"the header has no {error}" if isinstance(error, KeyError) else error
        raise InputError(f"{path}: {what}: expected vertices with x, y and z, and edges or faces of them") from None
    return _Content(elements, tables, points.astype(np.float64), lines, np.array(corners), np.array(offsets)), body


def _header(path: Path, text: str) -> tuple[str, list[_Element]]:
    order, elements = None, []
    for line in text.splitlines():
        match line.split():
            case ["format", name, _] if name in _ORDERS:
                order = _ORDERS[name]
            case ["element", name, count] if count.isdigit():
                elements.append(_Element(name, int(count), []))
            case ["property", *types, name] if elements and all(t in _TYPES for t in types if t != "list"):
                elements[-1].properties.append((name, [_TYPES[t] for t in types if t != "list"]))
            case ["comment" | "obj_info", *_] | []:
                pass
            case _:
                raise InputError(f"{path}: the header has a line that is not known: {line[:60]!r}")
    if order is None:
        raise InputError(f"{path}: the header has no format; known: {', '.join(_ORDERS)}")
    return order, elements


class _Body:
    """The numbers after the header, taken one after the other."""

    def __init__(self, order: str, content: bytes) -> None:
        self.order, self._at = order, 0
        self._all = content if order else numbers_of(content)

    @property
    def left(self) -> int:
        """How many bytes, of text numbers, nothing has taken; white space at the end of the file is none."""
        rest = self._all[self._at :]
        return len(rest.strip() if self.order else rest)

    def _take(self, n: int, kind: np.dtype | str) -> np.ndarray:
        kind = np.dtype(kind).newbyteorder(self.order) if self.order else np.dtype(kind)
        start, self._at = self._at, self._at + n * (kind.itemsize if self.order else 1)
        if self._at > len(self._all):
            raise ValueError("it ends early")
        return np.frombuffer(self._all, kind, n, start) if self.order else self._all[start : self._at]

    def table(self, element: _Element) -> dict[str, np.ndarray | tuple[np.ndarray, np.ndarray]]:
        """Return the properties by name: numbers (n,), of lists all members and where the list of each begins."""
        n, properties = element.count, element.properties
        if all(len(types) == 1 for _, types in properties):
            row = np.dtype([(name, types[0]) for name, types in properties])
            if self.order:
                rows = self._take(n, row)
                return {name: rows[name].astype(np.float64) for name, _ in properties}
            return dict(zip(row.names, self._take(n * len(properties), "f8").reshape(n, -1).T))
        found: dict[str, list[np.ndarray]] = {name: [] for name, _ in properties}
        for _ in range(n):
            for name, types in properties:
                length = int(self._take(1, types[0])[0]) if len(types) == 2 else 1
                found[name].append(self._take(length, types[-1]))
        lists = {name for name, types in properties if len(types) == 2}
        whole = {name: np.concatenate([np.empty(0), *parts]) for name, parts in found.items()}
        starts = {name: np.cumsum([0, *map(len, found[name])]) for name in lists}
        return {name: (values, starts[name]) if name in lists else values for name, values in whole.items()}

"""Wavefront OBJ files (.obj): lines and polylines are bars, objects and groups are bar groups.

Curves of degree 1 are polylines. In a file without lines, the edges of the faces are bars. Coordinates are taken as
metres.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Collection, Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..mesh.whole import WholeMesh
from ._polygons import drop_bare_nodes, edges, mesh_of

SUFFIXES = (".obj",)

_SILENT = ("", "vt", "vn", "vp", "usemtl", "mtllib", "s", "cstype", "parm", "end")
"""What describes how bars look, or belongs to curves."""


def read(path: Path, fields: Collection[str] | None = None) -> WholeMesh:
    """Return the lines, or the edges of the faces, of an OBJ file.

    Raises
    ------
    InputError
        Naming file and line, for a number that is none, and a point that does not exist.
    """
    points: list[list[float]] = []
    pairs: dict[str, list[tuple[int, int]]] = {"l": [], "f": []}
    groups: dict[str, dict[str, list[int]]] = {"l": {}, "f": {}}
    named: dict[str, list[str]] = {"o": [], "g": []}
    faces, degree, other = 0, 0, Counter[str]()
    for number, line, word, rest in _lines(path):
        try:
            if word == "v":
                points.append(_coordinates(rest))
            elif word in ("l", "f") or (word == "curv" and degree == 1):
                # what Rhino writes for lines: curves of degree 1, between two parameters
                word, rest = ("l", rest[2:]) if word == "curv" else (word, rest)
                ends = _numbers(rest, len(points))
                if len(ends) == 1:
                    other[f"{word} of one point"] += 1
                    continue
                own = pairs[word]
                new = [*pairwise(ends), *([(ends[-1], ends[0])] if word == "f" else [])]
                for name in (*named["o"], *named["g"]):
                    groups[word].setdefault(name, []).extend(range(len(own), len(own) + len(new)))
                own += new
                faces += word == "f"
            elif word == "deg":
                degree = int(rest[0])
            elif word in named:
                named[word] = [name.replace("/", "_") for name in ([" ".join(rest)] if word == "o" else rest)]
            elif word not in _SILENT:
                other[word] += 1
        except (ValueError, IndexError):
            raise _refusal(path, number, line, word) from None
    around = np.array(pairs["f"], np.int64).reshape(-1, 2)
    mesh = mesh_of(path, np.array(points).reshape(-1, 3), np.array(pairs["l"]).reshape(-1, 2), around, faces, 1)
    place = np.arange(len(mesh.bars)) if pairs["l"] else edges(around)[1]
    members = groups["l" if pairs["l"] else "f"]
    mesh.bar_groups = {name: np.unique(place[own]) for name, own in members.items()}
    if other:
        mesh.warnings.append(f"{path}: left out {', '.join(f'{n} {word}' for word, n in other.items())}: not read")
    drop_bare_nodes(path, mesh)
    return mesh


def read_faces(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points (n, 3) and the corners of the faces, see :func:`~pfem_petsc.formats.read_triangles`.

    Raises
    ------
    InputError
        As :func:`read`.
    """
    points: list[list[float]] = []
    corners: list[int] = []
    offsets = [0]
    for number, line, word, rest in _lines(path):
        try:
            if word == "v":
                points.append(_coordinates(rest))
            elif word == "f":
                corners += _numbers(rest, len(points))
                offsets.append(len(corners))
        except (ValueError, IndexError):
            raise _refusal(path, number, line, word) from None
    return np.array(points).reshape(-1, 3), np.array(corners, np.int64), np.array(offsets)


def _lines(path: Path) -> Iterator[tuple[int, str, str, list[str]]]:
    """Return the number of each line, itself, its first word and the others."""
    text = path.read_text(encoding="utf-8-sig", errors="replace").replace("\\\n", " ")
    for number, line in enumerate(text.splitlines(), 1):
        word, *rest = line.partition("#")[0].split() or [""]
        yield number, line, word, rest


def _coordinates(words: list[str]) -> list[float]:
    x, y, z = map(float, words[:3])
    return [x, y, z]


def _numbers(words: list[str], n: int) -> list[int]:
    """Return the points, from 0, that a line names after n points."""
    ends = [int(text.partition("/")[0]) for text in words]
    ends = [end - 1 if end > 0 else n + end for end in ends]
    if min(ends) < 0 or max(ends) > sys.maxsize:
        raise IndexError
    return ends


def _refusal(path: Path, number: int, line: str, word: str) -> InputError:
    expected = "three numbers" if word == "v" else "the numbers of points that precede it"
    return InputError(f"{path}: line {number}: {line[:60]!r}: expected {expected}")

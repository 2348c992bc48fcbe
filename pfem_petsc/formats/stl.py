"""STL files (.stl), ASCII and binary: the edges of the triangles are bars.

Coincident corners are one node; an edge between two triangles is one bar. STL has no unit: coordinates are taken
as metres.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..mesh.whole import WholeMesh
from . import vtk
from ._numbers import numbers_of

SUFFIXES = (".stl",)


def read(path: Path, fields: Collection[str] | None = None) -> WholeMesh:
    """Return the edges of the triangles in an STL file, read by VTK.

    Raises
    ------
    InputError
        If the file is not STL, or has no triangles.
    """
    with open(path, "rb") as file:
        _is_text(path, file.read(84), path.stat().st_size)
    # VTK reads a binary file up to its end, however long it says it is
    return vtk.read(path, fields)


def read_faces(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points (3 n, 3) and the corners of the n triangles, see :func:`~pfem_petsc.formats.read_triangles`.

    Raises
    ------
    InputError
        If the file is not STL, or ends early.
    """
    content = path.read_bytes()
    if _is_text(path, content[:84], len(content)):
        words = re.findall(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", content, re.IGNORECASE)
        facets, whole = (
            len(re.findall(rb"\bendfacet\b", content, re.IGNORECASE)),
            re.search(rb"(?i)\bendsolid", content),
        )
        if len(words) != 3 * facets or whole is None:
            found = f"{len(words)} vertices, {facets} times endfacet and {'an' if whole else 'no'} endsolid"
            raise InputError(f"{path}: has {found}; expected three vertices for each facet: is it truncated?")
        try:
            points = numbers_of(b" ".join(word for row in words for word in row)).reshape(-1, 3)
        except ValueError as error:
            raise InputError(f"{path}: vertex: {error}") from None
    else:
        rows = np.dtype([("numbers", "<f4", (4, 3)), ("attribute", "<u2")])
        points = np.frombuffer(content, rows, offset=84)["numbers"][:, 1:].reshape(-1, 3).astype(np.float64)
    return points, np.arange(len(points)), np.arange(0, len(points) + 1, 3)


def _is_text(path: Path, head: bytes, size: int) -> bool:
    """Return whether a file of a size [B] that begins with ``head`` is text; refuse it if it is binary of another size
    than it says."""
    expected = 84 + 50 * int.from_bytes(head[80:], "little")
    if size == expected:
        return False
    if not head.lstrip().lower().startswith(b"solid"):
        raise InputError(
            f"{path}: is not STL: neither text that begins with 'solid', nor binary: the triangles that it declares "
            f"take {expected} bytes, and it has {size}; is it truncated?"
        )
    return True

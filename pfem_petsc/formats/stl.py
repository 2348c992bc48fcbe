"""STL files (.stl), ASCII and binary: the edges of the triangles are bars.

Coincident corners are one node; an edge between two triangles is one bar. STL has no unit: coordinates are taken
as metres.
"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from ..errors import InputError
from ..mesh.whole import WholeMesh
from . import vtk

SUFFIXES = (".stl",)


def read(path: Path, fields: Collection[str] | None = None) -> WholeMesh:
    """Return the edges of the triangles in an STL file, read by VTK.

    Raises
    ------
    InputError
        If the file is not STL, or has no triangles.
    """
    with open(path, "rb") as file:
        head = file.read(84)
    size, expected = path.stat().st_size, 84 + 50 * int.from_bytes(head[80:], "little")
    # VTK reads a binary file up to its end, however long it says it is
    if not head.lstrip().lower().startswith(b"solid") and size != expected:
        raise InputError(
            f"{path}: is not STL: neither text that begins with 'solid', nor binary: the triangles that it declares "
            f"take {expected} bytes, and it has {size}; is it truncated?"
        )
    return vtk.read(path, fields)

"""STL files, ASCII and binary: the edges of the triangles are bars.

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
from ._numbers import numbers_of, shown
from ._polygons import edges

SUFFIXES = (".stl",)

_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_VERTEX = re.compile(rb"^[ \t]*vertex[ \t]+([^\r\n]*)", re.MULTILINE | re.IGNORECASE)


def read(path: Path, fields: Collection[str] | None = None) -> WholeMesh:
    """Return the edges of the triangles in an STL file; triangles without area are left out, with a warning.

    Raises
    ------
    InputError
        If the file is not STL, or has no triangles.
    """
    content = path.read_bytes()
    n = int.from_bytes(content[80:84], "little")
    binary = len(content) >= 84 and len(content) == 84 + n * _FACET.itemsize
    if binary:
        corners = np.frombuffer(content, _FACET, n, 84)["corners"].astype(np.float64).reshape(-1, 3)
    elif content[:2000].lstrip().lower().startswith(b"solid") and b"facet" in content[:4000].lower():
        corners = _text(path, content)
    else:
        raise InputError(
            f"{path}: is not STL: neither text that begins with 'solid', nor binary: the {n} triangles that it "
            f"declares take {84 + n * _FACET.itemsize} bytes, and it has {len(content)}; is it truncated?"
        )
    if not np.isfinite(corners).all():
        facet = int(np.flatnonzero(~np.isfinite(corners).all(axis=1))[0]) // 3
        raise InputError(f"{path}: triangle {facet} (from 0) has coordinates that are not finite: write the file again")
    points, number = np.unique(corners + 0.0, axis=0, return_inverse=True)  # -0.0 is 0.0
    triangles = number.reshape(-1, 3)
    flat = (triangles == np.roll(triangles, 1, axis=1)).any(axis=1)
    mesh = WholeMesh(points, edges(np.concatenate([triangles[~flat][:, [i, i - 1]] for i in range(3)]))[0])
    if flat.any():
        mesh.warnings.append(f"{path}: left out {int(flat.sum())} triangles with two corners at the same place")
    if len(mesh.bars) == 0:
        raise InputError(f"{path}: has no triangles, whose edges would be bars")
    return mesh


def _text(path: Path, content: bytes) -> np.ndarray:
    """Return the corners of triangles (3 n, 3)."""
    found = _VERTEX.findall(content)
    for k, words in enumerate(found, 1):
        if len(words.split()) != 3:
            raise InputError(f"{path}: 'vertex {shown(words)}', number {k}, does not have three numbers")
    if not found or len(found) % 3:
        raise InputError(
            f"{path}: has {len(found)} lines 'vertex x y z', not three for each triangle; is it truncated?"
        )
    try:
        return numbers_of(b" ".join(found)).reshape(-1, 3)
    except ValueError as error:
        raise InputError(f"{path}: lines 'vertex x y z': {error}") from None

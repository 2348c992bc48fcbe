"""Bars of files that have lines and faces: the lines, or where there are none the edges of the faces."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from ._numbers import whole_numbers

if TYPE_CHECKING:
    from ..mesh.whole import WholeMesh


def sides(corners: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Return the ends (m, 2) of the sides of polygons with corners (m,), polygon k those from ``offsets[k]`` on."""
    following = np.arange(1, len(corners) + 1)
    following[offsets[1:] - 1] = offsets[:-1]
    return np.stack([corners, corners[following]], axis=1)


def edges(pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the different edges (n, 2) among the sides of polygons (m, 2), and the number (m,) of the edge of each."""
    ends = np.sort(pairs, axis=1).astype(np.int64)
    n = int(ends.max(initial=0)) + 1
    keys, number = np.unique(ends[:, 0] * n + ends[:, 1], return_inverse=True)
    return np.stack([keys // n, keys % n], axis=1), number.ravel()


def mesh_of(
    path: Path, points: np.ndarray, lines: np.ndarray, around: np.ndarray, faces: int, first: int = 0
) -> WholeMesh:
    """Return the mesh of lines (m, 2); without any, of the edges of faces with the sides ``around`` (k, 2).

    Nodes that faces alone have are left out with them; what is left out, or made of faces, is told. Messages number
    points from ``first``, as the file does.
    """
    from ..mesh.whole import WholeMesh

    given, n = lines if len(lines) else around, len(points)
    if len(given) == 0:
        raise InputError(f"{path}: has neither lines nor faces, whose edges would be bars")

    def refused(found: str) -> str:
        return f"{path}: there is no point {found}: the file has {n}, numbered from {first}"

    given = whole_numbers(given + first, first, first + n, refused) - first
    bars = given if len(lines) else edges(given)[0]
    mesh = WholeMesh(points, bars)
    if len(lines) and faces:
        mesh.warnings.append(f"{path}: the lines are bars: left out {faces} faces")
    elif faces:
        mesh.warnings.append(f"{path}: has no lines: the {len(bars)} edges of its {faces} faces are bars")
    return mesh


def drop_bare_nodes(path: Path, mesh: WholeMesh) -> None:
    """Remove nodes where no bar ends from a mesh, and tell their number."""
    used = np.zeros(len(mesh.points), bool)
    used[mesh.bars] = True
    if used.all():
        return
    number = np.cumsum(used) - 1
    mesh.warnings.append(f"{path}: left out {int((~used).sum())} points where no bar ends")
    mesh.points, mesh.bars = mesh.points[used], number[mesh.bars]
    mesh.node_groups = {name: number[own[used[own]]] for name, own in mesh.node_groups.items()}
    mesh.node_fields = {name: values[used] for name, values in mesh.node_fields.items()}

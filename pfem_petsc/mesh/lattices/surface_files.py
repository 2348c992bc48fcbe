"""Reads a closed surface of triangles from an STL, OBJ or PLY file."""

from __future__ import annotations

import importlib
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...errors import InputError
from ...files import readable_whole
from .surface import Surface, poly_data

if TYPE_CHECKING:
    from vtkmodules.vtkCommonDataModel import vtkPolyData

__all__ = ["read_surface"]

_READERS = {
    ".stl": ("vtkmodules.vtkIOGeometry", "vtkSTLReader"),
    ".obj": ("vtkmodules.vtkIOGeometry", "vtkOBJReader"),
    ".ply": ("vtkmodules.vtkIOPLY", "vtkPLYReader"),
}
_MERGED = 1e-7
"""Points of a file closer than this fraction of its diagonal are merged if it is not closed without that."""


def read_surface(path: Path, scale: float) -> Surface:
    """Read a surface; to be called on one rank.

    Raises
    ------
    InputError
        If the file is not there, is not of triangles, or the surface is open.
    """
    where = f"mesh.surface.file: {path}"
    if path.suffix.lower() not in _READERS:
        raise InputError(f"{where}: no reader for {path.suffix or 'no suffix'}; known: {', '.join(_READERS)}")
    try:
        with open(readable_whole(path), "rb"):
            pass
    except OSError as error:
        raise InputError(f"{where}: cannot open: {error.strerror}") from None
    module, name = _READERS[path.suffix.lower()]
    reader = getattr(importlib.import_module(module), name)()
    messages = _observed(reader)
    reader.SetFileName(str(path))
    reader.Update()
    points, triangles = _triangles(reader.GetOutput(), 0.0)
    if len(triangles) == 0 or not np.isfinite(points).all():
        what = f" ({messages[0]})" if messages else ""
        raise InputError(f"{where}: no surface of triangles could be read from it{what}")
    count, edge = _open_edges(triangles)
    if count:
        points, triangles = _better((points, triangles), _triangles(reader.GetOutput(), _MERGED))
        points, triangles = _better((points, triangles), _oriented(points, triangles))
        count, edge = _open_edges(triangles)
    if count:
        a, b = (", ".join(f"{x:.6g}" for x in points[node]) for node in edge)
        raise InputError(
            f"{where}: the surface is not closed: {count} of its edges have a triangle on one side only, like that "
            f"from ({a}) to ({b}) in the file; close it in the program that made it (PyVista: mesh.fill_holes(size))"
        )
    surface = Surface(scale * points, triangles)
    size = float(np.prod(surface.bounds[1] - surface.bounds[0]))
    if not abs(surface.volume) > 1e-9 * size:
        raise InputError(f"{where}: the surface encloses no volume: {surface.volume:.3g} m3 in a box of {size:.3g} m3")
    if surface.volume < 0.0:
        surface = Surface(surface.points, triangles[:, ::-1].copy())
    return surface


def _observed(reader: Any) -> list[str]:
    """Return a list that gets the messages of a VTK object, which would go to stderr."""
    messages: list[str] = []

    def note(_reader: object, _event: str, text: str = "") -> None:
        messages.append(re.sub(r"^\w+: In .*?\): ", "", " ".join(str(text).split()))[:200])

    note.CallDataType = "string0"  # type: ignore[attr-defined]
    for event in ("ErrorEvent", "WarningEvent"):
        for source in (reader, reader.GetExecutive()):
            source.AddObserver(event, note)
    return messages


def _triangles(data: vtkPolyData, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Return points and triangles; points within the tolerance, in diagonals, are merged, flat triangles left out."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkFiltersCore import vtkCleanPolyData, vtkTriangleFilter

    split, clean = vtkTriangleFilter(), vtkCleanPolyData()
    split.PassLinesOff()
    split.PassVertsOff()
    split.SetInputData(data)
    clean.SetInputConnection(split.GetOutputPort())
    clean.SetTolerance(tolerance)
    clean.Update()
    found = clean.GetOutput()
    if found.GetNumberOfPolys() == 0:
        return np.empty((0, 3)), np.empty((0, 3), np.int64)
    points = vtk_to_numpy(found.GetPoints().GetData()).astype(np.float64)
    corners = vtk_to_numpy(found.GetPolys().GetConnectivityArray()).reshape(-1, 3).astype(np.int64)
    return points, corners[(corners != np.roll(corners, 1, axis=1)).all(axis=1)]


def _open_edges(triangles: np.ndarray) -> tuple[int, np.ndarray]:
    """Return how many edges are not passed equally often in both directions, and the first of them."""
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    forward = edges[:, 0] < edges[:, 1]
    pairs, at = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
    balance = np.bincount(at.ravel(), weights=np.where(forward, 1.0, -1.0), minlength=len(pairs))
    wrong = np.flatnonzero(balance)
    return len(wrong), pairs[wrong[0]] if len(wrong) else np.empty(0, np.int64)


def _oriented(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the triangles with normals of one sense."""
    from vtkmodules.vtkFiltersCore import vtkPolyDataNormals

    normals = vtkPolyDataNormals()
    normals.SetInputData(poly_data(points, triangles))
    normals.ConsistencyOn()
    normals.AutoOrientNormalsOn()
    normals.SplittingOff()
    normals.Update()
    return _triangles(normals.GetOutput(), 0.0)


def _better(one: tuple[np.ndarray, np.ndarray], two: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the points and triangles with fewer open edges; a surface that has lost all triangles is no better."""
    return two if len(two[1]) and _open_edges(two[1])[0] < _open_edges(one[1])[0] else one

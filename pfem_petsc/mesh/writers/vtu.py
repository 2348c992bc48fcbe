"""VTK's unstructured grids (.vtu): bars are lines, groups are arrays of ones and zeros."""

from __future__ import annotations

from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np

from ...errors import InputError
from ..whole import WholeMesh

__all__ = ["SUFFIXES", "masks", "write"]

SUFFIXES = (".vtu",)

_ESCAPED = {'"': "&quot;", "\t": "&#9;", "\n": "&#10;", "\r": "&#13;"}


def write(path: Path, mesh: WholeMesh) -> None:
    """Write the mesh with its bar fields, compressed, to the last digit."""
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import VTK_LINE, vtkCellArray, vtkUnstructuredGrid
    from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridWriter

    points, cells, grid = vtkPoints(), vtkCellArray(), vtkUnstructuredGrid()
    points.SetData(numpy_to_vtk(np.ascontiguousarray(mesh.points, dtype=np.float64), deep=True))
    offsets = np.arange(0, 2 * len(mesh.bars) + 1, 2, dtype=np.int64)
    ends = np.ascontiguousarray(mesh.bars, dtype=np.int64).ravel()
    cells.SetData(numpy_to_vtkIdTypeArray(offsets, deep=True), numpy_to_vtkIdTypeArray(ends, deep=True))
    grid.SetPoints(points)
    grid.SetCells(VTK_LINE, cells)
    arrays = [(grid.GetCellData(), name, values) for name, values in mesh.bar_fields.items()]
    arrays += [(grid.GetPointData(), *mask) for mask in masks(mesh.node_groups, len(mesh.points)).items()]
    arrays += [(grid.GetCellData(), *mask) for mask in masks(mesh.bar_groups, len(mesh.bars)).items()]
    for data, name, values in arrays:
        array = numpy_to_vtk(np.ascontiguousarray(values), deep=True)
        array.SetName(escape(name, _ESCAPED))  # VTK writes names as they are
        data.AddArray(array)
    writer = vtkXMLUnstructuredGridWriter()
    writer.SetFileName(str(path))
    writer.SetInputData(grid)
    if not writer.Write() or not path.is_file():
        raise InputError(f"{path}: VTK could not write the file; is there room?")


def masks(groups: dict[str, np.ndarray], n: int) -> dict[str, np.ndarray]:
    """Return an array (n,) for each group: 1 for members, else 0."""
    found = {}
    for name, members in groups.items():
        mask = found[f"group:{name}"] = np.zeros(n, np.uint8)
        mask[members] = 1
    return found

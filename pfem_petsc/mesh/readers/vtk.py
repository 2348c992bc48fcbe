"""VTK files of lines (.vtu, .vtkhdf): cells are bars, integer cell arrays are groups.

A cell array of integers called ``group`` or ``section`` puts every bar with value i in the bar group ``group_i`` or
``section_i``; a field array of strings called ``group_names`` or ``section_names`` replaces these by its i-th entry.
Point arrays of the same names make node groups (a value below 0: in none).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from ...errors import InputError
from ..slab import MeshSlab
from .scatter import WholeMesh, read_and_scatter

__all__ = ["read"]

_VTK_LINE = 3
_ARRAYS = ("group", "section")


def read(path: Path, comm: MPI.Comm) -> MeshSlab:
    """Each rank's slab of the mesh in a VTK file, which rank 0 reads. Collective.

    Raises
    ------
    InputError
        On all ranks, for any content that is not an unstructured grid of lines.
    """
    return read_and_scatter(_read, path, comm)


def _read(path: Path) -> WholeMesh:
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkCommand

    messages: list[str] = []
    reader = _reader(path)

    def note(_caller: Any, _event: str, text: str) -> None:
        messages.append(" ".join(text.split()))

    note.CallDataType = "string0"
    reader.AddObserver(vtkCommand.ErrorEvent, note)
    reader.AddObserver(vtkCommand.WarningEvent, note)
    reader.SetFileName(str(path))
    reader.Update()
    grid = reader.GetOutputDataObject(0)
    if messages:
        raise InputError(f"{path}: cannot be read: {messages[0][-300:]}")
    if grid is None or not grid.IsA("vtkUnstructuredGrid"):
        raise InputError(f"{path}: holds a {grid.GetClassName() if grid else 'nothing'}, not an unstructured grid")
    n_nodes, n_bars = grid.GetNumberOfPoints(), grid.GetNumberOfCells()
    if n_nodes == 0 or n_bars == 0:
        raise InputError(f"{path}: {n_nodes} points and {n_bars} cells: not a mesh of bars, or a damaged file")
    types = grid.GetDistinctCellTypesArray()
    found = sorted(types.GetValue(i) for i in range(types.GetNumberOfTuples()))
    if found != [_VTK_LINE]:
        raise InputError(f"{path}: cells of types {found}; bars are lines (type {_VTK_LINE}), and nothing else is read")
    ends = vtk_to_numpy(grid.GetCells().GetConnectivityArray())
    if len(ends) != 2 * n_bars:
        raise InputError(f"{path}: {n_bars} lines with {len(ends)} ends; a bar has two")
    mesh = WholeMesh(
        points=np.array(vtk_to_numpy(grid.GetPoints().GetData()), dtype=np.float64),
        bars=ends.reshape(-1, 2).astype(np.int64),
    )
    mesh.node_groups = _groups(path, grid.GetPointData(), grid.GetFieldData())
    mesh.bar_groups = _groups(path, grid.GetCellData(), grid.GetFieldData())
    return mesh


def _reader(path: Path) -> Any:
    if path.suffix.lower() == ".vtu":
        from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridReader

        return vtkXMLUnstructuredGridReader()
    from vtkmodules.vtkIOHDF import vtkHDFReader

    return vtkHDFReader()


def _groups(path: Path, data: Any, fields: Any) -> dict[str, np.ndarray]:
    from vtkmodules.util.numpy_support import vtk_to_numpy

    groups = {}
    for array_name in _ARRAYS:
        array = data.GetArray(array_name)
        if array is None:
            continue
        values = vtk_to_numpy(array)
        if values.ndim != 1 or not np.array_equal(values, np.rint(values)):
            raise InputError(f"{path}: array {array_name!r} must hold one whole number for each")
        names = fields.GetAbstractArray(f"{array_name}_names")
        n_names = names.GetNumberOfValues() if names is not None and names.IsA("vtkStringArray") else 0
        for value in np.unique(values[values >= 0]):
            i = int(value)
            groups[names.GetValue(i) if i < n_names else f"{array_name}_{i}"] = np.flatnonzero(values == value)
    return groups

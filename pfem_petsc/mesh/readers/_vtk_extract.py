"""Extracts a mesh of lines from a VTK file; run as a program, ``_vtk_extract.py FILE RESULT.npz [FIELD ...]``.

It is a separate process because VTK aborts the process on some damaged files. Imports neither MPI nor this package. For
a file without a mesh of bars the status is 3 and the reason is printed on stdout.
"""

from __future__ import annotations

import resource
import sys
from pathlib import Path
from typing import Any

import numpy as np

REFUSED = 3

_VTK_LINE, _VTK_POLY_LINE = 3, 4
_ARRAYS = ("group", "section")
_MASK = "group:"
ALL = "*"
"""In the place of names of fields: all of them."""


def main(path: str, result: str, *fields: str) -> int:
    """Read ``path``; write ``points``, ``bars``, ``node_groups/<name>``, ``bar_groups/<name>``, ``bar_fields/<name>``
    of the named cell fields, and the names of all, ``cell_fields``, to ``result``; of the last of several snapshots."""
    from vtkmodules.vtkCommonCore import vtkOutputWindow, vtkStringOutputWindow

    # a damaged file can request any amount of memory, which takes time to fill: compressed files need at most 200 times
    # their size, including arrays and copies
    _, most = resource.getrlimit(resource.RLIMIT_AS)
    enough = (4 << 30) + 200 * Path(path).stat().st_size
    resource.setrlimit(resource.RLIMIT_AS, (enough if most == resource.RLIM_INFINITY else min(enough, most), most))
    listener = vtkStringOutputWindow()
    vtkOutputWindow.SetInstance(listener)
    reader = _reader(path)
    reader.SetFileName(path)
    reader.UpdateInformation()
    snapshots = reader.GetNumberOfSteps() if hasattr(reader, "SetStep") else 1
    if snapshots > 1:
        reader.SetStep(snapshots - 1)
    reader.Update()
    grid = reader.GetOutputDataObject(0)
    # "ERROR: In FILE, line N", then on the next line "CLASS (ADDRESS): " and the message.
    lines = listener.GetOutput().splitlines()
    messages = [line.split("): ", 1)[-1] for line in lines if line and not line.startswith(("ERROR", "Warning"))]
    try:
        if lines:
            raise ValueError(f"cannot be read: {(messages or lines)[0].strip()}")
        arrays = _arrays(grid, fields) | {"snapshots": np.array(snapshots)}
    except ValueError as error:
        print(error)
        return REFUSED
    np.savez(result, **arrays)
    return 0


def _reader(path: str) -> Any:
    if path.lower().endswith(".vtu"):
        from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridReader

        return vtkXMLUnstructuredGridReader()
    from vtkmodules.vtkIOHDF import vtkHDFReader

    return vtkHDFReader()


def _arrays(grid: Any, fields: tuple[str, ...]) -> dict[str, np.ndarray]:
    from vtkmodules.util.numpy_support import vtk_to_numpy

    if grid is None or not grid.IsA("vtkUnstructuredGrid"):
        raise ValueError(f"holds a {grid.GetClassName() if grid else 'nothing'}, not an unstructured grid")
    n_nodes, n_cells = grid.GetNumberOfPoints(), grid.GetNumberOfCells()
    if n_nodes == 0 or n_cells == 0:
        raise ValueError(f"{n_nodes} points and {n_cells} cells: not a mesh of bars, or a damaged file")
    types = grid.GetDistinctCellTypesArray()
    found = sorted(types.GetValue(i) for i in range(types.GetNumberOfTuples()))
    if not set(found) & {_VTK_LINE, _VTK_POLY_LINE}:
        raise ValueError(f"cells of types {found}; bars are lines (type {_VTK_LINE}), and there are none")
    kinds = vtk_to_numpy(grid.GetCellTypesArray())
    cells = np.flatnonzero((kinds == _VTK_LINE) | (kinds == _VTK_POLY_LINE))
    ends = vtk_to_numpy(grid.GetCells().GetConnectivityArray())
    offsets = vtk_to_numpy(grid.GetCells().GetOffsetsArray()).astype(np.int64)
    first, size = offsets[cells], offsets[cells + 1] - offsets[cells]
    if np.any((size != 2) & (kinds[cells] == _VTK_LINE)) or np.any(size < 2):
        raise ValueError("lines that do not have two ends; a bar has two")
    if first.min() < 0 or (first + size).max() > len(ends):
        raise ValueError("lines whose nodes do not exist: a damaged file")
    # a line of several points is as many bars less one: the cell of each bar, and where its ends are listed
    lines = np.repeat(cells, size - 1)
    place = np.arange(len(lines)) - np.repeat(np.cumsum(size - 1) - (size - 1), size - 1) + np.repeat(first, size - 1)
    arrays = {
        "points": vtk_to_numpy(grid.GetPoints().GetData()).astype(np.float64),
        "bars": ends[place[:, None] + np.array([0, 1])].astype(np.int64),
        "left_out": np.array(n_cells - len(cells)),
    }
    for kind, data, kept in (("node_groups", grid.GetPointData(), None), ("bar_groups", grid.GetCellData(), lines)):
        for name, members in _groups(data, grid.GetFieldData(), kept).items():
            arrays[f"{kind}/{name}"] = members
    data = grid.GetCellData()
    known = [data.GetArray(i) for i in range(data.GetNumberOfArrays())]
    known = {a.GetName(): a for a in known if a is not None and a.GetName() and a.GetNumberOfComponents() == 1}
    known = {name: a for name, a in known.items() if not name.startswith(_MASK)}
    arrays["cell_fields"] = np.array(list(known), dtype=str)
    every = [name for name in known if name not in _ARRAYS and "/" not in name]
    for name in every if fields == (ALL,) else set(fields) & set(known):
        arrays[f"bar_fields/{name}"] = vtk_to_numpy(known[name]).astype(np.float64)[lines]
    return arrays


def _groups(data: Any, fields: Any, kept: np.ndarray | None) -> dict[str, np.ndarray]:
    """Members by name, numbered among the points, or among the cells that are ``kept``."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    groups = {}
    for i in range(data.GetNumberOfArrays()):
        array = data.GetArray(i)
        name = array.GetName() or "" if array is not None else ""
        if name.startswith(_MASK) and len(name) > len(_MASK) and array.GetNumberOfComponents() == 1:
            values = vtk_to_numpy(array)
            groups[name.removeprefix(_MASK)] = np.flatnonzero(values if kept is None else values[kept])
    for array_name in _ARRAYS:
        array = data.GetArray(array_name)
        if array is None:
            continue
        values = vtk_to_numpy(array)
        if values.ndim != 1 or not np.array_equal(values, np.rint(values)):
            raise ValueError(f"array {array_name!r} must hold one whole number for each")
        values = values if kept is None else values[kept]
        names = fields.GetAbstractArray(f"{array_name}_names")
        n_names = names.GetNumberOfValues() if names is not None and names.IsA("vtkStringArray") else 0
        for value in np.unique(values[values >= 0]):
            i = int(value)
            groups[names.GetValue(i) if i < n_names else f"{array_name}_{i}"] = np.flatnonzero(values == value)
    return groups


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))

"""VTK files (.vtu, .vtp, .vtk, .vtkhdf): lines are bars, arrays of points and cells are groups and bar fields.

Other cells are left out, with a warning; without lines, the edges of triangles, quadrilaterals and polygons are bars,
with fields of nodes alone. A line of several points is as many bars less one. A cell array of integers
named ``group`` or ``section`` assigns every bar with value i to the bar group ``group_i`` or ``section_i``; a field
array of strings named ``group_names`` or ``section_names`` replaces these names by its i-th entry. Point arrays of the
same names define node groups (a negative value: no group). An array named ``group:NAME`` is the group NAME of those
with a value other than 0; these may overlap. Other arrays with one component are fields of bars and nodes.

VTK reads in a process of its own, because it aborts the process on some damaged files. That process runs this module as
a program, which therefore imports no MPI.
"""

from __future__ import annotations

import os
import pickle
import re
import resource
import signal
import subprocess
import sys
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.sax.saxutils import escape

import numpy as np

from ..errors import InputError
from ._common import drop_bare_nodes, edges

if TYPE_CHECKING:
    import pyvista

    from ..mesh.whole import WholeMesh

SUFFIXES = (".vtu", ".vtp", ".vtk", ".vtkhdf")

_LINE, _POLY_LINE = 3, 4
_FACES = (5, 7, 9)
"""Triangles, polygons and quadrilaterals."""
_NAMED = ("group", "section")
"""Arrays of numbers of groups, whose names are elsewhere."""
_MASK = "group:"
_REFUSED = 3
"""Status of the process for a file without a mesh of bars; the reason is on stdout."""


def read(path: Path, fields: Collection[str] | None = None) -> WholeMesh:
    """Return the mesh in a VTK file, with all fields.

    Raises
    ------
    InputError
        For any content that is not an unstructured grid or polygonal data, of lines or faces.
    """
    from ..mesh.whole import WholeMesh

    command = [sys.executable, "-P", "-m", __name__, str(path.resolve())]
    path_of_modules = {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    done = subprocess.run(command, env=os.environ | path_of_modules, capture_output=True, check=False)
    if done.returncode == _REFUSED:
        raise InputError(f"{path}: {done.stdout.decode(errors='replace').strip()}")
    if done.returncode < 0:
        raise InputError(
            f"{path}: VTK ended with signal {signal.Signals(-done.returncode).name} while reading it; "
            "the file is damaged or too large for this machine: write it again"
        )
    if done.returncode:
        last = done.stderr.decode(errors="replace").strip().splitlines()[-1:] or ["no message"]
        raise InputError(f"{path}: cannot be read with VTK ({last[0]}); is VTK 9.2 or newer installed?")
    arrays = pickle.loads(done.stdout)
    names = ("left_out", "snapshots", "faces", "points", "bars")
    left_out, snapshots, faces, points, bars = (arrays.pop(name) for name in names)
    mesh = WholeMesh(points, bars)
    for key, values in arrays.items():
        kind, _, name = key.partition("/")
        getattr(mesh, kind)[name] = values
    mesh.tell(faces, f"{path}: has no lines: the {len(mesh.bars)} edges of its {faces} faces are bars")
    mesh.tell(left_out, f"{path}: left out {left_out} cells that are not {'faces' if faces else 'lines'}")
    if left_out or faces:
        drop_bare_nodes(path, mesh)
    mesh.tell(snapshots > 1, f"{path}: has {snapshots} snapshots: the mesh and its fields are those of the last one")
    return mesh


# ---- the process that reads by VTK


def _extract(path: str) -> int:
    """Read ``path``; write ``points``, ``bars``, ``node_groups/NAME``, ``bar_groups/NAME``, ``bar_fields/NAME`` and
    ``node_fields/NAME`` of the last of several snapshots to stdout, as a pickled dictionary."""
    from vtkmodules.vtkCommonCore import vtkOutputWindow, vtkStringOutputWindow

    match Path(path).suffix.lower():
        case ".vtu":
            from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridReader as Reader
        case ".vtp":
            from vtkmodules.vtkIOXML import vtkXMLPolyDataReader as Reader
        case ".vtk":
            from vtkmodules.vtkIOLegacy import vtkGenericDataObjectReader as Reader
        case _:
            from vtkmodules.vtkIOHDF import vtkHDFReader as Reader

    # a damaged file can request any amount of memory, which takes time to fill: compressed files need at most 200 times
    # their size, including arrays and copies
    _, most = resource.getrlimit(resource.RLIMIT_AS)
    enough = (4 << 30) + 200 * Path(path).stat().st_size
    resource.setrlimit(resource.RLIMIT_AS, (enough if most == resource.RLIM_INFINITY else min(enough, most), most))
    listener = vtkStringOutputWindow()
    vtkOutputWindow.SetInstance(listener)
    reader = Reader()
    reader.SetFileName(path)
    reader.UpdateInformation()
    snapshots = reader.GetNumberOfSteps() if hasattr(reader, "SetStep") else 1
    if snapshots > 1:
        reader.SetStep(snapshots - 1)
    reader.Update()
    # "ERROR: In FILE, line N", then on the next line "CLASS (ADDRESS): " and the message.
    output = listener.GetOutput()  # of bytes if the file is no text
    lines = (output.decode(errors="replace") if isinstance(output, bytes) else output).splitlines()
    messages = [line.split("): ", 1)[-1] for line in lines if line and not line.startswith(("ERROR", "Warning"))]
    try:
        if lines:
            raise ValueError(f"cannot be read: {(messages or lines)[0].strip()[:200]}")
        if path.lower().endswith(".vtk"):
            _check_legacy(Path(path), reader.GetOutputDataObject(0))
        arrays = dict(_arrays(reader.GetOutputDataObject(0)))
    except ValueError as error:
        print(error)
        return _REFUSED
    pickle.dump({"snapshots": snapshots, **arrays}, sys.stdout.buffer)
    return 0


def _check_legacy(path: Path, grid: Any) -> None:
    """Refuse a legacy file whose cells need more numbers than it says that they have: VTK reads past their end."""
    declared = re.findall(rb"^(?:VERTICES|LINES|POLYGONS|TRIANGLE_STRIPS|CELLS)\s+(\d+)\s+(\d+)\s*\n(?!OFFSETS)",
                          path.read_bytes(), re.MULTILINE)  # fmt: skip
    if not declared or grid is None:
        return
    kinds = ("GetVerts", "GetLines", "GetPolys", "GetStrips") if grid.IsA("vtkPolyData") else ("GetCells",)
    cells = [getattr(grid, kind)() for kind in kinds if hasattr(grid, kind)]
    taken = sum(part.GetNumberOfCells() + part.GetNumberOfConnectivityIds() for part in cells)
    size = sum(int(count) for _, count in declared)
    if taken != size:
        raise ValueError(f"its cells need {taken} numbers, and it says that they have {size}: write it again")


def _arrays(grid: Any) -> Iterator[tuple[str, Any]]:
    from vtkmodules.util.numpy_support import vtk_to_numpy

    if grid is None or not (grid.IsA("vtkUnstructuredGrid") or grid.IsA("vtkPolyData")):
        raise ValueError(
            f"holds a {grid.GetClassName() if grid else 'nothing'}, not an unstructured grid or polygonal data"
        )
    texts = grid.GetFieldData()
    if grid.IsA("vtkPolyData"):
        from vtkmodules.vtkFiltersCore import vtkAppendFilter

        join = vtkAppendFilter()
        join.AddInputData(grid)
        join.Update()
        grid = join.GetOutput()
    n_nodes, n_cells = grid.GetNumberOfPoints(), grid.GetNumberOfCells()
    if n_nodes == 0 or n_cells == 0:
        raise ValueError(f"{n_nodes} points and {n_cells} cells: not a mesh of bars, or a damaged file")
    kinds = vtk_to_numpy(grid.GetCellTypesArray())
    lines = np.isin(kinds, (_LINE, _POLY_LINE))
    of_faces = not lines.any()
    cells = np.flatnonzero(np.isin(kinds, _FACES) if of_faces else lines)
    if len(cells) == 0:
        raise ValueError(
            f"cells of types {np.unique(kinds).tolist()}; bars are lines (type 3) or edges of faces (types 5, 7, 9), "
            "and there are none"
        )
    ends = vtk_to_numpy(grid.GetCells().GetConnectivityArray())
    offsets = vtk_to_numpy(grid.GetCells().GetOffsetsArray()).astype(np.int64)
    first, size = offsets[cells], offsets[cells + 1] - offsets[cells]
    if np.any((size != 2) & (kinds[cells] == _LINE)) or np.any(size < 2):
        raise ValueError("lines that do not have two ends; a bar has two")
    if first.min() < 0 or (first + size).max() > len(ends):
        raise ValueError("lines whose nodes do not exist: a damaged file")
    for wrong in ends[(ends < 0) | (ends >= n_nodes)][:1]:
        raise ValueError(f"there is no point {wrong}, at which a cell ends: the file has {n_nodes}, numbered from 0")
    # a line of several points is as many bars less one, a face as many as it has corners: the cell of each bar, and
    # which of its points come first and second
    count = size if of_faces else size - 1
    lines, start = np.repeat(cells, count), np.repeat(first, count)
    one = np.arange(len(lines)) - np.repeat(np.cumsum(count) - count, count)
    bars = ends[np.stack([start + one, start + (one + 1) % np.repeat(size, count)], axis=1)].astype(np.int64)
    yield "points", vtk_to_numpy(grid.GetPoints().GetData()).astype(np.float64)
    yield "bars", edges(bars)[0] if of_faces else bars
    yield from (("faces", len(cells) if of_faces else 0), ("left_out", n_cells - len(cells)))
    of_nodes, of_bars = ("node", grid.GetPointData(), slice(None)), ("bar", grid.GetCellData(), lines)
    for kind, data, kept in (of_nodes,) if of_faces else (of_nodes, of_bars):
        for name, members in _groups_of(data, texts, kept).items():
            yield f"{kind}_groups/{name}", members
        for name, values in _numbers(data).items():
            if not name.startswith(_MASK) and name not in _NAMED:
                yield f"{kind}_fields/{name}", values.astype(np.float64)[kept]


def _numbers(data: Any) -> dict[str, np.ndarray]:
    """Return the arrays of points or cells that have a name and one component."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    arrays = [data.GetArray(i) for i in range(data.GetNumberOfArrays())]
    arrays = [array for array in arrays if array is not None and array.GetName()]
    return {array.GetName(): vtk_to_numpy(array) for array in arrays if array.GetNumberOfComponents() == 1}


def _groups_of(data: Any, fields: Any, kept: slice | np.ndarray) -> dict[str, np.ndarray]:
    """Members by name, numbered among the points or the cells that are ``kept``."""
    arrays = _numbers(data)
    groups = {
        name.removeprefix(_MASK): np.flatnonzero(values[kept])
        for name, values in arrays.items()
        if name.startswith(_MASK) and len(name) > len(_MASK)
    }
    for array in [name for name in _NAMED if data.GetArray(name) is not None]:
        values = arrays.get(array)
        if values is None or not np.array_equal(values, np.rint(values)):
            raise ValueError(f"array {array!r} must hold one whole number for each")
        values, names = values[kept].astype(np.int64), fields.GetAbstractArray(f"{array}_names")
        n_names = names.GetNumberOfValues() if names is not None and names.IsA("vtkStringArray") else 0
        for i in np.unique(values[values >= 0]).tolist():
            groups[names.GetValue(i) if i < n_names else f"{array}_{i}"] = np.flatnonzero(values == i)
    return groups


# ---- writing


def write(path: Path, mesh: WholeMesh) -> None:
    """Write the mesh with its fields, to the last digit; groups are arrays of ones and zeros."""
    from ..mesh.whole import without_slashes

    if path.suffix.lower() == ".vtkhdf":
        kinds = ("node_groups", "bar_groups", "bar_fields", "node_fields")
        _write_vtkhdf(path, replace(mesh, **{kind: without_slashes(getattr(mesh, kind)) for kind in kinds}))
        return
    match path.suffix.lower():
        case ".vtk":
            from vtkmodules.vtkIOLegacy import vtkUnstructuredGridWriter as Writer
        case ".vtp":
            from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter as Writer
        case _:
            from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridWriter as Writer
    legacy = path.suffix.lower() == ".vtk"
    writer = Writer()
    writer.SetFileName(str(path))
    if legacy:
        writer.SetFileTypeToBinary()
    # VTK writes names into XML as they are
    named = str if legacy else partial(escape, entities={'"': "&quot;", "\t": "&#9;", "\n": "&#10;", "\r": "&#13;"})
    writer.SetInputData(grid_of(mesh, named, polygonal=path.suffix.lower() == ".vtp"))
    if not writer.Write() or not path.is_file():
        raise InputError(f"{path}: VTK could not write the file; is there room?")


def grid_of(mesh: WholeMesh, named: Callable[[str], str] = str, polygonal: bool = False) -> pyvista.DataSet:
    """Return an unstructured grid of lines, or polygonal data, with the fields; groups are ``group:NAME``, 1 for
    members; ``named`` gives names."""
    import pyvista

    cells = np.column_stack([np.full(len(mesh.bars), 2), mesh.bars]).ravel()
    if polygonal:
        grid = pyvista.PolyData(np.asarray(mesh.points), lines=cells)
    else:
        grid = pyvista.UnstructuredGrid(cells, np.full(len(mesh.bars), _LINE, np.uint8), mesh.points)
    for kind, arrays in _data(mesh).items():
        for name, values in arrays.items():
            getattr(grid, kind)[named(name)] = values
    return grid


def _data(mesh: WholeMesh) -> dict[str, dict[str, np.ndarray]]:
    """Return arrays of points and cells by name: fields, and masks of groups."""

    def masks(groups: Mapping[str, np.ndarray], n: int) -> dict[str, np.ndarray]:
        found = {f"{_MASK}{name}": np.zeros(n, np.uint8) for name in groups}
        for mask, members in zip(found.values(), groups.values()):
            mask[members] = 1
        return found

    return {
        "cell_data": mesh.bar_fields | masks(mesh.bar_groups, len(mesh.bars)),
        "point_data": mesh.node_fields | masks(mesh.node_groups, len(mesh.points)),
    }


def _write_vtkhdf(path: Path, mesh: WholeMesh) -> None:
    """Version 1.0 of the format."""
    import h5py

    n = len(mesh.bars)
    with h5py.File(path, "w", locking=False) as file:
        root = file.create_group("VTKHDF", track_order=True)
        root.attrs["Version"] = np.array([1, 0], np.int64)
        root.attrs.create("Type", b"UnstructuredGrid", dtype=h5py.string_dtype("ascii", 16))
        datasets = {
            "NumberOfPoints": np.array([len(mesh.points)], np.int64),
            "NumberOfCells": np.array([n], np.int64),
            "NumberOfConnectivityIds": np.array([2 * n], np.int64),
            "Points": np.asarray(mesh.points, np.float64),
            "Connectivity": np.asarray(mesh.bars, np.int64).ravel(),
            "Offsets": np.arange(0, 2 * n + 1, 2, dtype=np.int64),
            "Types": np.full(n, _LINE, np.uint8),
        }
        for name, values in datasets.items():
            root[name] = values
        for kind, arrays in _data(mesh).items():
            # in the order in which they are given
            group = root.create_group({"cell_data": "CellData", "point_data": "PointData"}[kind], track_order=True)
            for name, values in arrays.items():
                group[name] = values


if __name__ == "__main__":
    sys.exit(_extract(*sys.argv[1:]))

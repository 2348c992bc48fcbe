"""The groups and datasets of a result file, its provenance, and what of it is complete."""

from __future__ import annotations

import json
import platform
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from mpi4py import MPI

from ..errors import InputError
from ..version import __version__
from .hdf5 import chunk_rows, create_growing, dataset_names, is_compressed, set_text, set_unit
from .units import field_unit, unit_of

LONGEST_ATTRIBUTE = 1 << 15
"""HDF5 1.10 limits an attribute, including its metadata, to 64 KiB."""
CHECKS, EVENT, MODES, BARS = "checks", "event", "modes", "bars"
"""Groups of checksums, of the table of events (what happened between recorded steps), of modes, and of what bars have
in all snapshots."""
MODE_VALUES = {"vibration": ("frequency", "Hz"), "buckling": ("load_factor", "")}
"""Name and unit of the numbers of each kind of modes."""
VTK_LINE = 3
STEPS_PER_CHUNK = 256
ROWS_PER_CHUNK, CHUNK_BYTES = 512, 1 << 16
"""Of a table: few, so that a short run has a small file (the first row allocates a whole chunk)."""
PER_STEP = ("PointOffsets", "CellDataRows", "CellOffsets", "ConnectivityIdOffsets", "PartOffsets", "NumberOfParts")
"""Entries of a snapshot in /VTKHDF/Steps besides its time."""


class Constant(NamedTuple):
    """What a bar has in all snapshots: values (local bars,), their SI unit, and the names that numbers stand for."""

    values: np.ndarray
    unit: str = ""
    names: Sequence[str] = ()


class Contents(NamedTuple):
    """What a result file is made for.

    Attributes
    ----------
    point_fields, cell_fields : names of the fields; the shape of their rows is that in the first snapshot
    columns : of the history ("wall/floor/force") to the type of a value, with its shape
    case_text : the resolved case
    attributes : of ``/case``: numbers, texts, or any JSON data
    events : columns of the table ``/event`` to their types, one of them ``step``; without any there is no such table
    modes : kind of the modes that will be written, "vibration" or "buckling"
    precision : of the fields, "float64" or "float32"; points are always float64, because strains from positions in
        single precision are noise
    compressed : whether points and fields are compressed without loss; a file that is continued keeps what it has
    constants : what bars have in all snapshots, by name; a file that is continued keeps what it has
    """

    point_fields: Sequence[str]
    cell_fields: Sequence[str]
    columns: Mapping[str, np.dtype]
    case_text: str
    attributes: Mapping[str, Any]
    events: Mapping[str, np.dtype] = {}
    modes: str | None = None
    precision: str = "float64"
    compressed: bool = False
    constants: Mapping[str, Constant] = {}

    @property
    def fields(self) -> dict[str, list[str]]:
        """Sorted names of the fields by ``PointData`` and ``CellData``."""
        return {"PointData": sorted(self.point_fields), "CellData": sorted(self.cell_fields)}


class Kept(NamedTuple):
    """What a restart keeps of a result file: events up to the ``step`` that the run goes on from, and the steps of the
    last ``snapshot`` and of the last ``row``, where not all up to that step are."""

    step: int
    snapshot: int
    row: int


def describe_run(comm: MPI.Comm, attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return versions, number of ranks and PETSc options of this run, updated with the given attributes."""
    from petsc4py import PETSc

    return {
        "pfem_petsc": __version__,
        "petsc": ".".join(map(str, PETSc.Sys.getVersion())),
        "numpy": np.__version__,
        "h5py": h5py.__version__,
        "hdf5": h5py.version.hdf5_version,
        "python": platform.python_version(),
        "mpi": MPI.Get_library_version().split("\x00")[0].splitlines()[0].strip(),
        "ranks": comm.size,
        "petsc_options": PETSc.Options().getAll(),
        **attributes,
    }


def _plain(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else str(value)


def write_case(file: h5py.File, case_text: str, attributes: Mapping[str, Any]) -> None:
    """Store the case in ``/case``: dataset ``text`` and attributes. Values other than numbers or texts become JSON.

    Attributes that exceed the limit of HDF5 become datasets of the same name.
    """
    group = file.require_group("case")
    for name, value in attributes.items():
        if isinstance(value, (bool, int, float, np.integer, np.floating, np.bool_)):
            group.attrs[name] = value
        else:
            text = value if isinstance(value, str) else "json:" + json.dumps(value, default=_plain)
            raw = text.encode(errors="backslashreplace")
            group.pop(name, None)
            if len(raw) > LONGEST_ATTRIBUTE:
                set_text(group, name, text)
                group.attrs.pop(name, None)
            else:
                group.attrs.create(name, raw, dtype=h5py.string_dtype("utf-8", max(1, len(raw))))
    set_text(group, "text", case_text)
    group["text"].attrs["checksum"] = zlib.crc32(case_text.encode())


def read_attributes(group: h5py.Group) -> dict[str, Any]:
    """Return the attributes stored by :func:`write_case`, with their types."""
    found: dict[str, Any] = {}
    long = {name: group[name][()] for name in dataset_names(group) if name != "text"}
    for name, value in [*group.attrs.items(), *long.items()]:
        if isinstance(value, bytes):
            value = value.decode()
        if isinstance(value, str) and value.startswith("json:"):
            value = json.loads(value.removeprefix("json:"))
        found[name] = value.item() if isinstance(value, np.generic) else value
    return found


def create_result(file: h5py.File, n_nodes: int, n_bars: int, contents: Contents) -> None:
    """Create the structure of a result file without fields: VTKHDF 2.0 without steps, tables, case, modes.

    The mesh is one part, whatever the number of ranks, and all steps use the same connectivity (offset 0).
    """
    vtk = file.create_group("VTKHDF")
    vtk.attrs["Version"] = np.array([2, 0], dtype=np.int64)
    # The VTK reader requires a text of fixed length.
    kind = b"UnstructuredGrid"
    vtk.attrs.create("Type", kind, dtype=h5py.string_dtype("ascii", len(kind)))
    for name, value in (
        ("NumberOfPoints", n_nodes),
        ("NumberOfCells", n_bars),
        ("NumberOfConnectivityIds", 2 * n_bars),
    ):
        vtk.create_dataset(name, data=np.array([value], dtype=np.int64))
    vtk.create_dataset("Connectivity", shape=(2 * n_bars,), dtype=np.int64)
    vtk.create_dataset("Offsets", shape=(n_bars + 1,), dtype=np.int64)
    vtk.create_dataset("Types", data=np.full(n_bars, VTK_LINE, dtype=np.uint8))
    compressed = contents.compressed
    create_growing(vtk, "Points", (3,), np.float64, chunk_rows(n_nodes, 24, compressed), compressed)
    steps = vtk.create_group("Steps")
    steps.attrs["NSteps"] = np.int64(0)
    create_growing(steps, "Values", (), np.float64, STEPS_PER_CHUNK)
    for name in PER_STEP:
        # One column, because there is one type of cell.
        row_shape = (1,) if name in ("CellOffsets", "ConnectivityIdOffsets") else ()
        create_growing(steps, name, row_shape, np.int64, STEPS_PER_CHUNK)
    for group in ("PointData", "CellData"):
        vtk.create_group(group)
        steps.create_group(group + "Offsets")
    for name, constant in contents.constants.items():
        # the fields of VTK, and a group of their own, which tells them from those of snapshots
        data = file.create_dataset(f"{BARS}/{name}", shape=(n_bars,), dtype=constant.values.dtype)
        set_unit(data, constant.unit)
        if constant.names:
            data.attrs["names"] = list(constant.names)
        vtk["CellData"][name] = data
        steps["CellDataOffsets"][name] = steps["PartOffsets"]  # zero in all steps
    snapshots = file.create_group("snapshots")
    create_growing(snapshots, "step", (), np.int64, STEPS_PER_CHUNK)
    create_growing(snapshots, "time", (), np.float64, STEPS_PER_CHUNK)
    checks = file.create_group(CHECKS)
    for name in ("mesh", *([BARS] if contents.constants else [])):
        checks.create_dataset(name, data=np.zeros(1, dtype=np.uint64))
    _create_table(file, "history", contents.columns)
    if contents.events:
        _create_table(file, EVENT, contents.events)
    write_case(file, contents.case_text, contents.attributes)
    prepare_modes(file, contents.modes, n_nodes)


def _create_table(file: h5py.File, name: str, columns: Mapping[str, np.dtype]) -> None:
    """Create a table with an empty dataset per column, the attribute ``rows``, the number of complete rows, and its
    checksums."""
    group = file.create_group(name)
    group.attrs["rows"] = np.int64(0)
    for column, dtype in columns.items():
        rows = max(1, min(ROWS_PER_CHUNK, CHUNK_BYTES // max(1, dtype.itemsize)))
        set_unit(create_growing(group, column, dtype.shape, dtype.base, rows), unit_of(column))
    create_growing(file[CHECKS], name, (), np.uint64, ROWS_PER_CHUNK)


def prepare_modes(file: h5py.File, kind: str | None, n_nodes: int) -> None:
    """Create the group ``/modes`` without modes, replacing an existing one, or remove it for None. Not collective.

    ``eigenvalue`` (modes,), ``frequency`` [Hz] or ``load_factor`` (modes,), ``shape`` (modes, nodes, 3) in mesh
    numbering; the attribute ``kind``. ``/checks/modes`` has one checksum per mode, written last; a mode without one is
    ignored.
    """
    file.pop(MODES, None)
    file[CHECKS].pop(MODES, None)
    if kind is None:
        return
    group = file.create_group(MODES)
    group.attrs.create("kind", kind.encode(), dtype=h5py.string_dtype("utf-8", len(kind)))
    name, unit = MODE_VALUES[kind]
    vibrates = kind == "vibration"
    set_unit(create_growing(group, name, (), np.float64, 64), unit)
    set_unit(create_growing(group, "eigenvalue", (), np.float64, 64), "1/s²" if vibrates else "")
    shape = create_growing(group, "shape", (n_nodes, 3), np.float64, (1, chunk_rows(n_nodes, 24), 3))
    set_unit(shape, "kg^-1/2" if vibrates else "")
    create_growing(file[CHECKS], MODES, (), np.uint64, 64)


def create_field(vtk: h5py.Group, kind: str, name: str, row_shape: tuple[int, ...], dtype: np.dtype) -> h5py.Dataset:
    """Create a field, ``kind`` "PointData" or "CellData". Collective for a shared file.

    It is compressed if the points are. All point fields of a snapshot start at the same row, as do all cell fields.
    Their offsets are one dataset with several names (hard links), so they are always consistent.
    """
    n_rows = int(vtk["NumberOfPoints" if kind == "PointData" else "NumberOfCells"][0])
    row_bytes = dtype.itemsize * int(np.prod(row_shape, dtype=np.int64))
    compressed = is_compressed(vtk["Points"])
    rows = chunk_rows(n_rows, row_bytes, compressed)
    dataset = create_growing(vtk[kind], name, row_shape, dtype, rows, compressed)
    set_unit(dataset, field_unit(name))
    vtk["Steps"][kind + "Offsets"][name] = vtk["Steps"]["PointOffsets" if kind == "PointData" else "CellDataRows"]
    return dataset


def create_snapshot_checks(file: h5py.File) -> h5py.Dataset:
    """Create the checksums of snapshots, after all fields. Collective for a shared file."""
    return create_growing(
        file[CHECKS], "snapshots", (1 + len(field_datasets(file["VTKHDF"])),), np.uint64, STEPS_PER_CHUNK
    )


def field_names(vtk: h5py.Group, kind: str) -> list[str]:
    """Return the sorted names of the fields of snapshots, ``kind`` "PointData" or "CellData"."""
    return sorted(set(vtk[kind]) - (set(constants(vtk.file)) if kind == "CellData" else set()))


def constants(file: h5py.File) -> list[str]:
    """Return the sorted names of what bars have in all snapshots."""
    return sorted(file[BARS]) if BARS in file else []


def field_datasets(vtk: h5py.Group) -> dict[str, h5py.Dataset]:
    """Return the datasets of points and fields: {"Points": …, "PointData/velocity": …, "CellData/stress": …}."""
    kinds = "PointData", "CellData"
    found = {f"{kind}/{name}": vtk[kind][name] for kind in kinds for name in field_names(vtk, kind)}
    return {"Points": vtk["Points"]} | found


def row_type(dataset: h5py.Dataset) -> np.dtype:
    """Return the type of a row of a dataset, with its shape."""
    return np.dtype((dataset.dtype, dataset.shape[1:])) if dataset.shape[1:] else dataset.dtype


def check_version(file: h5py.File, path: Path) -> None:
    """Refuse a result without checksums.

    Raises
    ------
    InputError
    """
    if CHECKS not in file:
        version = read_attributes(file["case"]).get("pfem_petsc", "an earlier one")
        raise InputError(
            f"{path}: has no checksums: version {version} of pfem_petsc wrote it; "
            "run the case again, or read it with that version or ParaView"
        )


def mesh_sizes(file: h5py.File) -> tuple[int, int]:
    """Return the numbers of nodes and bars."""
    return int(file["VTKHDF/NumberOfPoints"][0]), int(file["VTKHDF/NumberOfCells"][0])


def complete_snapshots(file: h5py.File) -> int:
    """Return the number of complete snapshots; a killed run may have left parts of another one."""
    steps, (n_nodes, n_bars) = file["VTKHDF/Steps"], mesh_sizes(file)
    lengths = [
        int(steps.attrs["NSteps"]),
        len(steps["Values"]),
        len(file["snapshots/step"]),
        len(file["snapshots/time"]),
    ]
    lengths += [len(steps[name]) for name in PER_STEP]
    lengths.append(len(file[CHECKS]["snapshots"]) if "snapshots" in file[CHECKS] else 0)
    for name, dataset in field_datasets(file["VTKHDF"]).items():
        rows = n_bars if name.startswith("CellData") else n_nodes
        lengths += [len(dataset) // rows] if rows else []
    return min(lengths)


def complete_rows(file: h5py.File, table: str = "history") -> int:
    """How many rows of the history, or of another table, are complete; zero where the file has no such table."""
    if table not in file:
        return 0
    rows = file[table]
    lengths = [len(rows[name]) for name in dataset_names(rows)]
    return min(int(rows.attrs["rows"]), len(file[CHECKS][table]), *lengths)


def complete_modes(file: h5py.File) -> int:
    """Return the number of complete modes."""
    if MODES not in file or MODES not in file[CHECKS]:
        return 0
    return min(len(file[CHECKS][MODES]), *(len(dataset) for dataset in file[MODES].values()))

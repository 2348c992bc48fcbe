"""The groups and datasets of a result file, its provenance, and the number of its complete rows."""

from __future__ import annotations

import json
import platform
import zlib
from collections.abc import Mapping
from typing import Any

import h5py
import numpy as np
from mpi4py import MPI

from ..version import __version__
from .hdf5 import chunk_rows, compressed_rows, create_growing, dataset_names, is_compressed, set_text, set_unit
from .history import EVENT, ROWS_PER_CHUNK, create_history
from .integrity import CHECKS
from .modes import create_modes
from .units import field_unit

# HDF5 1.10 limits an attribute, including its metadata, to 64 KiB.
LONGEST_ATTRIBUTE = 1 << 15


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


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    return value.item() if isinstance(value, np.generic) else str(value)


VTK_LINE = 3
STEPS_PER_CHUNK = 256
# Entries of a snapshot in /VTKHDF/Steps besides its time.
PER_STEP = ("PointOffsets", "CellDataRows", "CellOffsets", "ConnectivityIdOffsets", "PartOffsets", "NumberOfParts")


def create_result(
    file: h5py.File,
    n_nodes: int,
    n_bars: int,
    columns: Mapping[str, tuple[int, ...]],
    column_types: Mapping[str, Any],
    case_text: str,
    attributes: Mapping[str, Any],
    modes: str | None = None,
    events: Mapping[str, Any] | None = None,
    compressed: bool = False,
) -> None:
    """Create the structure of a result file without fields: VTKHDF 2.0 without steps, history, case.

    ``events``: columns of the table of events with their types, empty for none; ``compressed``: points, and fields that
    are created later.

    The mesh is one part, whatever the number of ranks, and all steps use the same connectivity (offset 0).
    ``modes`` is the kind of those that there will be.
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
    rows = compressed_rows(n_nodes, 24) if compressed else chunk_rows(n_nodes, 24)
    create_growing(vtk, "Points", (3,), np.float64, rows, compressed)
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
    snapshots = file.create_group("snapshots")
    create_growing(snapshots, "step", (), np.int64, STEPS_PER_CHUNK)
    create_growing(snapshots, "time", (), np.float64, STEPS_PER_CHUNK)
    checks = file.create_group(CHECKS)
    checks.create_dataset("mesh", data=np.zeros(1, dtype=np.uint64))
    create_growing(checks, "history", (), np.uint64, ROWS_PER_CHUNK)
    create_history(file, columns, column_types)
    if events:
        create_growing(checks, EVENT, (), np.uint64, ROWS_PER_CHUNK)
        create_history(file, dict.fromkeys(events, ()), events, EVENT)
    write_case(file, case_text, attributes)
    if modes is not None:
        create_modes(file, modes, n_nodes)


def create_field(vtk: h5py.Group, kind: str, name: str, row_shape: tuple[int, ...], dtype: np.dtype) -> h5py.Dataset:
    """Create a field, ``kind`` "PointData" or "CellData". Collective for a shared file.

    It is compressed if the points are. All point fields of a snapshot start at the same row, as do all cell fields.
    Their offsets are one dataset with several names (hard links), so they are always consistent.
    """
    n_rows = int(vtk["NumberOfPoints" if kind == "PointData" else "NumberOfCells"][0])
    row_bytes = dtype.itemsize * int(np.prod(row_shape, dtype=np.int64))
    compressed = is_compressed(vtk["Points"])
    rows = compressed_rows(n_rows, row_bytes) if compressed else chunk_rows(n_rows, row_bytes)
    dataset = create_growing(vtk[kind], name, row_shape, dtype, rows, compressed)
    set_unit(dataset, field_unit(name))
    vtk["Steps"][kind + "Offsets"][name] = vtk["Steps"]["PointOffsets" if kind == "PointData" else "CellDataRows"]
    return dataset


def create_snapshot_checks(file: h5py.File) -> h5py.Dataset:
    """Create the checksums of snapshots, after all fields. Collective for a shared file."""
    return create_growing(
        file[CHECKS], "snapshots", (1 + len(field_datasets(file["VTKHDF"])),), np.uint64, STEPS_PER_CHUNK
    )


def field_datasets(vtk: h5py.Group) -> dict[str, h5py.Dataset]:
    """Return the datasets of points and fields: {"Points": …, "PointData/velocity": …, "CellData/stress": …}."""
    found = {"Points": vtk["Points"]}
    for kind in ("PointData", "CellData"):
        for name in vtk[kind]:
            found[f"{kind}/{name}"] = vtk[kind][name]
    return found


def complete_snapshots(file: h5py.File) -> int:
    """Return the number of complete snapshots; a killed run may have left parts of another one."""
    vtk, steps = file["VTKHDF"], file["VTKHDF/Steps"]
    lengths = [
        int(steps.attrs["NSteps"]),
        len(steps["Values"]),
        len(file["snapshots/step"]),
        len(file["snapshots/time"]),
    ]
    lengths += [len(steps[name]) for name in PER_STEP]
    if CHECKS in file:  # 0.1.0 wrote none
        lengths.append(len(file[CHECKS]["snapshots"]) if "snapshots" in file[CHECKS] else 0)
    n_nodes, n_bars = int(vtk["NumberOfPoints"][0]), int(vtk["NumberOfCells"][0])
    for name, dataset in field_datasets(vtk).items():
        rows = n_bars if name.startswith("CellData") else n_nodes
        lengths += [len(dataset) // rows] if rows else []
    return min(lengths)


def complete_rows(file: h5py.File, table: str = "history") -> int:
    """How many rows of the history, or of another table, are complete; zero where the file has no such table."""
    if table not in file:
        return 0
    rows = file[table]
    return min(
        [
            int(rows.attrs["rows"]),
            *([len(file[CHECKS][table])] if CHECKS in file else []),
            *(len(rows[name]) for name in dataset_names(rows)),
        ]
    )

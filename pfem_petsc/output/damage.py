"""What of a result file does not match its checksums; also the process that :mod:`~.verify` starts."""

from __future__ import annotations

import sys
import zlib
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np

from ..columns import Layout
from ..errors import InputError
from .hdf5 import dataset_names
from .integrity import BLOCK, RowDigests, mark_digest, numbers_digest, seeded, stored_sum, word_sum
from .layout import (
    CHECKS,
    EVENT,
    MODE_VALUES,
    MODES,
    PER_STEP,
    check_version,
    complete_modes,
    complete_rows,
    complete_snapshots,
    field_datasets,
    row_type,
)
from .result import readable


def damages(file: h5py.File, deep: bool = True) -> Iterator[str]:
    """Yield one line for each defect of a result file.

    ``deep``: whether to read the values of all snapshots; else only those of mesh, steps, times and history.
    """
    vtk, steps, checks = file["VTKHDF"], file["VTKHDF/Steps"], file[CHECKS]
    n_nodes, n_bars = int(vtk["NumberOfPoints"][0]), int(vtk["NumberOfCells"][0])
    yield from _mesh_damages(vtk, int(checks["mesh"][0]), n_bars)
    n = complete_snapshots(file)
    expected = {"PointOffsets": n_nodes, "CellDataRows": n_bars}
    for name in PER_STEP:
        rows = expected[name] * np.arange(n) if name in expected else np.full(n, int(name == "NumberOfParts"))
        if not np.array_equal(steps[name][:n].ravel(), rows):
            yield f"VTKHDF/Steps/{name} does not match the mesh"
    if n:
        digests = checks["snapshots"][:n]
        numbers, times = file["snapshots/step"][:n], file["snapshots/time"][:n]
        values = steps["Values"][:n]
        for i in range(n):
            if mark_digest(i, numbers[i], times[i]) != int(digests[i, 0]) or values[i] != times[i]:
                yield f"step and time of snapshot {i} do not match their checksum"
        if deep:
            for k, (name, dataset) in enumerate(sorted(field_datasets(vtk).items())):
                size = n_bars if name.startswith("CellData") else n_nodes
                for i in range(n):
                    if seeded(name, stored_sum(dataset, i * size, size)) != int(digests[i, 1 + k]):
                        yield f"{name} of snapshot {i} (t = {times[i]:.6g} s) does not match its checksum"
    for table in ("history", EVENT):
        if table in file:
            yield from _history_damages(file[table], checks[table], complete_rows(file, table))
    yield from _mode_damages(file, deep)
    if zlib.crc32(file["case/text"][()]) != int(file["case/text"].attrs["checksum"]):
        yield "the text of the case does not match its checksum"


def _mesh_damages(vtk: h5py.Group, digest: int, n_bars: int) -> Iterator[str]:
    if stored_sum(vtk["Connectivity"], 0, 2 * n_bars) != digest:
        yield "the connectivity of the bars does not match its checksum"
    for start in range(0, n_bars + 1, BLOCK):
        stop = min(start + BLOCK, n_bars + 1)
        if not np.array_equal(vtk["Offsets"][start:stop], 2 * np.arange(start, stop)):
            yield "VTKHDF/Offsets does not match the mesh"
            break
    if not all((vtk["Types"][start : start + BLOCK] == 3).all() for start in range(0, n_bars, BLOCK)):
        yield "VTKHDF/Types holds other cells than lines"


def _history_damages(history: h5py.Group, digests: h5py.Dataset, n_rows: int) -> Iterator[str]:
    names = dataset_names(history)
    digest = RowDigests(Layout({name: row_type(history[name]) for name in names}))
    for first in range(0, n_rows, 4096):
        rows = slice(first, min(first + 4096, n_rows))
        wrong = digest.of_columns({name: history[name][rows] for name in names}, first) != digests[rows]
        if wrong.any():
            at = first + np.nonzero(wrong)[0]
            yield f"{history.name[1:]}: {len(at)} rows do not match their checksums, the first is row {at[0]}"


def _mode_damages(file: h5py.File, deep: bool) -> Iterator[str]:
    """Yield one line for each defect of the modes."""
    n = complete_modes(file)
    if not n:
        return
    group = file[MODES]
    name = next(name for name, _ in MODE_VALUES.values() if name in group)
    values, eigenvalues, digests = group[name][:n], group["eigenvalue"][:n], file[CHECKS][MODES][:n]
    for k in range(n if deep else 0):
        total = np.uint64(seeded("shape", word_sum(group["shape"][k], 0)))
        if total ^ np.uint64(numbers_digest(k, eigenvalues[k], values[k])) != digests[k]:
            yield f"mode {k + 1} does not match its checksum"


def main() -> int:
    """Print one line for each defect of the file that the command line names; return the exit status."""
    path, deep = Path(sys.argv[1]), sys.argv[2] == "deep"
    try:
        with readable(path), h5py.File(path, "r", locking=False) as file:
            # all metadata, including those without a checksum of this program
            dataset_names(file)
            for name in ("VTKHDF", "VTKHDF/Steps", "history", "case"):
                dict(file[name].attrs)
            check_version(file, path)
            for line in damages(file, deep):
                print(line, flush=True)
    except InputError as error:
        print(error, file=sys.stderr)
        return error.exit_status
    return 0

"""Checksums of the content of a result file: one per snapshot and field, one per history row, one of the mesh.

They stand in the group ``checks`` of the file itself: ``snapshots`` (snapshots, 1 + fields), whose first column is of
step and time, the others of points and fields in the order of their names; ``history`` (rows,); ``mesh`` (1,); and
``modes`` (modes,) in a case that asks for them. Rows are cut off with the data that they belong to, so that a file that
is continued keeps those of what it keeps.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping

import h5py
import numpy as np
from mpi4py import MPI

from .integrity import BLOCK, word_sum

__all__ = [
    "CHECKS",
    "RowDigests",
    "damages",
    "mark_digest",
    "mesh_digest",
    "numbers_digest",
    "row_digests",
    "snapshot_digests",
    "stored_digest",
]

CHECKS = "checks"
_ODD = 0x9E3779B97F4A7C15


def snapshot_digests(comm: MPI.Comm, sums: Mapping[str, int]) -> np.ndarray:
    """Return checksums (fields,) uint64 of arrays distributed in slabs over the ranks, sorted by name. Collective.

    ``sums``: name to :func:`~.integrity.word_sum` of this rank's rows, in the type in which they are stored.
    """
    total = np.array([_seeded(name, part) for name, part in sorted(sums.items())], dtype=np.uint64)
    comm.Allreduce(MPI.IN_PLACE, total, op=MPI.SUM)
    return total


def mark_digest(n: int, step: int, time: float) -> int:
    """Return the checksum of the step and time [s] of snapshot n."""
    return _number(np.array([n, step], dtype=np.int64).tobytes() + np.float64(time).tobytes())


def numbers_digest(index: int, *numbers: float) -> int:
    """Checksum of an index and numbers."""
    return _number(np.int64(index).tobytes() + np.array(numbers, dtype=np.float64).tobytes())


def stored_digest(name: str, values: np.ndarray) -> int:
    """What :func:`snapshot_digests` gives for an array of this name that is here as a whole."""
    return _seeded(name, word_sum(values, 0))


def mesh_digest(comm: MPI.Comm, total: int) -> np.ndarray:
    """Return the checksum (1,) of the connectivity from :func:`~.integrity.word_sum` of each rank. Collective."""
    whole = np.array([total], dtype=np.uint64)
    comm.Allreduce(MPI.IN_PLACE, whole, op=MPI.SUM)
    return whole


def row_digests(columns: Mapping[str, np.ndarray], first: int) -> np.ndarray:
    """Return checksums (rows,) uint64 of history rows.

    ``columns``: name to values (rows, ...) in the type in which they are stored; ``first``: index of the first row.
    """
    n = len(next(iter(columns.values())))
    numbers = np.arange(first + 1, first + n + 1, dtype=np.uint64)
    total = numbers * np.uint64(_ODD)
    for name, values in columns.items():
        words = np.ascontiguousarray(values).reshape(n, int(np.prod(values.shape[1:], dtype=np.int64)))
        words = words.view(f"u{words.dtype.itemsize}").astype(np.uint64)
        factors = _factors(np.arange(words.shape[1], dtype=np.uint64) + np.uint64(_number(name.encode())))
        total += np.sum(words * factors, axis=1, dtype=np.uint64)
    return total


class RowDigests:
    """What :func:`row_digests` gives, from rows as vectors of float64.

    Parameters
    ----------
    places : name to the first and the end position of a column in the vector, and its type in the file
    """

    def __init__(self, places: Mapping[str, tuple[int, int, np.dtype]]) -> None:
        self._factors = np.zeros(max((end for _, end, _ in places.values()), default=0), dtype=np.uint64)
        # columns whose numbers in the file have other words than those in the vector
        self._others = [place for place in places.values() if place[2] != np.float64]
        for name, (first, end, _) in places.items():
            index = np.arange(end - first, dtype=np.uint64)
            self._factors[first:end] = _factors(index + np.uint64(_number(name.encode())))

    def __call__(self, rows: np.ndarray, first: int) -> np.ndarray:
        """Return checksums (n,) of rows (n, width), of which the first is row ``first`` of the table."""
        words = np.ascontiguousarray(rows).view(np.uint64)
        if self._others:
            words = words.copy()
        for begin, end, dtype in self._others:
            words[:, begin:end] = rows[:, begin:end].astype(dtype).view(f"u{dtype.itemsize}")
        numbers = np.arange(first + 1, first + len(rows) + 1, dtype=np.uint64)
        return numbers * np.uint64(_ODD) + (words * self._factors).sum(axis=1, dtype=np.uint64)


def damages(file: h5py.File, deep: bool = True) -> Iterator[str]:
    """Yield one line for each defect of a result file.

    ``deep``: whether to read the values of all snapshots; else only those of mesh, steps, times and history.
    """
    # the layout needs what writes rows, which needs this module
    from .history import EVENT
    from .layout import PER_STEP, complete_rows, complete_snapshots, field_datasets
    from .modes import mode_damages

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
                    if _seeded(name, _stored_sum(dataset, i * size, size)) != int(digests[i, 1 + k]):
                        yield f"{name} of snapshot {i} (t = {times[i]:.6g} s) does not match its checksum"
    for table in ("history", EVENT):
        if table in file:
            yield from _history_damages(file[table], checks[table], complete_rows(file, table))
    yield from mode_damages(file, deep)
    if zlib.crc32(file["case/text"][()]) != int(file["case/text"].attrs["checksum"]):
        yield "the text of the case does not match its checksum"


def _mesh_damages(vtk: h5py.Group, digest: int, n_bars: int) -> Iterator[str]:
    if _stored_sum(vtk["Connectivity"], 0, 2 * n_bars) != digest:
        yield "the connectivity of the bars does not match its checksum"
    for start in range(0, n_bars + 1, BLOCK):
        stop = min(start + BLOCK, n_bars + 1)
        if not np.array_equal(vtk["Offsets"][start:stop], 2 * np.arange(start, stop)):
            yield "VTKHDF/Offsets does not match the mesh"
            break
    if not all((vtk["Types"][start : start + BLOCK] == 3).all() for start in range(0, n_bars, BLOCK)):
        yield "VTKHDF/Types holds other cells than lines"


def _history_damages(history: h5py.Group, digests: h5py.Dataset, n_rows: int) -> Iterator[str]:
    from .hdf5 import dataset_names

    names = dataset_names(history)
    for first in range(0, n_rows, 4096):
        rows = slice(first, min(first + 4096, n_rows))
        wrong = row_digests({name: history[name][rows] for name in names}, first) != digests[rows]
        if wrong.any():
            at = first + np.nonzero(wrong)[0]
            yield f"{history.name[1:]}: {len(at)} rows do not match their checksums, the first is row {at[0]}"


def _stored_sum(dataset: h5py.Dataset, first: int, count: int) -> int:
    """Return :func:`~.integrity.word_sum` of stored rows, read in pieces and numbered from 0."""
    per_row = max(1, int(np.prod(dataset.shape[1:], dtype=np.int64)))
    piece, total = max(1, BLOCK // per_row), 0
    if dataset.compression is not None:  # a chunk is read as a whole
        piece = max(1, piece // dataset.chunks[0]) * dataset.chunks[0]
    for start in range(0, count, piece):
        stop = min(start + piece, count)
        total += word_sum(dataset[first + start : first + stop], start)
    return total & (2**64 - 1)


def _seeded(name: str, total: int) -> int:
    """Return a sum that depends on the name of its array; zero stays zero, for ranks without rows."""
    return (total * (2 * _number(name.encode()) + 1)) & (2**64 - 1)


def _number(raw: bytes) -> int:
    return zlib.crc32(raw)


def _factors(index: np.ndarray) -> np.ndarray:
    factors = (index + np.uint64(1)) * np.uint64(_ODD)
    return (factors ^ (factors >> np.uint64(29))) | np.uint64(1)

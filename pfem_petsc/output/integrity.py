"""Integrity of files: checksums of checkpoints and of the content of result files."""

from __future__ import annotations

import hashlib
import json
import os
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import h5py
import numpy as np
from mpi4py import MPI

from ..errors import InputError
from ..mechanics.compiled import kernel

FORMAT, VERSION = "pfem_petsc checkpoint", 1
LARGEST_SEAL = 1 << 20
# Number of words summed, or of bytes read, at a time.
BLOCK = 1 << 18
# Number of words from which a compiled loop sums them.
COMPILED = 1 << 12


def checksum(comm: MPI.Comm, slab: np.ndarray, first: int) -> int:
    """Return the checksum of an array distributed in slabs, the same for any number of ranks. Collective.

    It is the sum, modulo 2^64, of all numbers as unsigned words, each times an odd factor computed from its index. It
    detects a change of any single number, and numbers that are swapped.

    Parameters
    ----------
    comm : MPI.Comm
    slab : (n, ...)
        Numbers of 1, 2, 4 or 8 bytes.
    first : int
        Global index of the first row of the slab.
    """
    total = np.array([word_sum(slab, first)], dtype=np.uint64)
    comm.Allreduce(MPI.IN_PLACE, total, op=MPI.SUM)
    return int(total[0])


def word_sum(slab: np.ndarray, first: int) -> int:
    """Return this process's part of :func:`checksum`; the parts add up, modulo 2^64, to the checksum of the whole."""
    words = np.ascontiguousarray(slab).reshape(-1).view(f"u{slab.dtype.itemsize}")
    start = first * int(np.prod(slab.shape[1:], dtype=np.int64))
    if len(words) >= COMPILED:
        # those that read results need no compiled loops, which take a third of a second to load

        return int(sum_of_words(words, start))
    total = np.zeros(1, dtype=np.uint64)
    for i in range(0, len(words), BLOCK):
        block = words[i : i + BLOCK].astype(np.uint64)
        index = np.arange(start + i, start + i + len(block), dtype=np.uint64)
        factor = (index + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
        factor ^= factor >> np.uint64(29)
        total += np.sum(block * (factor | np.uint64(1)), dtype=np.uint64)
    return int(total[0])


def seal_size(n_arrays: int) -> int:
    """Return the size of the user block for the seal of a file with ``n_arrays``: a power of two, as HDF5 requires."""
    return 1 << (511 + 64 * n_arrays).bit_length()


def seal(path: Path) -> None:
    """Write the seal into the user block of a complete, closed file. Not collective."""
    with h5py.File(path, "r", locking=False) as file:
        size = file.userblock_size
        found = [(dataset.id.get_offset(), dataset.id.get_storage_size()) for dataset in file["arrays"].values()]
    arrays = sorted([offset, length] for offset, length in found if length)
    content = {"size": path.stat().st_size, "seal_size": size, "arrays": arrays}
    with open(path, "rb") as raw:
        text = json.dumps({**content, "digest": _digest(raw, content)})
    line = f"{FORMAT} {VERSION}\n{text}\n".encode()
    if len(line) > size:
        raise ValueError(f"{path}: seal of {len(line)} bytes for {size}")
    with open(path, "r+b") as raw:
        raw.write(line.ljust(size))


def check_seal(path: Path, raw: BinaryIO | None = None) -> str:
    """Compare a file, except the values of its arrays, with its seal; return the digest. Not collective.

    Parameters
    ----------
    path : Path
    raw : the file opened for reading, in case ``path`` was replaced since; default: opened here

    Raises
    ------
    InputError
        If the file is not a checkpoint, of another version, truncated, or damaged.
    """
    try:
        if raw is None:
            with open(path, "rb") as raw:
                return _checked(path, raw)
        return _checked(path, raw)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}; {remedy(path)}") from error


def _checked(path: Path, raw: BinaryIO) -> str:
    raw.seek(0)
    head = raw.read(LARGEST_SEAL).split(b"\n", 2)
    first = head[0].decode(errors="replace")
    name, _, version = first.rpartition(" ")
    if name != FORMAT:
        raise InputError(f"{path}: not a checkpoint of pfem_petsc, or damaged at its beginning; {remedy(path)}")
    if version != str(VERSION):
        raise InputError(
            f"{path}: has version {version} of the checkpoint format, this program reads {VERSION}: restart with "
            f"the version of pfem_petsc that wrote it, or {remedy(path)}"
        )
    digest = None
    try:
        content: dict[str, Any] = json.loads(head[1])
        size, digest = int(content["size"]), content.pop("digest")
        actual = os.fstat(raw.fileno()).st_size
        if actual != size:
            raise InputError(f"{path}: damaged: has {actual} bytes of {size}; {remedy(path)}")
        sound = _digest(raw, content) == digest
    except (ValueError, KeyError, TypeError, IndexError, OverflowError, AttributeError):
        sound = False
    if not sound:
        raise InputError(f"{path}: damaged: the description of its content does not match the digest; {remedy(path)}")
    return str(digest)


def remedy(path: Path) -> str:
    """Return what a user can do without this checkpoint."""
    previous = path.with_name(f"{path.stem}-previous{path.suffix}")
    if previous.is_file():
        return f"restart from the one before: --restart {previous}"
    return "start without --restart"


def _digest(raw: BinaryIO, content: dict[str, Any]) -> str:
    """Return a digest of the seal's content and of all bytes after the user block except values of arrays."""
    digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode())
    position = int(content["seal_size"])
    for offset, length in [*content["arrays"], [int(content["size"]), 0]]:
        raw.seek(position)
        while position < offset:
            block = raw.read(min(BLOCK, offset - position))
            if not block:
                raise ValueError("the file ends early")
            digest.update(block)
            position += len(block)
        position = offset + length
    return digest.hexdigest()


_ODD = np.uint64(0x9E3779B97F4A7C15)
_SHIFT, _ONE = np.uint64(29), np.uint64(1)


@kernel
def sum_of_words(words: np.ndarray, start: int) -> np.uint64:
    """Return the sum, modulo 2^64, of unsigned words (n,) times the factors of their indices from ``start``."""
    total = np.uint64(0)
    for i in range(len(words)):
        factor = np.uint64(start + i + 1) * _ODD
        total += np.uint64(words[i]) * ((factor ^ (factor >> _SHIFT)) | _ONE)
    return total


@kernel
def gather_rows(words: np.ndarray, rows: np.ndarray, out: np.ndarray) -> None:
    """Copy rows (n,) of words (m, k) to ``out`` (n, k)."""
    if words.shape[1] == 1:
        for i in range(len(rows)):
            out[i, 0] = words[rows[i], 0]
    else:
        for i in range(len(rows)):
            for k in range(words.shape[1]):
                out[i, k] = words[rows[i], k]


CHECKS = "checks"
_MULTIPLIER = 0x9E3779B97F4A7C15


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
    total = numbers * np.uint64(_MULTIPLIER)
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
        return numbers * np.uint64(_MULTIPLIER) + (words * self._factors).sum(axis=1, dtype=np.uint64)


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
    factors = (index + np.uint64(1)) * np.uint64(_MULTIPLIER)
    return (factors ^ (factors >> np.uint64(29))) | np.uint64(1)

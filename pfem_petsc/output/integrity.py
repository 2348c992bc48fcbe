"""Checksums of what a file holds, the same for any number of ranks; what does not match them, and what is cut off.

HDF5 may crash on a damaged file, so a separate process reads it first and prints one line for each defect.
"""

from __future__ import annotations

import functools
import os
import shutil
import signal
import subprocess
import sys
import time
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np
from mpi4py import MPI

from ..columns import Layout
from ..errors import InputError
from ..mechanics.compiled import kernel
from ..signals import environment_alone
from .hdf5 import dataset_names, fsync_all, is_compressed
from .layout import (
    BARS,
    CHECKS,
    EVENT,
    MODE_VALUES,
    MODES,
    PER_STEP,
    Contents,
    Kept,
    check_version,
    complete_modes,
    complete_rows,
    complete_snapshots,
    constants,
    field_datasets,
    field_names,
    mesh_sizes,
    prepare_modes,
    read_attributes,
    row_type,
    write_case,
)
from .result import readable

BLOCK = 1 << 18
"""Number of words summed at a time."""
COMPILED = 1 << 12
"""Number of words from which a compiled loop sums them."""
_ODD = np.uint64(0x9E3779B97F4A7C15)
_SHIFT, _ONE = np.uint64(29), np.uint64(1)
_WORD = 2**64 - 1


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
    return int(summed(comm, [word_sum(slab, first)])[0])


def summed(comm: MPI.Comm, parts: Sequence[int]) -> np.ndarray:
    """Return the sums over ranks, modulo 2^64, of parts as :func:`word_sum` gives them (n,) uint64. Collective."""
    total = np.array([part & _WORD for part in parts], dtype=np.uint64)
    if comm.size > 1:
        comm.Allreduce(MPI.IN_PLACE, total, op=MPI.SUM)
    return total


def word_sum(slab: np.ndarray, first: int) -> int:
    """Return this process's part of :func:`checksum`; the parts add up, modulo 2^64, to the checksum of the whole."""
    words = np.ascontiguousarray(slab).reshape(-1).view(f"u{slab.dtype.itemsize}")
    start = first * int(np.prod(slab.shape[1:], dtype=np.int64))
    if len(words) >= COMPILED:
        # those that read results need no compiled loops, which take a third of a second to load
        return int(sum_of_words(words, start))
    return int(np.sum(words.astype(np.uint64) * _factors(start, len(words)), dtype=np.uint64))


def _factors(start: int, count: int) -> np.ndarray:
    """Return the factors of words by their indices from ``start``."""
    factors = (np.arange(start, start + count, dtype=np.uint64) + _ONE) * _ODD
    return (factors ^ (factors >> _SHIFT)) | _ONE


@kernel
def sum_of_words(words: np.ndarray, start: int) -> np.uint64:
    """Return the sum, modulo 2^64, of unsigned words (n,) times the factors of their indices from ``start``."""
    total, factor = np.uint64(0), np.uint64(start) * _ODD
    for i in range(len(words)):
        factor += _ODD  # an addition: multiplications of vectors of 64-bit words are what limits the loop
        total += np.uint64(words[i]) * ((factor ^ (factor >> _SHIFT)) | _ONE)
    return total


def seeded(name: str, total: int) -> int:
    """Return a sum that depends on the name of its array; zero stays zero, for ranks without rows."""
    return (total * (2 * zlib.crc32(name.encode()) + 1)) & _WORD


def mark_digest(n: int, step: int, time: float) -> int:
    """Return the checksum of the step and time [s] of snapshot n."""
    return zlib.crc32(np.array([n, step], dtype=np.int64).tobytes() + np.float64(time).tobytes())


def numbers_digest(index: int, *numbers: float) -> int:
    """Return the checksum of an index and numbers."""
    return zlib.crc32(np.int64(index).tobytes() + np.array(numbers, dtype=np.float64).tobytes())


class RowDigests:
    """Checksums of the rows of a table.

    Parameters
    ----------
    layout : of a row, with the types of the file
    """

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self._multipliers = np.zeros(layout.width, dtype=np.uint64)
        for name, (first, end, _, _) in layout.places.items():
            self._multipliers[first:end] = _factors(zlib.crc32(name.encode()), end - first)
        # columns whose numbers in the file have other words than those in the vector
        kinds = {name: dtype.base for name, dtype in layout.columns.items()}
        self._others = [(layout[name], kind) for name, kind in kinds.items() if kind != np.float64]

    def of_vectors(self, rows: np.ndarray, first: int) -> np.ndarray:
        """Return checksums (n,) of rows (n, width) of float64, of which the first is row ``first`` of the table."""
        words = np.ascontiguousarray(rows).view(np.uint64)
        if self._others:
            words = words.copy()
        for place, kind in self._others:
            words[:, place] = rows[:, place].astype(kind).view(f"u{kind.itemsize}")
        numbers = np.arange(first + 1, first + len(words) + 1, dtype=np.uint64)
        return numbers * _ODD + (words * self._multipliers).sum(axis=1, dtype=np.uint64)

    def of_columns(self, columns: Mapping[str, np.ndarray], first: int) -> np.ndarray:
        """Return the same from the columns, name to values (n, ...)."""
        parts = [np.asarray(columns[name], dtype=np.float64) for name in self._layout.places]
        return self.of_vectors(np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1), first)


def stored_sum(dataset: h5py.Dataset, first: int, count: int) -> int:
    """Return :func:`word_sum` of stored rows, read in pieces and numbered from 0."""
    per_row = max(1, int(np.prod(dataset.shape[1:], dtype=np.int64)))
    piece, total = max(1, BLOCK // per_row), 0
    if dataset.compression is not None:  # a chunk is read as a whole
        piece = max(1, piece // dataset.chunks[0]) * dataset.chunks[0]
    for start in range(0, count, piece):
        stop = min(start + piece, count)
        total += word_sum(dataset[first + start : first + stop], start)
    return total & _WORD


QUICK = 1 << 28
"""Files up to this size [B] are read completely by default."""
SHOWN = 5
_START = """import sys, mpi4py
mpi4py.rc.initialize = False
from pfem_petsc.output.integrity import main
sys.exit(main())"""


def examine(path: Path, deep: bool | None = None) -> list[str]:
    """Return one line for each defect of the values in a result file. Not collective.

    Parameters
    ----------
    path : Path
        An existing file.
    deep : bool, optional
        Whether to read the values of all snapshots; by default only structure, mesh and history of files over 256 MiB.

    Raises
    ------
    InputError
        If the file cannot be opened or read, or crashes the process that reads it.
    """
    found = path.stat()
    # cached, because a restart calls this several times
    lines, trouble = _examined(path, found.st_size, found.st_mtime_ns, bool(deep) or found.st_size <= QUICK)
    if trouble:
        raise InputError(trouble)
    return list(lines)


@functools.lru_cache(maxsize=4)
def _examined(path: Path, size: int, changed: int, deep: bool) -> tuple[tuple[str, ...], str]:
    """Return lines about values, or why a file of this size and modification time [ns] cannot be read."""
    for left in reversed(range(4)):
        done = _read_apart(path, deep)
        # A running simulation may be between two of its writes.
        if (done.returncode == 0 and not done.stdout) or not left or time.time() - changed * 1e-9 > 60.0:
            break
        time.sleep(0.3)
    if done.returncode < 0:
        name = signal.Signals(-done.returncode).name
        return (), f"{path}: damaged: HDF5 crashes when it reads the file ({name}); restore it from a copy"
    if done.returncode == InputError.exit_status:
        return (), done.stderr.strip()
    if done.returncode:
        said = done.stderr.strip().splitlines()[-1:] or ["no message"]
        return (), f"{path}: damaged: it cannot be read ({said[0]}); restore it from a copy"
    return tuple(done.stdout.splitlines()), ""


def _read_apart(path: Path, deep: bool) -> subprocess.CompletedProcess:
    # without the variables of the ranks, with which h5py would start MPI
    variables, root = environment_alone(), str(Path(__file__).parents[2])
    variables["PYTHONPATH"] = os.pathsep.join([root, *filter(None, [variables.get("PYTHONPATH")])])
    command = [sys.executable, "-c", _START, str(path), "deep" if deep else "quick"]
    return subprocess.run(
        command, env=variables, capture_output=True, encoding="utf-8", errors="replace", stdin=subprocess.DEVNULL
    )


def damages(file: h5py.File, deep: bool = True) -> Iterator[str]:
    """Yield one line for each defect of a result file.

    ``deep``: whether to read the values of all snapshots; else only those of mesh, steps, times and history.
    """
    vtk, steps, checks = file["VTKHDF"], file["VTKHDF/Steps"], file[CHECKS]
    n_nodes, n_bars = mesh_sizes(file)
    yield from _mesh_damages(vtk, int(checks["mesh"][0]), n_bars)
    found = sum(seeded(name, stored_sum(file[BARS][name], 0, n_bars)) for name in constants(file)) & _WORD
    if BARS in checks and found != int(checks[BARS][0]):
        yield "what bars have in all snapshots does not match its checksum"
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


COPIED = 1 << 28
"""Files up to this size [B] are copied for a restart and then replaced."""


def repair(path: Path | str, kept: Kept | None = None) -> tuple[int, int]:
    """Cut off what a killed run left incomplete, and everything after the steps that are ``kept``. One process.

    Returns
    -------
    (int, int)
        Number of snapshots and of history rows that the file has now.

    Raises
    ------
    InputError
        If there is no such file, or it is not a readable result.
    """
    path = Path(path)
    with readable(path), h5py.File(path, "r+", locking=False) as file:
        counts = _counts(file, kept)
        n_snapshots, vtk, steps = counts[0], file["VTKHDF"], file["VTKHDF/Steps"]
        # A kill in between must leave a file that VTK can read: VTK crashes on more times than steps, so the times are
        # removed first; it shows nothing for steps without data, so the data are removed last.
        steps["Values"].resize(n_snapshots, axis=0)
        steps["Values"][:] = file["snapshots/time"][:n_snapshots]
        file.flush()
        steps.attrs.modify("NSteps", np.int64(n_snapshots))
        tables = {name: n for name, n in zip(("history", EVENT), counts[1:], strict=True) if name in file}
        for table, n in tables.items():
            file[table].attrs.modify("rows", np.int64(n))
        file.flush()
        if n_snapshots == 0:
            # The first snapshot creates the fields, possibly not all of them.
            file[CHECKS].pop("snapshots", None)
            for kind in ("PointData", "CellData"):
                for name in field_names(vtk, kind):
                    del vtk[kind][name], steps[f"{kind}Offsets"][name]
        n_nodes, n_bars = mesh_sizes(file)
        grown = [steps[name] for name in PER_STEP] + [file["snapshots/step"], file["snapshots/time"]]
        rows = {data.name: n_snapshots for data in grown + ([file[CHECKS]["snapshots"]] if n_snapshots else [])}
        for name, data in field_datasets(vtk).items():
            rows[data.name] = n_snapshots * (n_bars if name.startswith("CellData") else n_nodes)
        for table, n in tables.items():
            rows |= {f"{table}/{name}": n for name in dataset_names(file[table])} | {f"{CHECKS}/{table}": n}
        for name, n in rows.items():
            file[name].resize(n, axis=0)
    fsync_all(path)
    return counts[:2]


def reopen(path: Path, sizes: tuple[int, int], contents: Contents, kept: Kept) -> bool:
    """Prepare a result file to be continued after a step, with mesh and fields unchanged; return whether it is
    compressed. Not collective.

    Parameters
    ----------
    path : Path
    sizes : (int, int)
        Nodes and bars of the case.
    contents : Contents
        Case and attributes replace the content of ``/case``; the step is added to its ``restarts_after_step``. Modes
        are removed, and come anew.
    kept : Kept

    Raises
    ------
    InputError
        If the file is missing or damaged, or has another mesh, other fields or other columns.
    """
    if path.is_file() and (wrong := examine(path, deep=True)):
        more = f", and {len(wrong) - 1} more like it" if len(wrong) > 1 else ""
        raise InputError(
            f"{path}: damaged: {wrong[0]}{more} (info --verify lists all): it is not continued; restore it from a "
            "copy, or restart into another folder (-o), where new results begin at the checkpoint"
        )
    with readable(path), h5py.File(path, "r", locking=False) as file:
        compressed = is_compressed(file["VTKHDF/Points"])
        _check_same(file, path, _counts(file, kept)[0], sizes, contents)
        earlier = list(read_attributes(file["case"]).get("restarts_after_step", []))
    with _replaced(path) as target:
        repair(target, kept)
        with h5py.File(target, "r+", locking=False) as file:
            write_case(file, contents.case_text, {**contents.attributes, "restarts_after_step": [*earlier, kept.step]})
            prepare_modes(file, contents.modes, sizes[0])
    return compressed


def _check_same(file: h5py.File, path: Path, n_snapshots: int, sizes: tuple[int, int], contents: Contents) -> None:
    vtk = file["VTKHDF"]
    has = mesh_sizes(file)
    if has != sizes:
        raise InputError(
            f"{path}: has {has[0]} nodes and {has[1]} bars, the case has {sizes[0]} and {sizes[1]}: it was "
            "written with another mesh; restart the case it belongs to, or write elsewhere (-o)"
        )
    for kind, names in contents.fields.items():
        if n_snapshots and field_names(vtk, kind) != names:
            raise InputError(
                f"{path}: has the fields {', '.join(field_names(vtk, kind)) or 'none'} ({kind}), the case requests "
                f"{', '.join(names) or 'none'}: keep [output] fields unchanged, or write elsewhere (-o)"
            )
    found = {name: file["history"][name].shape[1:] for name in dataset_names(file["history"])}
    wanted = {name: dtype.shape for name, dtype in contents.columns.items()}
    for name in sorted(found.keys() | wanted.keys()):
        if found.get(name) != wanted.get(name):
            has, records = (f"rows of shape {some[name]}" if name in some else "nothing" for some in (found, wanted))
            raise InputError(
                f"{path}: history/{name}: the run records {records}, the file has {has}: it was written with another "
                "case; restart with the same walls and probes, or write elsewhere (-o)"
            )
    known = read_attributes(file["case"])
    for name, numbers in contents.attributes.items():
        if name.startswith(("probe_nodes/", "probe_bars/")) and list(known.get(name, numbers)) != list(numbers):
            what, _, probe = name.removeprefix("probe_").partition("/")
            old, new = (
                ", ".join([*map(str, each[:6]), *(["..."] if len(each) > 6 else [])]) for each in (known[name], numbers)
            )
            raise InputError(
                f"{path}: probe {probe!r}: the {what} {old} of the file are now {new}: restart with the same ones, or "
                "write elsewhere (-o)"
            )


def _counts(file: h5py.File, kept: Kept | None) -> tuple[int, int, int]:
    """Return the numbers of complete snapshots, history rows and events, up to the steps that are kept."""
    found = complete_snapshots(file), complete_rows(file), complete_rows(file, EVENT)
    if kept is None:
        return found
    steps = ("snapshots/step", kept.snapshot), ("history/step", kept.row), (f"{EVENT}/step", kept.step)
    return tuple(
        int(np.searchsorted(file[name][:n], last, side="right")) if n else 0
        for n, (name, last) in zip(found, steps, strict=True)
    )


@contextmanager
def _replaced(path: Path) -> Iterator[Path]:
    """Context that yields the file to write for a restart, which replaces ``path`` at the end; messages name ``path``.

    A kill between the few writes that replace the case would leave a file that HDF5 cannot open. A copy avoids this and
    costs little unless it is large; large files are modified in place.
    """
    size = path.stat().st_size if path.is_file() else 0
    copied = 0 < size <= COPIED and shutil.disk_usage(path.parent).free > 2 * size
    target = path.with_name(path.name + ".new") if copied else path
    try:
        if copied:
            shutil.copyfile(path, target)
        yield target
        if copied:
            fsync_all(target)
            os.replace(target, path)
    except InputError as error:
        raise InputError(str(error).replace(str(target), str(path))) from error
    except OSError as error:
        raise InputError(f"{path}: cannot be prepared for a restart: {error.strerror}; write elsewhere (-o)") from error
    finally:
        if copied:
            target.unlink(missing_ok=True)

"""Verification of a result file: what does not match its checksums, found by a separate process.

HDF5 may crash on a damaged file, so a separate process reads it first and prints one line for each defect.
"""

from __future__ import annotations

import functools
import os
import signal
import subprocess
import sys
import time
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
    mesh_sizes,
    row_type,
)
from .result import readable

QUICK = 1 << 28
"""Files up to this size [B] are read completely by default."""
SHOWN = 5
_START = """import sys, mpi4py
mpi4py.rc.initialize = False
from pfem_petsc.output.verify import main
sys.exit(main())"""
_LAUNCHERS = ("OMPI_", "PMIX_", "PMI_", "OPAL_", "ORTE_", "PRTE_", "MPI_LOCALRANKID", "SLURM_PROCID", "PALS_")


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
    # Without the environment variables of the ranks, with which h5py would start MPI.
    variables = {name: value for name, value in os.environ.items() if not name.startswith(_LAUNCHERS)}
    root = str(Path(__file__).parents[2])
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

"""Verification of a result file in a separate process.

HDF5 may crash on a damaged file, so a separate process reads it first and prints one line for each defect.
"""

from __future__ import annotations

import functools
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from ..errors import InputError

QUICK = 1 << 28
"""Files up to this size [B] are read completely by default."""
SHOWN = 5
_START = """import sys, mpi4py
mpi4py.rc.initialize = False
from pfem_petsc.output.damage import main
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

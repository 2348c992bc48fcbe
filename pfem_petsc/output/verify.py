"""Verification of a result file in a separate process.

HDF5 may crash on a damaged file, so a separate process reads it first: ``python -m pfem_petsc.output.verify FILE
deep|quick`` prints one line for each defect. :func:`examine` starts it.
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

__all__ = ["examine"]

QUICK = 1 << 28
"""Files up to this size [B] are read completely by default."""
SHOWN = 5
LAUNCHERS = ("OMPI_", "PMIX_", "PMI_", "OPAL_", "ORTE_", "PRTE_", "MPI_LOCALRANKID", "SLURM_PROCID", "PALS_")


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
    variables = {name: value for name, value in os.environ.items() if not name.startswith(LAUNCHERS)}
    root = str(Path(__file__).parents[2])
    variables["PYTHONPATH"] = os.pathsep.join([root, *filter(None, [variables.get("PYTHONPATH")])])
    command = [sys.executable, "-m", "pfem_petsc.output.verify", str(path), "deep" if deep else "quick"]
    return subprocess.run(
        command, env=variables, capture_output=True, encoding="utf-8", errors="replace", stdin=subprocess.DEVNULL
    )


def _main(path: Path, deep: bool) -> int:
    import mpi4py

    mpi4py.rc.initialize = False
    import h5py

    from .hdf5 import dataset_names
    from .integrity import CHECKS, damages
    from .layout import read_attributes
    from .result import readable

    try:
        with readable(path), h5py.File(path, "r", locking=False) as file:
            # all metadata, including those without a checksum of this program
            dataset_names(file)
            for name in ("VTKHDF", "VTKHDF/Steps", "history", "case"):
                dict(file[name].attrs)
            if CHECKS not in file:
                version = read_attributes(file["case"]).get("pfem_petsc", "an earlier one")
                raise InputError(
                    f"{path}: has no checksums: version {version} of pfem_petsc wrote it; "
                    "run the case again, or read it with that version, open_result or ParaView"
                )
            for line in damages(file, deep):
                print(line, flush=True)
    except InputError as error:
        print(error, file=sys.stderr)
        return error.exit_status
    return 0


if __name__ == "__main__":
    sys.exit(_main(Path(sys.argv[1]), sys.argv[2] == "deep"))

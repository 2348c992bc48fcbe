"""Bring a result file back to what is complete in it, and to an earlier step for a restart."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ..errors import InputError
from .hdf5 import dataset_names, fsync_all, grow, write_rows
from .history import check_columns
from .layout import PER_STEP, complete_rows, complete_snapshots, field_datasets
from .provenance import read_attributes, write_case

__all__ = ["reopen", "repair"]

COPIED = 1 << 28
"""Files up to this size [B] are repaired for a restart as a copy, which then takes the file's place."""


def repair(path: Path | str, last: tuple[int, int] | None = None) -> tuple[int, int]:
    """Cut off what a killed run left incomplete, and everything after the ``last`` steps. One process.

    Parameters
    ----------
    path : Path or str
    last : (int, int), optional
        Steps of the last snapshot and of the last history row that are kept.

    Returns
    -------
    (int, int)
        Snapshots and history rows that the file has now.

    Raises
    ------
    InputError
        When there is no such file, or it is not a readable result.
    """
    from .result import readable

    path = Path(path)
    with readable(path), h5py.File(path, "r+", locking=False) as file:
        n_snapshots, n_rows = complete_snapshots(file), complete_rows(file)
        vtk, steps, history = file["VTKHDF"], file["VTKHDF/Steps"], file["history"]
        if last is not None:
            n_snapshots = int(np.searchsorted(file["snapshots/step"][:n_snapshots], last[0], side="right"))
            n_rows = int(np.searchsorted(history["step"][:n_rows], last[1], side="right"))
        # A kill in between leaves a file that VTK reads: it crashes on more times than steps, so the times go first; it
        # finds nothing for steps without data, so the data go last.
        if len(steps["Values"]) > n_snapshots:
            grow(steps["Values"], n_snapshots)
        write_rows(steps["Values"], 0, file["snapshots/time"][: len(steps["Values"])])
        file.flush()
        steps.attrs.modify("NSteps", np.int64(n_snapshots))
        history.attrs.modify("rows", np.int64(n_rows))
        file.flush()
        for name in PER_STEP:
            grow(steps[name], n_snapshots)
        for name in ("step", "time"):
            grow(file["snapshots"][name], n_snapshots)
        if n_snapshots == 0:
            # The first snapshot makes the fields, perhaps not all of them were made.
            for kind in ("PointData", "CellData"):
                for name in list(vtk[kind]):
                    del vtk[kind][name]
                for name in list(steps[kind + "Offsets"]):
                    del steps[kind + "Offsets"][name]
        for name, dataset in field_datasets(vtk).items():
            n = int(vtk["NumberOfCells" if name.startswith("CellData") else "NumberOfPoints"][0])
            grow(dataset, n_snapshots * n)
        for name in dataset_names(history):
            grow(history[name], n_rows)
    fsync_all(path)
    return n_snapshots, n_rows


def reopen(
    path: Path,
    after_step: int,
    last: tuple[int, int],
    sizes: tuple[int, int],
    fields: Mapping[str, list[str]],
    columns: Mapping[str, tuple[int, ...]],
    case_text: str,
    attributes: Mapping[str, Any],
) -> None:
    """Prepare a result file to be continued after a step, with mesh and fields as before. One process.

    Parameters
    ----------
    path : Path
    after_step : int
        The step that the run goes on from.
    last : (int, int)
        Steps of the last snapshot and of the last history row that are kept.
    sizes : (int, int)
        Nodes and bars of the case.
    fields : mapping of "PointData" and "CellData" to sorted names
    columns : mapping of history column to the shape of one row's value
    case_text, attributes
        Replace what ``/case`` holds; the step is added to its ``restarts_after_step``.

    Raises
    ------
    InputError
        When the file is missing, damaged, or of another mesh, other fields or columns.
    """
    with _replaced(path) as target:
        n_snapshots, _ = repair(target, last)
        with h5py.File(target, "r+", locking=False) as file:
            vtk = file["VTKHDF"]
            has = (int(vtk["NumberOfPoints"][0]), int(vtk["NumberOfCells"][0]))
            if has != sizes:
                raise InputError(
                    f"{path}: has {has[0]} nodes and {has[1]} bars, the case has {sizes[0]} and {sizes[1]}: it was "
                    "written with another mesh; restart the case it belongs to, or write elsewhere (-o)"
                )
            for kind, names in fields.items():
                if n_snapshots and sorted(vtk[kind]) != names:
                    raise InputError(
                        f"{path}: has the fields {', '.join(sorted(vtk[kind])) or 'none'} ({kind}), the case asks for "
                        f"{', '.join(names) or 'none'}: keep [output] fields as it was, or write elsewhere (-o)"
                    )
            check_columns(file, path, columns)
            earlier = list(read_attributes(file["case"]).get("restarts_after_step", []))
            write_case(file, case_text, {**attributes, "restarts_after_step": [*earlier, after_step]})


@contextmanager
def _replaced(path: Path) -> Iterator[Path]:
    """The file to work on for a restart, which takes the place of ``path`` in the end; messages name that.

    A kill between the few writes that replace the case would leave a file that HDF5 cannot open; a copy costs little
    but where the file is large: that one is worked on itself.
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

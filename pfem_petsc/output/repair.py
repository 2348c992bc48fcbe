"""Truncates a result file to its complete data, and to an earlier step for a restart."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np

from ..errors import InputError
from .hdf5 import create_checked, dataset_names, fsync_all, is_compressed, write_rows
from .integrity import examine
from .layout import (
    BARS,
    CHECKS,
    EVENT,
    PER_STEP,
    Constant,
    Contents,
    Kept,
    complete_rows,
    complete_snapshots,
    constants,
    create_field,
    create_result,
    create_snapshot_checks,
    field_datasets,
    field_names,
    mesh_sizes,
    prepare_modes,
    read_attributes,
    row_type,
    write_case,
)
from .result import readable

COPIED = 1 << 28
"""Files up to this size [B] are rewritten for a restart and then replaced."""
PIECE = 1 << 24
"""Number of bytes that are read and written at once."""


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
        write_rows(steps["Values"], 0, file["snapshots/time"][:n_snapshots])
        file.flush()
        _count(file, counts)
        file.flush()
        if n_snapshots == 0:
            # The first snapshot creates the fields, possibly not all of them.
            file[CHECKS].pop("snapshots", None)
            for kind in ("PointData", "CellData"):
                for name in field_names(vtk, kind):
                    del vtk[kind][name], steps[f"{kind}Offsets"][name]
        for name, n in _extents(file, counts).items():
            file[name].resize(n, axis=0)
    fsync_all(path)
    return counts[:2]


def _count(file: h5py.File, counts: tuple[int, int, int]) -> None:
    """Set the numbers of snapshots, history rows and events that a file counts as complete."""
    file["VTKHDF/Steps"].attrs.modify("NSteps", np.int64(counts[0]))
    for table, n in (("history", counts[1]), (EVENT, counts[2])):
        if table in file:
            file[table].attrs.modify("rows", np.int64(n))


def _extents(file: h5py.File, counts: tuple[int, int, int]) -> dict[str, int]:
    """Return the numbers of rows of all growing datasets, but those of modes, for these numbers of snapshots, history
    rows and events."""
    n_snapshots, vtk = counts[0], file["VTKHDF"]
    n_nodes, n_bars = mesh_sizes(file)
    rows = {f"VTKHDF/Steps/{name}": n_snapshots for name in (*PER_STEP, "Values")}
    rows |= {f"snapshots/{name}": n_snapshots for name in ("step", "time")}
    sizes = {name: n_bars if name.startswith("CellData") else n_nodes for name in field_datasets(vtk)}
    rows |= {f"VTKHDF/{name}": n_snapshots * size for name, size in sizes.items()}
    for table, n in (("history", counts[1]), (EVENT, counts[2])):
        if table in file:
            rows |= {f"{table}/{name}": n for name in dataset_names(file[table])} | {f"{CHECKS}/{table}": n}
    return rows | ({f"{CHECKS}/snapshots": n_snapshots} if n_snapshots else {})


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
    _refuse_damaged(path)
    with _replaced(path) as target:
        with readable(path), h5py.File(path, "r", locking=False) as file:
            counts, compressed = _counts(file, kept), is_compressed(file["VTKHDF/Points"])
            _check_same(file, path, counts[0], sizes, contents)
            earlier = list(read_attributes(file["case"]).get("restarts_after_step", []))
            described = {**contents.attributes, "restarts_after_step": [*earlier, kept.step]}
            contents = contents._replace(attributes=described)
            if target != path:
                create_checked(target, _rebuild, file, counts, contents)
        if target == path:
            repair(target, kept)
            with h5py.File(target, "r+", locking=False) as file:
                write_case(file, contents.case_text, described)
                prepare_modes(file, contents.modes, sizes[0])
    return compressed


def _refuse_damaged(path: Path) -> None:
    if not path.is_file():
        return
    wrong = examine(path, deep=True)
    if wrong:
        more = f", and {len(wrong) - 1} more like it" if len(wrong) > 1 else ""
        raise InputError(
            f"{path}: damaged: {wrong[0]}{more} (info --verify lists all): it is not continued; restore it from a "
            "copy, or restart into another folder (-o), where new results begin at the checkpoint"
        )


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


def _rebuild(target: h5py.File, source: h5py.File, counts: tuple[int, int, int], contents: Contents) -> None:
    """Fill a new file with what is kept of another: nothing that a kill or damage has left in that one comes along.

    ``counts``: snapshots, history rows and events
    """
    vtk, history = source["VTKHDF"], source["history"]
    n_nodes, n_bars = mesh_sizes(source)
    columns = {name: row_type(history[name]) for name in dataset_names(history)}
    events = {name: dataset.dtype for name, dataset in source[EVENT].items()} if EVENT in source else {}
    compressed = is_compressed(vtk["Points"])
    kept = {name: source[BARS][name] for name in constants(source)}
    has = {}
    for name, data in kept.items():
        has[name] = Constant(data[:0], data.attrs["unit"].decode(), list(data.attrs.get("names", ())))
    of_file = {"columns": columns, "events": events, "compressed": compressed, "constants": has}
    create_result(target, n_nodes, n_bars, contents._replace(**of_file))
    if counts[0]:
        for name, dataset in field_datasets(vtk).items():
            kind, _, field = name.partition("/")
            if field:
                create_field(target["VTKHDF"], kind, field, dataset.shape[1:], dataset.dtype)
        create_snapshot_checks(target)
    rows = {"VTKHDF/Connectivity": 2 * n_bars, "VTKHDF/Offsets": n_bars + 1, f"{CHECKS}/mesh": 1}
    rows |= {f"{BARS}/{name}": n_bars for name in kept} | ({f"{CHECKS}/{BARS}": 1} if kept else {})
    rows |= _extents(target, counts)
    for name, n in rows.items():
        old, new = source[name], target[name]
        if new.maxshape[0] is None:
            new.resize(n, axis=0)
        piece = max(1, PIECE // max(1, old.dtype.itemsize * int(np.prod(old.shape[1:], dtype=np.int64))))
        if is_compressed(new):
            piece = max(1, piece // new.chunks[0]) * new.chunks[0]
        for first in range(0, n, piece):
            write_rows(new, first, old[first : min(first + piece, n)])
    _count(target, counts)


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

    A kill between the few writes that replace the case would leave a file that HDF5 cannot open. A new file avoids this
    and costs little unless it is large; large files are modified in place.
    """
    size = path.stat().st_size if path.is_file() else 0
    copied = 0 < size <= COPIED and shutil.disk_usage(path.parent).free > 2 * size
    target = path.with_name(path.name + ".new") if copied else path
    try:
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

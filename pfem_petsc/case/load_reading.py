"""Reads the tables of a case with rows over time, which may be in files: supports, loads, gravity, wind."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ..errors import InputError
from . import load_tables as t
from .base import StrictModel
from .load_files import digest_of
from .problems import Path as KeyPath
from .problems import Problems, table_list
from .table_files import TableFiles

__all__ = ["read_loads", "read_tabled", "read_varying"]

M = TypeVar("M", bound=StrictModel)


def read_tabled(
    model: type[M],
    data: Mapping[str, Any],
    table: str,
    files: TableFiles,
    problems: Problems,
    keys: tuple[str, ...],
    others: tuple[str, ...] = (),
) -> list[M]:
    """Read a list of tables whose ``keys`` may be given by files; the rows replace these."""
    found = []
    for i, row in enumerate(table_list(data.get(table), (table,), problems)):
        row = files.resolved(row, (table, i), problems, keys, others)
        if row is not None:
            found.append(problems.read(model, row, (table, i)))
    return [entry for entry in found if entry is not None]


def read_loads(
    data: Mapping[str, Any], folder: Path, files: TableFiles, problems: Problems
) -> list[t.Load | t.LoadFile]:
    """Read [[load]]; files with forces of many nodes get a digest, and are read with the model."""
    found: list[t.Load | t.LoadFile | None] = []
    for i, row in enumerate(table_list(data.get("load"), ("load",), problems)):
        path: KeyPath = ("load", i)
        if not isinstance(row, Mapping) or "file" not in row:
            row = files.resolved(row, path, problems, ("table",))
            if row is not None:
                found.append(problems.read(t.Load, row, path))
            continue
        taken = [key for key in ("node_set", "force", "table", "table_file") if key in row]
        if taken:
            problems.add(path, f"file gives the forces of nodes or node sets over time, without {', '.join(taken)}")
            continue
        read = problems.read(t.LoadFile, row, path)
        if read is None:
            continue
        file = Path(folder, read.file).resolve()
        try:
            digest = digest_of(file) if read.digest is None else read.digest
        except InputError as error:
            problems.add((*path, "file"), str(error), read.file)
            continue
        found.append(read.model_copy(update={"file": str(file), "digest": digest}))
    return [entry for entry in found if entry is not None]


def read_varying(
    data: Any, table: str, models: tuple[type[M], type[M]], files: TableFiles, problems: Problems
) -> M | None:
    """Read [gravity] or [wind], constant, or over time from rows or a file, whose rows are added to a vector.

    ``models`` are the constant one, whose first key is the vector, and the one with rows.
    """
    path: KeyPath = (table,)
    constant, varying = models
    key = next(iter(constant.model_fields))
    if not isinstance(data, Mapping):
        return problems.read(constant, data, path)
    given, known = data.get(key), list(varying.model_fields)
    varies = isinstance(given, list | tuple) and any(isinstance(row, list | tuple) for row in given)
    if f"{key}_file" not in data:
        return problems.read(varying if varies else constant, data, path, known=known)
    added = np.zeros(3)
    if given is not None and not varies:
        read = problems.read(constant, {key: given}, path)
        if read is None:
            return None
        added = np.array(getattr(read, key))
    rest = {name: value for name, value in data.items() if name != key or varies}
    row = files.resolved(rest, path, problems, (key,))
    if row is None:
        return None
    rows = np.array(row[key])
    rows[:, 1:] += added
    return problems.read(varying, {**row, key: rows.tolist()}, path)

"""The history of a run: one row per recorded step, collected on rank 0 and written in blocks."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from mpi4py import MPI

from ..errors import InputError
from .hdf5 import Growing, create_growing, dataset_names, set_unit, writing
from .integrity import CHECKS, RowDigests
from .units import unit_of


class RowLayout:
    """Positions of the columns in the vector of a row.

    Parameters
    ----------
    columns : name to shape of a value
    types : name to dtype if it is not float64; integers are stored as floating-point numbers, exact below 2^53

    Attributes
    ----------
    places : name to (first, end, shape, type of a number)
    width : length of the vector
    """

    def __init__(self, columns: Mapping[str, tuple[int, ...]], types: Mapping[str, Any]) -> None:
        self.places: dict[str, tuple[int, int, tuple[int, ...], type]] = {}
        at = 0
        for name, shape in columns.items():
            size = int(np.prod(shape, dtype=np.int64))
            kind = int if np.issubdtype(types.get(name, np.float64), np.integer) else float
            self.places[name] = (at, at + size, tuple(shape), kind)
            at += size
        self.width = at
        self._alike: RowLayout | None = None

    def vector(self, row: Mapping[str, Any]) -> np.ndarray:
        """Return the vector (width,) of a row."""
        if isinstance(row, Row) and self._is_alike(row.layout):
            return row.vector
        if set(row) != set(self.places):
            raise ValueError(f"a history row has the columns {sorted(self.places)}, got {sorted(row)}")
        return np.concatenate([np.ravel(row[name]).astype(np.float64) for name in self.places] or [np.empty(0)])

    def _is_alike(self, other: RowLayout) -> bool:
        if other is not self._alike and list(other.places.items()) == list(self.places.items()):
            self._alike = other
        return other is self._alike


class Row(Mapping):
    """A row of the history: column name to number or array (views of the vector).

    Attributes
    ----------
    layout : RowLayout
    vector : (width,) float64
    """

    __slots__ = ("layout", "vector")

    def __init__(self, layout: RowLayout, vector: np.ndarray) -> None:
        self.layout = layout
        self.vector = vector

    def __getitem__(self, name: str) -> Any:
        first, end, shape, kind = self.layout.places[name]
        return self.vector[first:end].reshape(shape) if shape else kind(self.vector[first])

    def __iter__(self) -> Iterator[str]:
        return iter(self.layout.places)

    def __len__(self) -> int:
        return len(self.layout.places)

    def __repr__(self) -> str:
        return repr(dict(self))


EVENT = "event"
"""The table of events: what happened between recorded steps, one row each."""

# Rows per chunk: few, so that a short run has a small file (the first row allocates a whole chunk).
ROWS_PER_CHUNK = 512
CHUNK_BYTES = 1 << 16
# Rows buffered in memory before they are written; fewer if rows are wide.
BUFFER_ROWS = 1024
BUFFER_BYTES = 1 << 24


def create_history(
    file: h5py.File, columns: Mapping[str, tuple[int, ...]], types: Mapping[str, Any], name: str = "history"
) -> None:
    """Create a table with an empty dataset per column and the attribute ``rows``, the number of complete rows.

    ``name``: ``history``, or ``event``, of what happened between steps.
    """
    group = file.create_group(name)
    group.attrs["rows"] = np.int64(0)
    for column, shape in columns.items():
        dtype = np.dtype(types.get(column, np.float64))
        per_chunk = CHUNK_BYTES // max(1, dtype.itemsize * int(np.prod(shape, dtype=np.int64)))
        made = create_growing(group, column, tuple(shape), dtype, max(1, min(ROWS_PER_CHUNK, per_chunk)))
        set_unit(made, unit_of(column))


def check_columns(file: h5py.File, path: Path, columns: Mapping[str, tuple[int, ...]]) -> None:
    """Refuse to continue a file whose history has other columns.

    Raises
    ------
    InputError
    """
    group = file["history"]
    for name, shape in columns.items():
        found = group.get(name)
        if not isinstance(found, h5py.Dataset) or found.shape[1:] != tuple(shape):
            has = f"rows of shape {found.shape[1:]}" if isinstance(found, h5py.Dataset) else "nothing"
            raise InputError(
                f"{path}: history/{name}: the run records rows of shape {tuple(shape)}, the file has {has}: it was "
                "written with another case; restart with the same walls and probes, or write elsewhere (-o)"
            )
    others = sorted(set(dataset_names(group)) - set(columns))
    if others:
        raise InputError(
            f"{path}: the history has {', '.join(others)}, which the run does not record: it was written with another "
            "case; restart with the same walls and probes, or write elsewhere (-o)"
        )


class HistoryWriter:
    """Appends rows to ``/history``, or to another table.

    Rank 0 has the values and writes them; the file grows on all ranks together. The attribute ``rows`` is updated after
    a flush of the data, so that neither a reader nor a kill ever leaves an incomplete row counted.

    Parameters
    ----------
    file : h5py.File
        Open for writing on all ranks, with the group made by :func:`create_history`.
    comm : MPI.Comm
    path : Path
        For messages.
    columns : collection of column names
    table : the group, ``history`` or ``event``
    """

    def __init__(
        self, file: h5py.File, comm: MPI.Comm, path: Path, columns: Collection[str], table: str = "history"
    ) -> None:
        self._comm, self._path = comm, path
        group = file[table]
        datasets = {name: group[name] for name in columns}
        self._columns = {name: Growing(dataset) for name, dataset in datasets.items()}
        self._digests = Growing(file[CHECKS][table])
        self._rows_attribute = h5py.h5a.open(group.id, b"rows")
        self.n_rows = int(group.attrs["rows"])
        row_bytes = sum(d.dtype.itemsize * int(np.prod(d.shape[1:], dtype=np.int64)) for d in datasets.values())
        self._capacity = max(1, min(BUFFER_ROWS, BUFFER_BYTES // max(1, row_bytes)))
        # Disk space of a write: the rows, and a new chunk in each column.
        self.reserve_bytes = self._capacity * row_bytes + len(datasets) * CHUNK_BYTES
        self.n_buffered = 0
        self._layout = RowLayout(
            {name: dataset.shape[1:] for name, dataset in datasets.items()},
            {name: dataset.dtype for name, dataset in datasets.items()},
        )
        places = self._layout.places
        self._checksums = RowDigests({name: (*places[name][:2], datasets[name].dtype) for name in places})
        self._buffer = np.empty((self._capacity if comm.rank == 0 else 0, self._layout.width))

    @property
    def full(self) -> bool:
        """Whether the buffer must be written before the next row; equal on all ranks."""
        return self.n_buffered == self._capacity

    def append(self, row: Mapping[str, Any] | None) -> None:
        """Buffer one row: rank 0 passes a value for each column, the others None. No communication."""
        if self._comm.rank == 0:
            self._buffer[self.n_buffered] = self._layout.vector(row if row is not None else {})
        self.n_buffered += 1

    def write(self) -> None:
        """Write the buffered rows without counting them; flush the file, then call :meth:`commit`. Collective."""
        if self.n_buffered == 0:
            return
        first, self.n_rows = self.n_rows, self.n_rows + self.n_buffered
        with writing(self._comm, self._path):
            for dataset in (*self._columns.values(), self._digests):
                dataset.grow(self.n_rows)
        with writing(self._comm, self._path):
            if self._comm.rank == 0:
                rows = self._buffer[: self.n_buffered]
                for name, (at, end, shape, _) in self._layout.places.items():
                    self._columns[name].write(first, rows[:, at:end].reshape(len(rows), *shape))
                self._digests.write(first, self._checksums(rows, first))
        self.n_buffered = 0

    def commit(self) -> None:
        """Count the written rows as complete; flush the file afterwards. Collective."""
        with writing(self._comm, self._path):
            self._rows_attribute.write(np.array(self.n_rows, dtype=np.int64))


class RowTables:
    """The tables of a result file that grow by rows: the history, and the events of analyses that have some.

    Attributes
    ----------
    history, event : HistoryWriter; ``event`` is None without events
    reserve_bytes : what a write of all may take on disk

    Raises
    ------
    InputError
        Where the run has events, and the file was made without.
    """

    def __init__(
        self,
        file: h5py.File,
        comm: MPI.Comm,
        path: Path,
        columns: Collection[str],
        events: Collection[str] | None,
    ) -> None:
        if events and EVENT not in file:
            raise InputError(f"{path}: has no events, which the run records: write elsewhere (-o)")
        self.history = HistoryWriter(file, comm, path, columns)
        self.event = HistoryWriter(file, comm, path, events, EVENT) if events else None
        self._all = [self.history] if self.event is None else [self.history, self.event]
        self.reserve_bytes = sum(table.reserve_bytes for table in self._all)

    @property
    def buffered(self) -> bool:
        """Whether any has rows to write."""
        return any(table.n_buffered for table in self._all)

    def write(self) -> None:
        """Write the buffered rows of all. Collective."""
        for table in self._all:
            table.write()

    def commit(self) -> None:
        """Count them as complete. Collective."""
        for table in self._all:
            table.commit()

"""Results in one VTKHDF file, written by all ranks together and readable by ParaView, even during the run."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
from mpi4py import MPI

from ..columns import Layout
from ..errors import InputError, PfemError, SimulationFailure
from ..parallel.agreement import on_root
from ..parallel.heap import SharedArrays
from .hdf5 import Growing, SharedFile, create_new, require_parallel_hdf5, require_room, writing
from .integrity import RowDigests, mark_digest, numbers_digest, reopen, seeded, summed, word_sum
from .layout import (
    BARS,
    CHECKS,
    CHUNK_BYTES,
    EVENT,
    MODE_VALUES,
    MODES,
    PER_STEP,
    Constant,
    Contents,
    Kept,
    create_field,
    create_result,
    create_snapshot_checks,
    describe_run,
    field_datasets,
    row_type,
)

if TYPE_CHECKING:
    from ..mesh.distribution import DistributedMesh
    from ..parallel.natural import NaturalOrder


# rows buffered in memory before they are written; fewer if rows are wide
_BUFFER_ROWS, _BUFFER_BYTES = 1024, 1 << 24
# bytes of a snapshot from which it is written beside the steps: less takes as long as handing it to a thread
_BESIDE = 1 << 18


def _write_constants(shared: SharedFile, mesh: DistributedMesh, constants: Mapping[str, Constant]) -> None:
    """Write what bars have in all snapshots, and its digest. Collective."""
    order, file, total = mesh.bar_order, shared.file, 0
    for name, constant in sorted(constants.items()):
        slab = np.ascontiguousarray(order.to_slab(constant.values[mesh.counted]))
        total += seeded(name, word_sum(slab, order.first))
        shared.write(Growing(file[BARS][name]) if file else None, order.first, slab)
    _write_digest(shared, BARS, total)


def _write_connectivity(shared: SharedFile, mesh: DistributedMesh) -> None:
    """Write the ends of all bars in mesh numbering, their offsets, and the digest of the mesh. Collective.

    Bars that are evaluated on two ranks are written by the rank that counts them.
    """
    comm, order = shared.comm, mesh.bar_order
    ends = order.to_slab(mesh.node_ids[mesh.bars[mesh.counted]].astype(np.int64).reshape(-1, 2)).ravel()
    # there is one more offset than bars, which the last rank writes
    offsets = 2 * np.arange(order.first, order.first + order.count + (comm.rank == comm.size - 1))
    for name, first, rows in (("Connectivity", 2 * order.first, ends), ("Offsets", order.first, offsets)):
        shared.write(Growing(shared.file["VTKHDF"][name]) if shared.file else None, first, rows)
    _write_digest(shared, "mesh", word_sum(ends, 2 * order.first))


def _write_digest(shared: SharedFile, name: str, total: int) -> None:
    """Write the checksum of what is written once, from the parts of the ranks. Collective."""
    digest = summed(shared.comm, [total])

    def finish() -> None:
        with shared.writing():
            if shared.comm.rank == 0:
                Growing(shared.file[CHECKS][name]).write(0, digest)
            shared.file.flush()

    shared.call(finish)


class _Table:
    """Appends rows to ``/history``, or to ``/event``.

    Rank 0 has the values and writes them; the file grows on its owners. The attribute ``rows`` is updated after a flush
    of the data, so that neither a reader nor a kill ever leaves an incomplete row counted.

    Parameters
    ----------
    shared : SharedFile
    name : of the group
    columns : names, in the order of a row's vector, to their types
    """

    def __init__(self, shared: SharedFile, name: str, columns: Mapping[str, np.dtype]) -> None:
        self._shared, self._root, self._file = shared, shared.comm.rank == 0, shared.file
        types = dict(columns)
        if self._file is not None:
            group = self._file[name]
            types = {column: row_type(group[column]) for column in columns}
            self._columns = {column: Growing(group[column]) for column in columns}
            self._digests = Growing(self._file[CHECKS][name])
            self._rows_attribute = h5py.h5a.open(group.id, b"rows")
            self.n_rows = int(group.attrs["rows"])
        self._layout = Layout(types)
        row_bytes = shared.call(lambda: sum(dtype.itemsize for dtype in types.values()))
        self._capacity = max(1, min(_BUFFER_ROWS, _BUFFER_BYTES // max(1, row_bytes)))
        # Disk space of a write: the rows, and a new chunk in each column.
        self.reserve_bytes = self._capacity * row_bytes + len(columns) * CHUNK_BYTES
        self.n_buffered = 0
        self._checksums = RowDigests(self._layout)
        self._buffer = np.empty((self._capacity if self._root else 0, self._layout.width))

    @property
    def full(self) -> bool:
        """Whether the buffer must be written before the next row; equal on all ranks."""
        return self.n_buffered == self._capacity

    def append(self, row: Mapping[str, Any] | None) -> None:
        """Buffer one row: rank 0 passes a value for each column, the others None. No communication."""
        if self._root:
            self._buffer[self.n_buffered] = self._layout.vector(row if row is not None else {})
        self.n_buffered += 1

    def take(self) -> tuple[int, np.ndarray]:
        """Return the number of buffered rows, and on rank 0 the rows (n, width); empty the buffer."""
        n, self.n_buffered = self.n_buffered, 0
        return n, self._buffer[:n].copy()

    def write(self, n: int, rows: np.ndarray) -> None:
        """Write rows from :meth:`take` without counting them; a flush and :meth:`commit` come next. For owners."""
        if n == 0:
            return
        first, self.n_rows = self.n_rows, self.n_rows + n
        with self._shared.writing():
            for dataset in (*self._columns.values(), self._digests):
                dataset.grow(self.n_rows)
        with self._shared.writing():
            if self._root:
                for name, (at, end, shape, _) in self._layout.places.items():
                    self._columns[name].write(first, rows[:, at:end].reshape(n, *shape))
                self._digests.write(first, self._checksums.of_vectors(rows, first))

    def commit(self) -> None:
        """Count the written rows as complete; flush the file afterwards. For owners."""
        with self._shared.writing():
            self._rows_attribute.write(np.array(self.n_rows, dtype=np.int64))


class _Snapshots:
    """Snapshots of an open result file: points and fields, their rows of ``/VTKHDF/Steps`` and ``/snapshots``, digests.

    The first snapshot creates the datasets of the fields and defines their shapes.

    Parameters
    ----------
    shared : SharedFile
    mesh : DistributedMesh
    contents : Contents

    Attributes
    ----------
    count : number of snapshots
    """

    def __init__(self, shared: SharedFile, mesh: DistributedMesh, contents: Contents) -> None:
        self._shared, self._file, self._comm = shared, shared.file, shared.comm
        self._fields, self._precision = contents.fields, np.dtype(contents.precision)
        self._nodes, self._bars = mesh.node_order, mesh.bar_order
        self._sizes = int(mesh.n_nodes), int(mesh.n_bars)
        # bars evaluated on two ranks are written by the rank that counts them
        self._counted = _as_slice(mesh.counted)
        self._ids = mesh.node_ids[: mesh.n_owned], mesh.bar_ids[self._counted]
        self._memory: SharedArrays | None = None
        self._data: dict[str, Growing] = {}
        self.count = shared.call(self._open)

    def _open(self) -> int:
        """Find the datasets in the file; return the number of snapshots. For owners."""
        steps = self._file["VTKHDF/Steps"]
        self._per_step = {name: Growing(steps[name]) for name in PER_STEP}
        # one column, because there is one type of cell
        self._wide = {name: (1, *steps[name].shape[1:]) for name in PER_STEP}
        self._times = Growing(steps["Values"])
        self._marks = {name: Growing(self._file["snapshots"][name]) for name in ("step", "time")}
        self._n_steps = h5py.h5a.open(steps.id, b"NSteps")
        count = int(steps.attrs["NSteps"])
        if count:
            self._open_data(self._file[CHECKS]["snapshots"])
        return count

    def _open_data(self, digests: h5py.Dataset) -> None:
        self._data = {name: Growing(dataset) for name, dataset in field_datasets(self._file["VTKHDF"]).items()}
        self._digests = Growing(digests)

    def arrays(
        self, points: np.ndarray, point_data: Mapping[str, np.ndarray], cell_data: Mapping[str, np.ndarray]
    ) -> dict[str, np.ndarray]:
        """Return this rank's owned rows of each dataset, by name."""
        arrays = {"Points": points}
        arrays |= {f"PointData/{name}": np.asarray(point_data[name]) for name in self._fields["PointData"]}
        arrays |= {f"CellData/{name}": np.asarray(cell_data[name])[self._counted] for name in self._fields["CellData"]}
        return arrays

    def n_bytes(self, arrays: Mapping[str, np.ndarray]) -> int:
        """Return the size of a snapshot, over all ranks."""
        return sum(
            self._order(name).n_global
            * self._row_type(name, array).itemsize
            * int(np.prod(array.shape[1:], dtype=np.int64))
            for name, array in arrays.items()
        )

    def gather(self, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return the rows of all ranks in mesh numbering, in memory that ranks share. Collective."""
        if self._memory is None:
            kinds = {
                name: (self._row_type(name, a), (self._order(name).n_global, *a.shape[1:]))
                for name, a in arrays.items()
            }
            with writing(self._comm, self._shared.name):
                self._memory = SharedArrays(self._comm, {name: np.dtype(kind) for name, kind in kinds.items()})
        for name, array in arrays.items():
            self._memory.arrays[name][self._ids[name.startswith("CellData")]] = array
        self._comm.Barrier()
        return dict(self._memory.arrays)

    def write(self, n: int, arrays: dict[str, np.ndarray]) -> np.ndarray:
        """Write the values of snapshot n, which ``arrays`` then no longer hold; return their digests. For owners.

        One field after the other goes to mesh numbering, into its digest and into the file, while it is in the cache.
        """
        if not self._data:
            with self._shared.writing():
                for name, array in arrays.items():
                    if name != "Points":
                        kind, _, field = name.partition("/")
                        row_type = self._row_type(name, array)
                        create_field(self._file["VTKHDF"], kind, field, array.shape[1:], row_type)
                self._open_data(create_snapshot_checks(self._file))
        with self._shared.writing():
            for name in arrays:
                self._data[name].grow((n + 1) * self._order(name).n_global)
        sums = {}
        for name in list(arrays):
            order, slab = self._order(name), arrays.pop(name)
            if self._memory is None:
                slab = order.to_slab(slab)
                slab = slab.astype(self._row_type(name, slab), copy=False)
            sums[name] = word_sum(slab, order.first)
            with self._shared.writing():
                self._data[name].write(n * order.n_global + order.first, slab, collective=self._shared.together)
        return summed(self._shared.owners, [seeded(name, part) for name, part in sorted(sums.items())])

    def mark(self, n: int, step: int, time: float, digests: np.ndarray) -> None:
        """Write the entries of snapshot n, except its time in ``/VTKHDF``, without counting it. For owners."""
        with self._shared.writing():
            for dataset in (*self._per_step.values(), *self._marks.values(), self._digests):
                dataset.grow(n + 1)
        rows = {"PointOffsets": n * self._sizes[0], "CellDataRows": n * self._sizes[1], "NumberOfParts": 1}
        with self._shared.writing():
            if self._comm.rank == 0:
                for name, dataset in self._per_step.items():
                    dataset.write(n, np.full(self._wide[name], rows.get(name, 0)))
                self._marks["step"].write(n, np.array([step]))
                self._marks["time"].write(n, np.array([time]))
                mark = np.array([mark_digest(n, step, time)], dtype=np.uint64)
                self._digests.write(n, np.concatenate([mark, digests])[None])

    def publish(self, n: int, time: float) -> None:
        """Count snapshot n, whose data have been flushed, and then write its time [s]. For owners."""
        with self._shared.writing():
            self._n_steps.write(np.array(n + 1, dtype=np.int64))
            self._file.flush()
        with self._shared.writing():
            self._times.grow(n + 1)
            if self._comm.rank == 0:
                self._times.write(n, np.array([time], dtype=np.float64))
            self._file.flush()

    def _order(self, name: str) -> NaturalOrder:
        return self._bars if name.startswith("CellData") else self._nodes

    def _row_type(self, name: str, slab: np.ndarray) -> np.dtype:
        return self._precision if slab.dtype.kind == "f" and name != "Points" else slab.dtype


def _as_slice(index: slice | np.ndarray) -> slice | np.ndarray:
    """Return consecutive numbers, such as those of all bars of one rank, as a slice, which copies nothing."""
    if isinstance(index, slice) or not len(index) or (np.diff(index) != 1).any():
        return index
    return slice(int(index[0]), int(index[-1]) + 1)


class ResultWriter:
    """Writes snapshots and history of a run to one file, the same for any number of ranks.

    ``/VTKHDF`` is a temporal UnstructuredGrid of lines in mesh numbering: the connectivity once, and points (the
    current positions) and fields for each snapshot. What bars have in all snapshots is there once, and in ``/bars``. A
    kill may occur at any time, even within a flush, whose order of writes is undefined. Therefore the data and offsets
    of a snapshot are flushed before it is counted, and its count is flushed before its time is written: VTK cannot read
    a step without data, and crashes on more times than steps.
    ``/history`` has one row per recorded step, ``/event`` one per event of analyses with events, ``/case`` the data
    needed to run the case again, ``/snapshots`` step and time of each snapshot.

    All methods are collective. After a :class:`SimulationFailure` they raise it again, and the writer can only be
    closed. A snapshot may be written beside what the caller does next; what fails then is raised by the next method.

    Parameters
    ----------
    path : Path or str
        The file; replaced if it exists, unless ``kept`` is given. Missing folders are created.
    comm : MPI.Comm
    mesh : DistributedMesh
    contents : Contents
    kept : Kept, optional
        Continue an existing file; data after these steps are removed.

    Raises
    ------
    InputError
        On all ranks, for an unwritable folder, serial h5py on several ranks, or a file to append to that is missing,
        damaged or of another case.
    """

    def __init__(
        self, path: Path | str, comm: MPI.Comm, mesh: DistributedMesh, contents: Contents, kept: Kept | None = None
    ) -> None:
        require_parallel_hdf5(comm)
        self.path, self.comm = Path(path), comm
        self._mesh, self._kind = mesh, contents.modes
        self._unpublished: Path | None = None  # temporary name until the file has complete data
        self._shared: SharedFile | None = None
        # The failure after which nothing can be written, and whether the open file can still be closed.
        self._failure: SimulationFailure | None = None
        self._broken = False
        sizes = int(mesh.n_nodes), int(mesh.n_bars)
        contents = contents._replace(attributes=describe_run(comm, contents.attributes))
        compressed = contents.compressed
        if kept is None:
            self._unpublished = create_new(self.path, comm, create_result, *sizes, contents)
        else:
            compressed = on_root(comm, reopen, self.path, sizes, contents, kept)
        self._shared = SharedFile(self._unpublished or self.path, comm, self.path, compressed)
        if contents.events and not self._shared.call(lambda: EVENT in self._shared.file):
            raise InputError(f"{self.path}: has no events, which the run records: write elsewhere (-o)")
        self._snapshots = _Snapshots(self._shared, mesh, contents)
        self._history = _Table(self._shared, "history", contents.columns)
        self._tables = [self._history]
        if contents.events:
            self._tables.append(_Table(self._shared, EVENT, contents.events))
        if kept is None:
            with self._whole_or_failed():
                _write_connectivity(self._shared, mesh)
                if contents.constants:
                    _write_constants(self._shared, mesh, contents.constants)

    @property
    def n_snapshots(self) -> int:
        """Number of snapshots, with the one that is being written."""
        return self._snapshots.count

    def write_snapshot(
        self,
        time: float,
        step: int,
        points: np.ndarray,
        point_data: Mapping[str, np.ndarray],
        cell_data: Mapping[str, np.ndarray],
    ) -> None:
        """Append a snapshot, and write the buffered history rows. Collective; parameters of :meth:`begin_snapshot`.

        Raises
        ------
        SimulationFailure
            On all ranks, for example if the disk is full or the file is missing.
        """
        self.begin_snapshot(time, step, points, point_data, cell_data)
        self.wait()

    def begin_snapshot(
        self,
        time: float,
        step: int,
        points: np.ndarray,
        point_data: Mapping[str, np.ndarray],
        cell_data: Mapping[str, np.ndarray],
    ) -> None:
        """Begin to append a snapshot and to write the buffered history rows; :meth:`wait` ends it. Collective.

        Small ones are written at once.

        Parameters
        ----------
        time : float
            [s]
        step : int
            Number of the time step, larger than that of the previous snapshot.
        points : (n_owned, 3) float64
            Current positions [m]. The values of all arrays must stay until the end of the write.
        point_data : mapping of name to (n_owned, 3) or (n_owned,)
        cell_data : mapping of name to (n local bars, ...)
            Only the counted bars are written.

        Raises
        ------
        SimulationFailure
            On all ranks, for example if the disk is full or the file is missing.
        """
        shared, snapshots = self._ready(), self._snapshots
        arrays = snapshots.arrays(points, point_data, cell_data)
        n_bytes = snapshots.n_bytes(arrays)
        self._require_room(n_bytes)
        with self._whole_or_failed():
            if self.comm.size > 1 and not shared.together:
                arrays = snapshots.gather(arrays)
            n, rows = snapshots.count, [table.take() for table in self._tables]

            def work() -> None:
                snapshots.mark(n, step, time, snapshots.write(n, arrays))
                self._write_rows(rows)
                snapshots.publish(n, time)
                self._publish()

            snapshots.count += 1
            shared.submit(work, beside=n_bytes >= _BESIDE and n > 0)

    def wait(self) -> None:
        """Wait until all that was begun is in the file. Collective."""
        self._ready()

    def append_history(self, row: Mapping[str, Any] | None) -> None:
        """Add a row: rank 0 passes a value for each column, the other ranks None. Collective.

        Rows are buffered until a snapshot, :meth:`flush_history`, :meth:`close`, or a thousand rows.
        """
        self._append(self._history, row)

    def append_event(self, row: Mapping[str, Any] | None) -> None:
        """Add an event: rank 0 passes a value for each column, the other ranks None. Collective."""
        self._append(self._tables[-1], row)

    def _append(self, table: _Table, row: Mapping[str, Any] | None) -> None:
        if table.full:
            self.flush_history()
        table.append(row)

    def _write_rows(self, rows: Sequence[tuple[int, np.ndarray]]) -> None:
        """Write rows taken from the tables, and count them once they are flushed. For owners."""
        for table, taken in zip(self._tables, rows, strict=True):
            table.write(*taken)
        with self._shared.writing():
            self._shared.file.flush()
        for table in self._tables:
            table.commit()

    def flush_history(self) -> None:
        """Write the rows and events kept in memory. Collective."""
        shared = self._ready()
        if not any(table.n_buffered for table in self._tables):
            return
        self._require_room(0)
        with self._whole_or_failed():
            rows = [table.take() for table in self._tables]

            def work() -> None:
                self._write_rows(rows)
                with shared.writing():
                    shared.file.flush()
                self._publish()

            shared.call(work)

    def write_modes(self, eigenvalues: np.ndarray, values: np.ndarray, shapes: np.ndarray) -> None:
        """Write all modes, replacing existing ones. Collective.

        Parameters
        ----------
        eigenvalues, values : (k,); ``values`` are frequencies or load factors
        shapes : (k, owned, 3)
        """
        self.flush_history()
        self._ready()
        self._require_room(24 * self._mesh.n_nodes * len(values))
        shared, order, n = self._shared, self._mesh.node_order, len(eigenvalues)
        datasets: dict[str, Growing] = {}
        name = MODE_VALUES[self._kind][0]

        def begin() -> None:
            datasets.update((name, Growing(dataset)) for name, dataset in shared.file[MODES].items())
            with shared.writing():
                for dataset in datasets.values():
                    dataset.grow(n)

        def put(numbers: Mapping[str, np.ndarray], first: int) -> None:
            with shared.writing():
                for name, rows in numbers.items() if self.comm.rank == 0 else ():
                    datasets[name].write(first, rows)
                shared.file.flush()

        def finish() -> None:
            datasets[CHECKS] = Growing(shared.file[CHECKS][MODES])
            with shared.writing():
                datasets[CHECKS].grow(n)
            put({CHECKS: digests}, 0)
            self._publish()

        with self._whole_or_failed():
            shared.call(begin)
            digests = np.zeros(n, dtype=np.uint64)
            for k in range(n):
                parts = self.comm.gather(order.to_slab(shapes[k]))
                shape = np.concatenate(parts or [np.empty((0, 3))])
                total = np.uint64(seeded("shape", word_sum(shape, 0)))
                digests[k] = total ^ np.uint64(numbers_digest(k, eigenvalues[k], values[k]))
                shared.call(partial(put, {"shape": shape[None]}, k))
            shared.call(partial(put, {name: values, "eigenvalue": eigenvalues}, 0))
            shared.call(finish)

    def close(self) -> None:
        """Write buffered rows and close the file; a second call does nothing. Collective."""
        if self._shared is None:
            return
        try:
            if self._failure is None:
                self.flush_history()
        finally:
            shared = self._shared
            if self._broken:
                self._shared = None
                shared.abandon()
            else:
                shared.close()
                shared.call(self._publish)
                self._shared = None

    def __enter__(self) -> ResultWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: object) -> None:
        # An unexpected error may have occurred on this rank only, and a collective close would wait forever.
        if kind is None or self.comm.size == 1 or isinstance(error, PfemError):
            self.close()

    def _ready(self) -> SharedFile:
        """The file, when nothing is being written any more. Collective."""
        if self._failure is not None:
            raise self._failure
        if self._shared is None:
            raise ValueError(f"{self.path}: the writer is closed")
        with self._whole_or_failed():
            self._shared.wait()
        return self._shared

    @contextmanager
    def _whole_or_failed(self) -> Iterator[None]:
        try:
            yield
        except BaseException as error:
            self._broken = True
            known = isinstance(error, SimulationFailure)
            self._failure = error if known else SimulationFailure(f"{self.path}: a write was interrupted: {error!r}")
            raise

    def _publish(self) -> None:
        """Rename the file to its final name after the first flush. For owners.

        The first flush writes links to new objects before the superblock, which contains the end of the file, so HDF5
        may be unable to open a file that was killed before.
        """
        if self._unpublished is None:
            return
        with self._shared.writing():
            if self.comm.rank == 0:
                os.replace(self._unpublished, self.path)
        self._unpublished = None

    def _require_room(self, n_bytes: int) -> None:
        try:
            reserve = sum(table.reserve_bytes for table in self._tables)
            require_room(self.comm, self.path, n_bytes + reserve, target=self._unpublished)
        except SimulationFailure as error:
            self._failure = error
            raise

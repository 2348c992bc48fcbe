"""Results in one VTKHDF file, written by all ranks together and readable by ParaView, even during the run."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
from mpi4py import MPI

from ..errors import PfemError, SimulationFailure
from ..parallel.agreement import on_root
from .hdf5 import (
    Growing,
    create_new,
    is_compressed,
    open_shared,
    release,
    require_parallel_hdf5,
    require_room,
    write_rows,
    writes_together,
    writing,
)
from .history import RowTables
from .integrity import CHECKS, gather_rows, mark_digest, mesh_digest, snapshot_digests, word_sum
from .layout import PER_STEP, create_field, create_result, create_snapshot_checks, describe_run, field_datasets
from .modes import prepare_modes, write_modes
from .repair import reopen

if TYPE_CHECKING:
    from ..mesh.distribution import DistributedMesh
    from ..parallel.natural import NaturalOrder


_PIECE = 2**18  # number of bars whose connectivity is written at once on one rank


def write_connectivity(file: h5py.File, comm: MPI.Comm, path: Path, mesh: DistributedMesh) -> None:
    """Write the ends of all bars in mesh numbering, their offsets, and the digest of the mesh. Collective.

    Bars that are evaluated on two ranks are written by the rank that counts them.
    """
    vtk, order = file["VTKHDF"], mesh.bar_order
    first, count, together = order.first, order.count, writes_together(comm)
    # one rank may have all bars: pieces keep the working arrays small
    piece = count if comm.size > 1 else min(count, _PIECE)
    total = 0
    for start in range(0, max(count, 1), max(piece, 1)):
        stop = min(start + piece, count)
        if comm.size > 1:
            ends = order.to_slab(mesh.node_ids[mesh.bars[mesh.counted]].astype(np.int64).reshape(-1, 2))
        else:
            ends = mesh.node_ids[mesh.bars[order.owned_rows(start, stop)]].astype(np.int64)
        total += word_sum(ends.ravel(), 2 * (first + start))
        with writing(comm, path):
            write_rows(vtk["Connectivity"], 2 * (first + start), ends.ravel(), collective=together)
        # there is one more offset than bars, which the last rank writes
        end = first + stop + (stop == count and comm.rank == comm.size - 1)
        with writing(comm, path):
            write_rows(vtk["Offsets"], first + start, 2 * np.arange(first + start, end), collective=together)
    digest = mesh_digest(comm, total & (2**64 - 1))
    with writing(comm, path):
        if comm.rank == 0:
            write_rows(file[CHECKS]["mesh"], 0, digest)
        file.flush()


class SnapshotData:
    """Datasets of points and fields of an open result file; the first snapshot creates them and defines their shapes.

    Parameters
    ----------
    file : h5py.File
        Open on all ranks.
    comm : MPI.Comm
    path : Path
        For messages.
    mesh : DistributedMesh
    fields : names of the fields, by ``PointData`` and ``CellData``
    precision : type of floating-point fields; points are always float64
    """

    def __init__(
        self,
        file: h5py.File,
        comm: MPI.Comm,
        path: Path,
        mesh: DistributedMesh,
        fields: Mapping[str, Sequence[str]],
        precision: np.dtype,
    ) -> None:
        self._together = writes_together(comm)
        # the chunks of several ranks are compressed by one of them
        self._compressed = comm.size > 1 and is_compressed(file["VTKHDF/Points"])
        self._vtk, self.comm, self.path = file["VTKHDF"], comm, path
        self._fields, self._precision = fields, precision
        self._nodes, self._bars = mesh.node_order, mesh.bar_order
        # bars evaluated on two ranks are written by the rank that counts them
        self._counted = _as_slice(mesh.counted)
        self._data = self._datasets() if self._vtk["Steps"].attrs["NSteps"] else {}

    @property
    def exists(self) -> bool:
        """Whether the datasets have been created."""
        return bool(self._data)

    def arrays(
        self, points: np.ndarray, point_data: Mapping[str, np.ndarray], cell_data: Mapping[str, np.ndarray]
    ) -> dict[str, np.ndarray]:
        """Return this rank's owned rows of each dataset, by name.

        Raises
        ------
        ValueError
            If the fields are not those of the file, or an array has another number of rows.
        """
        given = {"PointData": point_data, "CellData": cell_data}
        for kind, names in self._fields.items():
            if sorted(given[kind]) != names:
                raise ValueError(f"a snapshot has {kind} {names}, got {sorted(given[kind])}")
        arrays = {"Points": points}
        for name in self._fields["PointData"]:
            arrays[f"PointData/{name}"] = np.asarray(point_data[name])
        for name in self._fields["CellData"]:
            arrays[f"CellData/{name}"] = np.asarray(cell_data[name])[self._counted]
        for name, array in arrays.items():
            if len(array) != self._order(name).n_owned:
                raise ValueError(f"{name} has {len(array)} rows, expected {self._order(name).n_owned}")
        return arrays

    def n_bytes(self, arrays: Mapping[str, np.ndarray]) -> int:
        """Return the size of a snapshot, over all ranks."""
        return sum(
            self._order(name).n_global
            * self._row_type(name, array).itemsize
            * int(np.prod(array.shape[1:], dtype=np.int64))
            for name, array in arrays.items()
        )

    def create(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Create the datasets of the fields. Collective."""
        for name, array in arrays.items():
            if name != "Points":
                kind, _, field = name.partition("/")
                create_field(self._vtk, kind, field, array.shape[1:], self._row_type(name, array))
        self._data = self._datasets()

    def append(self, n: int, arrays: Mapping[str, np.ndarray]) -> np.ndarray:
        """Write the rows of snapshot n; return their digests, see
        :func:`~pfem_petsc.output.integrity.snapshot_digests`. Collective.

        One field after the other goes to mesh numbering, into its digest and into the file, while it is in the cache.
        """
        with writing(self.comm, self.path):
            for name in arrays:
                self._data[name].grow((n + 1) * self._order(name).n_global)
        together = self._together or self._compressed
        sums = self._write_together(n, arrays) if together else self._write_alone(n, arrays)
        return snapshot_digests(self.comm, sums)

    def _write_together(self, n: int, arrays: Mapping[str, np.ndarray]) -> dict[str, int]:
        """Write by collective transfers, and return each rank's share of the digests."""
        sums = {}
        for name, array in arrays.items():
            first, slab, sums[name] = self._slab(name, array)
            with writing(self.comm, self.path):
                self._data[name].write(n * self._order(name).n_global + first, slab, collective=True)
        return sums

    def _write_alone(self, n: int, arrays: Mapping[str, np.ndarray]) -> dict[str, int]:
        """Write this rank's rows without waiting for others, and return its share of the digests."""
        sums, failure = {}, None
        with writing(self.comm, self.path):
            for name, array in arrays.items():
                first, slab, sums[name] = self._slab(name, array)
                try:
                    if failure is None:
                        self._data[name].write(n * self._order(name).n_global + first, slab)
                except (OSError, RuntimeError) as error:
                    failure = error  # other ranks need the rows that are here for their slabs
            if failure is not None:
                raise failure
        return sums

    def _slab(self, name: str, array: np.ndarray) -> tuple[int, np.ndarray, int]:
        """Return the first number of this rank's slab, the slab in the type of the file, and its sum. Collective."""
        order = self._order(name)
        slab = _permuted(order, array) if order.permutes else order.to_slab(array)
        slab = slab.astype(self._row_type(name, slab), copy=False)
        return order.first, slab, word_sum(slab, order.first)

    def _datasets(self) -> dict[str, Growing]:
        return {name: Growing(dataset) for name, dataset in field_datasets(self._vtk).items()}

    def _order(self, name: str) -> NaturalOrder:
        return self._bars if name.startswith("CellData") else self._nodes

    def _row_type(self, name: str, slab: np.ndarray) -> np.dtype:
        return self._precision if slab.dtype.kind == "f" and name != "Points" else slab.dtype


def _as_slice(index: slice | np.ndarray) -> slice | np.ndarray:
    """Return consecutive numbers, such as those of all bars of one rank, as a slice, which copies nothing."""
    if isinstance(index, slice) or not len(index) or (np.diff(index) != 1).any():
        return index
    return slice(int(index[0]), int(index[-1]) + 1)


def _permuted(order: NaturalOrder, array: np.ndarray) -> np.ndarray:
    """Return what :meth:`~pfem_petsc.parallel.natural.NaturalOrder.to_slab` gives on one rank, in a compiled loop."""
    array = np.ascontiguousarray(array)
    slab = np.empty((order.count, *array.shape[1:]), array.dtype)
    word, width = f"u{array.itemsize}", int(np.prod(array.shape[1:], dtype=np.int64))
    gather_rows(
        array.view(word).reshape(-1, width), order.owned_rows(0, order.count), slab.view(word).reshape(-1, width)
    )
    return slab


class SnapshotIndex:
    """Rows of ``/VTKHDF/Steps`` and ``/snapshots`` of an open result file, and the digests of its snapshots.

    Parameters
    ----------
    file : h5py.File
        Open on all ranks.
    comm : MPI.Comm
    path : Path
        For messages.
    mesh : DistributedMesh
    """

    def __init__(self, file: h5py.File, comm: MPI.Comm, path: Path, mesh: DistributedMesh) -> None:
        self._file, self.comm, self.path = file, comm, path
        self.n_nodes, self.n_bars = int(mesh.n_nodes), int(mesh.n_bars)
        steps = file["VTKHDF/Steps"]
        self._per_step = {name: Growing(steps[name]) for name in PER_STEP}
        # one column, because there is one type of cell
        self._wide = {name: (1, *steps[name].shape[1:]) for name in PER_STEP}
        self._times = Growing(steps["Values"])
        self._marks = {name: Growing(file["snapshots"][name]) for name in ("step", "time")}
        self._n_steps = h5py.h5a.open(steps.id, b"NSteps")
        # created with the first snapshot, which defines the fields
        self._digests = Growing(file[CHECKS]["snapshots"]) if steps.attrs["NSteps"] else None

    def create_checks(self) -> None:
        """Create the dataset of digests, once the fields exist. Collective."""
        self._digests = Growing(create_snapshot_checks(self._file))

    def append(self, n: int, step: int, time: float, digests: np.ndarray) -> None:
        """Write the rows of snapshot n, except its time in ``/VTKHDF``. Collective.

        Parameters
        ----------
        n, step, time : number of the snapshot, its step and time [s]
        digests : of its points and fields, in the order of :func:`~pfem_petsc.output.integrity.snapshot_digests`
        """
        with writing(self.comm, self.path):
            for dataset in (*self._per_step.values(), *self._marks.values(), self._digests):
                dataset.grow(n + 1)
        rows = {"PointOffsets": n * self.n_nodes, "CellDataRows": n * self.n_bars, "NumberOfParts": 1}
        with writing(self.comm, self.path):
            if self.comm.rank == 0:
                for name, dataset in self._per_step.items():
                    dataset.write(n, np.full(self._wide[name], rows.get(name, 0)))
                self._marks["step"].write(n, np.array([step]))
                self._marks["time"].write(n, np.array([time]))
                mark = np.array([mark_digest(n, step, time)], dtype=np.uint64)
                self._digests.write(n, np.concatenate([mark, digests])[None])

    def publish(self, n: int, time: float) -> None:
        """Count snapshot n, whose data have been flushed, and then write its time [s]. Collective."""
        with writing(self.comm, self.path):
            self._n_steps.write(np.array(n + 1, dtype=np.int64))
            self._file.flush()
        with writing(self.comm, self.path):
            self._times.grow(n + 1)
            if self.comm.rank == 0:
                self._times.write(n, np.array([time], dtype=np.float64))
            self._file.flush()


class ResultWriter:
    """Writes snapshots and history of a run to one file, the same for any number of ranks.

    ``/VTKHDF`` is a temporal UnstructuredGrid of lines in mesh numbering: the connectivity once, and points (the
    current positions) and fields for each snapshot. A kill may occur at any time, even within a flush, whose order of
    writes is undefined. Therefore the data and offsets of a snapshot are flushed before it is counted, and its count is
    flushed before its time is written: VTK cannot read a step without data, and crashes on more times than steps.
    ``/history`` has one row per recorded step, ``/event`` one per event of analyses with events, ``/case`` the data
    needed to run the case again, ``/snapshots`` step and time of each snapshot.

    All methods are collective. After a :class:`SimulationFailure` they raise it again, and the writer can only be
    closed.

    Parameters
    ----------
    path : Path or str
        The file; replaced if it exists, unless ``append_after_step`` is given. Missing folders are created.
    comm : MPI.Comm
    mesh : DistributedMesh
    point_fields, cell_fields : sequences of str
        Names of the fields; the shape of their rows is that in the first snapshot.
    columns : mapping of history column ("wall/floor/force") to the shape of one row's value, () for a number
    column_types : mapping of history column to type; default: float64
    case_text : str
        The resolved case.
    attributes : mapping
        Stored as attributes of ``/case``: numbers, texts, or any JSON data.
    precision : "float64" or "float32"
        Of the fields. Points are always float64, because strains from positions in single precision are noise.
    compressed : bool
        Whether points and fields are compressed without loss; a file that is continued keeps what it has.
    append_after_step : int, optional
        Continue an existing file; data after this step are removed.
    last : (int, int), optional
        Steps of the last snapshot and of the last history row that are kept then, where not all up to that step are.
    modes : "vibration" or "buckling", optional
        Kind of the modes that :meth:`write_modes` will write.
    events : mapping, optional
        Columns of the table ``/event`` to their types, one of them ``step``; without it there is no such table.

    Raises
    ------
    InputError
        On all ranks, for an unwritable folder, serial h5py on several ranks, or a file to append to that is missing,
        damaged or of another case.
    """

    def __init__(
        self,
        path: Path | str,
        comm: MPI.Comm,
        mesh: DistributedMesh,
        *,
        point_fields: Sequence[str],
        cell_fields: Sequence[str],
        columns: Mapping[str, tuple[int, ...]],
        column_types: Mapping[str, Any],
        case_text: str,
        attributes: Mapping[str, Any],
        precision: str = "float64",
        compressed: bool = False,
        append_after_step: int | None = None,
        last: tuple[int, int] | None = None,
        modes: str | None = None,
        events: Mapping[str, Any] | None = None,
    ) -> None:
        require_parallel_hdf5(comm)
        self.path, self.comm = Path(path), comm
        self.n_nodes, self.n_bars = int(mesh.n_nodes), int(mesh.n_bars)
        self.node_order = mesh.node_order
        self._unpublished: Path | None = None  # temporary name until the file has complete data
        fields = {"PointData": sorted(point_fields), "CellData": sorted(cell_fields)}
        self._file: h5py.File | None = None
        # The failure after which nothing can be written, and whether the open file can still be closed.
        self._failure: SimulationFailure | None = None
        self._broken = False

        described = describe_run(comm, attributes)
        sizes = (self.n_nodes, self.n_bars)
        if append_after_step is None:
            structure = (*sizes, columns, column_types, case_text, described, modes, events, compressed)
            self._unpublished = create_new(self.path, comm, create_result, *structure, checked=True)
        else:
            last = last or (append_after_step, append_after_step)
            on_root(comm, reopen, self.path, append_after_step, last, sizes, fields, columns, case_text, described)
            on_root(comm, prepare_modes, self.path, modes, self.n_nodes)
        with writing(comm, self.path):
            self._file = open_shared(self._unpublished or self.path, comm)
        self.n_snapshots = int(self._file["VTKHDF/Steps"].attrs["NSteps"])
        self._data = SnapshotData(self._file, comm, self.path, mesh, fields, np.dtype(precision))
        self._index = SnapshotIndex(self._file, comm, self.path, mesh)
        self._rows = RowTables(self._file, comm, self.path, columns, events)
        if append_after_step is None:
            with self._whole_or_failed():
                write_connectivity(self._file, comm, self.path, mesh)

    def write_snapshot(
        self,
        time: float,
        step: int,
        points: np.ndarray,
        point_data: Mapping[str, np.ndarray],
        cell_data: Mapping[str, np.ndarray],
    ) -> None:
        """Append a snapshot, and write the buffered history rows. Collective.

        Parameters
        ----------
        time : float
            [s]
        step : int
            Number of the time step, larger than that of the previous snapshot.
        points : (n_owned, 3) float64
            Current positions [m].
        point_data : mapping of name to (n_owned, 3) or (n_owned,)
        cell_data : mapping of name to (n local bars, ...)
            Only the counted bars are written.

        Raises
        ------
        SimulationFailure
            On all ranks, for example if the disk is full or the file is missing.
        """
        file = self._ready()
        arrays = self._data.arrays(points, point_data, cell_data)
        self._require_room(self._data.n_bytes(arrays))
        n = self.n_snapshots
        with self._whole_or_failed():
            if not self._data.exists:
                with writing(self.comm, self.path):
                    self._data.create(arrays)
                    self._index.create_checks()
            digests = self._data.append(n, arrays)
            self._index.append(n, step, time, digests)
            self._rows.write()
            with writing(self.comm, self.path):
                file.flush()
            self._rows.commit()
            self._index.publish(n, time)
            self._publish()
        self.n_snapshots = n + 1

    def append_history(self, row: Mapping[str, Any] | None) -> None:
        """Add a row: rank 0 passes a value for each column, the other ranks None. Collective.

        Rows are buffered until a snapshot, :meth:`flush_history`, :meth:`close`, or a thousand rows.
        """
        if self._rows.history.full:
            self.flush_history()
        self._rows.history.append(row)

    def append_event(self, row: Mapping[str, Any] | None) -> None:
        """Add an event: rank 0 passes a value for each column, the other ranks None. Collective."""
        if self._rows.event.full:
            self.flush_history()
        self._rows.event.append(row)

    def flush_history(self) -> None:
        """Write the rows and events kept in memory. Collective."""
        file = self._ready()
        if not self._rows.buffered:
            return
        self._require_room(0)
        with self._whole_or_failed():
            self._rows.write()
            with writing(self.comm, self.path):
                file.flush()
            self._rows.commit()
            with writing(self.comm, self.path):
                file.flush()
            self._publish()

    def write_modes(self, eigenvalues: np.ndarray, values: np.ndarray, shapes: np.ndarray) -> None:
        """Write all modes; see :func:`~pfem_petsc.output.modes.write_modes`. Collective."""
        self.flush_history()
        file = self._ready()
        self._require_room(24 * self.n_nodes * len(values))
        with self._whole_or_failed():
            write_modes(file, self.comm, self.path, self.node_order, eigenvalues, values, shapes)
            self._publish()

    def close(self) -> None:
        """Write buffered rows and close the file; a second call does nothing. Collective."""
        if self._file is None:
            return
        try:
            if self._failure is None:
                self.flush_history()
        finally:
            file, self._file = self._file, None
            if self._broken:
                release(file, self.comm)
            else:
                with writing(self.comm, self.path):
                    file.close()
                self._publish()

    def __enter__(self) -> ResultWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: object) -> None:
        # An unexpected error may have occurred on this rank only, and a collective close would wait forever.
        if kind is None or self.comm.size == 1 or isinstance(error, PfemError):
            self.close()

    def _ready(self) -> h5py.File:
        if self._failure is not None:
            raise self._failure
        if self._file is None:
            raise ValueError(f"{self.path}: the writer is closed")
        return self._file

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
        """Rename the file to its final name after the first flush.

        The first flush writes links to new objects before the superblock, which contains the end of the file, so HDF5
        may be unable to open a file that was killed before.
        """
        if self._unpublished is None:
            return
        with writing(self.comm, self.path):
            if self.comm.rank == 0:
                os.replace(self._unpublished, self.path)
        self._unpublished = None

    def _require_room(self, n_bytes: int) -> None:
        try:
            require_room(
                self.comm,
                self.path,
                n_bytes + self._rows.reserve_bytes,
                target=self._unpublished,
            )
        except SimulationFailure as error:
            self._failure = error
            raise

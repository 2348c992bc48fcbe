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
from .connectivity import write_connectivity
from .disk import require_room
from .hdf5 import create_new, open_shared, release, require_parallel_hdf5, writing
from .history import RowTables
from .layout import create_result
from .modes import prepare_modes, write_modes
from .provenance import describe_run
from .repair import reopen
from .snapshot_data import SnapshotData
from .snapshot_index import SnapshotIndex

if TYPE_CHECKING:
    from ..mesh.distribution import DistributedMesh

__all__ = ["ResultWriter"]


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

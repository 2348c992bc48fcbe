"""One row per snapshot in a result file, besides points and fields: offsets, step, time, digests."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import h5py
import numpy as np
from mpi4py import MPI

from .digests import CHECKS, mark_digest
from .growing import Growing
from .hdf5 import writing
from .layout import PER_STEP, create_snapshot_checks

if TYPE_CHECKING:
    from ..mesh.distribution import DistributedMesh

__all__ = ["SnapshotIndex"]


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
        digests : of its points and fields, in the order of :func:`~pfem_petsc.output.digests.snapshot_digests`
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

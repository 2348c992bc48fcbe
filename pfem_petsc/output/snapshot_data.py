"""Points and fields of the snapshots in a result file: one dataset each, extended by every snapshot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import h5py
import numpy as np
from mpi4py import MPI

from .digests import snapshot_digests
from .hdf5 import grow, write_rows, writes_together, writing
from .layout import create_field, field_datasets

if TYPE_CHECKING:
    from ..mesh.distribution import DistributedMesh
    from ..parallel.natural import NaturalOrder

__all__ = ["SnapshotData"]


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
        self._vtk, self.comm, self.path = file["VTKHDF"], comm, path
        self._fields, self._precision = fields, precision
        self._nodes, self._bars = mesh.node_order, mesh.bar_order
        # bars evaluated on two ranks are written by the rank that counts them
        self._counted = mesh.counted
        self._data = field_datasets(self._vtk) if self._vtk["Steps"].attrs["NSteps"] else {}

    @property
    def exists(self) -> bool:
        """Whether the datasets have been created."""
        return bool(self._data)

    def slabs(
        self, points: np.ndarray, point_data: Mapping[str, np.ndarray], cell_data: Mapping[str, np.ndarray]
    ) -> dict[str, np.ndarray]:
        """Return this rank's rows of each dataset in mesh numbering, by name. Collective.

        Raises
        ------
        ValueError
            If the fields are not those of the file.
        """
        given = {"PointData": point_data, "CellData": cell_data}
        for kind, names in self._fields.items():
            if sorted(given[kind]) != names:
                raise ValueError(f"a snapshot has {kind} {names}, got {sorted(given[kind])}")
        slabs = {"Points": self._nodes.to_slab(points)}
        for name in self._fields["PointData"]:
            slabs[f"PointData/{name}"] = self._nodes.to_slab(np.asarray(point_data[name]))
        for name in self._fields["CellData"]:
            slabs[f"CellData/{name}"] = self._bars.to_slab(np.asarray(cell_data[name])[self._counted])
        return {name: slab.astype(self._row_type(name, slab), copy=False) for name, slab in slabs.items()}

    def n_bytes(self, slabs: Mapping[str, np.ndarray]) -> int:
        """Return the size of a snapshot, over all ranks."""
        return sum(
            self._order(name).n_global * slab.itemsize * int(np.prod(slab.shape[1:], dtype=np.int64))
            for name, slab in slabs.items()
        )

    def digests(self, slabs: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the digests of a snapshot; see :func:`~pfem_petsc.output.digests.snapshot_digests`. Collective."""
        return snapshot_digests(self.comm, {name: (slab, self._order(name).first) for name, slab in slabs.items()})

    def create(self, slabs: Mapping[str, np.ndarray]) -> None:
        """Create the datasets of the fields. Collective."""
        for name, slab in slabs.items():
            if name != "Points":
                kind, _, field = name.partition("/")
                create_field(self._vtk, kind, field, slab.shape[1:], slab.dtype)
        self._data = field_datasets(self._vtk)

    def append(self, n: int, slabs: Mapping[str, np.ndarray]) -> None:
        """Write the rows of snapshot n. Collective."""
        for name, slab in slabs.items():
            order = self._order(name)
            with writing(self.comm, self.path):
                grow(self._data[name], (n + 1) * order.n_global)
            with writing(self.comm, self.path):
                write_rows(self._data[name], n * order.n_global + order.first, slab, collective=self._together)

    def _order(self, name: str) -> NaturalOrder:
        return self._bars if name.startswith("CellData") else self._nodes

    def _row_type(self, name: str, slab: np.ndarray) -> np.dtype:
        return self._precision if slab.dtype.kind == "f" and name != "Points" else slab.dtype

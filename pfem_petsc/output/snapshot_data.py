"""Points and fields of the snapshots in a result file: one dataset each, extended by every snapshot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import h5py
import numpy as np
from mpi4py import MPI

from .digests import snapshot_digests
from .growing import Growing, is_compressed
from .hdf5 import writes_together, writing
from .integrity import word_sum
from .layout import create_field, field_datasets
from .word_sums import gather_rows

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
        :func:`~pfem_petsc.output.digests.snapshot_digests`. Collective.

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

"""A small result, read into memory at once."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

from pfem_petsc import open_result
from pfem_petsc.case.schema import Case

__all__ = ["Loaded"]


class Loaded:
    """Everything of a result.

    Attributes
    ----------
    case : Case
    history : column to array (rows, ...)
    steps : (snapshots,)
    positions : (snapshots, nodes, 3) [m]
    fields : name to array (snapshots, nodes or bars, ...)
    """

    def __init__(self, folder: Path) -> None:
        result = open_result(folder)
        self.case: Case = result.case
        self.steps = result.steps
        count = len(result.times)
        with h5py.File(result.path, "r", locking=False) as file:
            rows = result._n_rows
            self.history = {name: file[f"history/{name}"][:rows] for name in result._columns}
            vtk = file["VTKHDF"]
            names = {f"PointData/{name}": result.n_nodes for name in result.point_fields}
            names |= {f"CellData/{name}": result.n_bars for name in result.cell_fields}
            self.fields = {name.partition("/")[2]: _by_snapshot(vtk[name], count, n) for name, n in names.items()}
            self.positions = _by_snapshot(vtk["Points"], count, result.n_nodes)

    @property
    def size(self) -> float:
        """Largest extent at the start [m]; 1 without snapshots."""
        return float(np.ptp(self.positions[0], axis=0).max()) if len(self.steps) else 1.0


def _by_snapshot(dataset: h5py.Dataset, count: int, rows: int) -> np.ndarray:
    return dataset[: count * rows].reshape(count, rows, *dataset.shape[1:])

"""VTK's HDF5 format (.vtkhdf): bars are lines, groups are arrays of ones and zeros."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..whole import WholeMesh, without_slashes
from .vtu import masks

__all__ = ["SUFFIXES", "write"]

SUFFIXES = (".vtkhdf",)

_LINE = 3


def write(path: Path, mesh: WholeMesh) -> None:
    """Write the mesh with its bar fields, version 1.0 of the format."""
    import h5py

    n = len(mesh.bars)
    with h5py.File(path, "w", locking=False) as file:
        root = file.create_group("VTKHDF", track_order=True)
        root.attrs["Version"] = np.array([1, 0], np.int64)
        root.attrs.create("Type", b"UnstructuredGrid", dtype=h5py.string_dtype("ascii", 16))
        root["NumberOfPoints"] = np.array([len(mesh.points)], np.int64)
        root["NumberOfCells"] = np.array([n], np.int64)
        root["NumberOfConnectivityIds"] = np.array([2 * n], np.int64)
        root["Points"] = np.asarray(mesh.points, np.float64)
        root["Connectivity"] = np.asarray(mesh.bars, np.int64).ravel()
        root["Offsets"] = np.arange(0, 2 * n + 1, 2, dtype=np.int64)
        root["Types"] = np.full(n, _LINE, np.uint8)
        # in the order in which they are given
        cells, points = (root.create_group(name, track_order=True) for name in ("CellData", "PointData"))
        for name, values in {**without_slashes(mesh.bar_fields), **masks(without_slashes(mesh.bar_groups), n)}.items():
            cells[name] = values
        for name, values in masks(without_slashes(mesh.node_groups), len(mesh.points)).items():
            points[name] = values

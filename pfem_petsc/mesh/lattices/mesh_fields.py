"""Fields on meshes of VTK, such as densities of a topology optimisation, at points of a lattice."""

from __future__ import annotations

import warnings
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ...errors import InputError
from ...files import readable_whole

if TYPE_CHECKING:
    import pyvista

    from .keys import FieldKeys

__all__ = ["MeshField"]


class MeshField:
    """A field of a file, which every rank reads at first use.

    Parameters
    ----------
    name : of the field in expressions, for messages
    keys : of the table ``[mesh.fields.NAME]``
    """

    def __init__(self, name: str, keys: FieldKeys) -> None:
        self._where, self._keys = f"mesh.fields.{name}", keys

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Return the values (n,) at points (n, 3) [m]: those of the nearest point of the mesh for points outside it.

        Raises
        ------
        InputError
            If the file cannot be read, or has no such array of numbers.
        """
        import pyvista

        if len(points) == 0:
            return np.empty(0)
        mesh, array = self._mesh, self._keys.array
        places = points / self._keys.scale
        found = pyvista.PolyData(places).sample(mesh)
        values = np.array(found.point_data[array], dtype=float)
        outside = np.flatnonzero(np.asarray(found.point_data["vtkValidPointMask"]) == 0)
        if len(outside):
            at_points = mesh if array in mesh.point_data else mesh.cell_data_to_point_data()
            nearest = [mesh.find_closest_point(place) for place in places[outside]]
            values[outside] = np.asarray(at_points.point_data[array])[nearest]
        return values

    @cached_property
    def _mesh(self) -> pyvista.DataSet:
        import pyvista

        path, array = Path(self._keys.file), self._keys.array
        try:
            with open(readable_whole(path), "rb"):
                pass
            with warnings.catch_warnings(record=True):  # a file that cannot be read has no cells, which is told below
                mesh = pyvista.read(path)
        except OSError as error:
            raise InputError(f"{self._where}.file: {path}: cannot open: {error.strerror or error}") from None
        except (ValueError, RuntimeError) as error:
            raise InputError(f"{self._where}.file: {path}: cannot be read: {error}") from None
        if not isinstance(mesh, pyvista.DataSet) or mesh.n_cells == 0:
            raise InputError(f"{self._where}.file: {path}: has no cells to take a field from")
        of_points = array in mesh.point_data
        data = mesh.point_data if of_points else mesh.cell_data
        if array not in data or data[array].ndim != 1 or data[array].dtype.kind not in "fiu":
            known = [name for some in (mesh.point_data, mesh.cell_data) for name in some if some[name].ndim == 1]
            there = f"; it has {', '.join(known)}" if known else ""
            raise InputError(f"{self._where}.array = {array!r}: {path} has no such array of single numbers{there}")
        if of_points and array in mesh.cell_data:
            del mesh.cell_data[array]
        return mesh

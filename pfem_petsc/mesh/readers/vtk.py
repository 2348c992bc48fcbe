"""VTK files (.vtu, .vtkhdf): lines are bars, arrays of points and cells are groups and bar fields.

Other cells are left out, with a warning; a line of several points is as many bars less one. A cell array of integers
named ``group`` or ``section`` assigns every bar with value i to the bar group ``group_i`` or ``section_i``; a field
array of strings named ``group_names`` or ``section_names`` replaces these names by its i-th entry. Point arrays of the
same names define node groups (a negative value: no group). An array named ``group:NAME`` is the group NAME of those
with a value other than 0; these may overlap. Other cell arrays with one component are bar fields.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ...errors import InputError
from ..whole import WholeMesh
from . import _vtk_extract, _vtkhdf

if TYPE_CHECKING:
    from mpi4py import MPI

    from ..slab import MeshSlab

__all__ = ["SUFFIXES", "read", "read_on"]

SUFFIXES = (".vtu", ".vtkhdf")


def read(path: Path, fields: Collection[str] | None = None) -> WholeMesh:
    """Return the mesh in a VTK file, with the named cell fields; None: all.

    Raises
    ------
    InputError
        For any content that is not an unstructured grid of lines.
    """
    with tempfile.TemporaryDirectory() as folder:
        result = Path(folder, "mesh.npz")
        # -P removes the program's folder from the path, where this module would shadow the package vtk.
        command = [sys.executable, "-P", _vtk_extract.__file__, str(path.resolve()), str(result)]
        command += [_vtk_extract.ALL] if fields is None else list(fields)
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, errors="replace", check=False)
        if done.returncode == _vtk_extract.REFUSED:
            raise InputError(f"{path}: {done.stdout.strip()}")
        if done.returncode < 0:
            raise InputError(
                f"{path}: VTK ended with signal {signal.Signals(-done.returncode).name} while reading it; "
                "the file is damaged or too large for this machine: write it again"
            )
        if done.returncode:
            last = done.stderr.strip().splitlines()[-1:] or ["no message"]
            raise InputError(f"{path}: cannot be read with VTK ({last[0]}); is VTK 9.2 or newer installed?")
        with np.load(result, allow_pickle=False) as arrays:
            mesh = WholeMesh(points=arrays["points"], bars=arrays["bars"])
            for key in arrays.files:
                kind, slash, name = key.partition("/")
                if key == "left_out" and arrays[key]:
                    mesh.warnings.append(f"{path}: left out {arrays[key]} cells that are not lines")
                if key == "snapshots" and arrays[key] > 1:
                    mesh.warnings.append(
                        f"{path}: has {arrays[key]} snapshots: the mesh and its fields are those of the last one"
                    )
                if slash:
                    getattr(mesh, kind)[name] = arrays[key]
            mesh.known_fields = arrays["cell_fields"].tolist()
    return mesh


def read_on(path: Path, comm: MPI.Comm, fields: Mapping[str, str]) -> MeshSlab | None:
    """Return this rank's slab of a .vtkhdf file of lines only; None for files that VTK must read. Collective."""
    return _vtkhdf.read_on(path, comm, fields) if path.suffix.lower() == ".vtkhdf" else None

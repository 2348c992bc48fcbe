"""What a result file says about the run that made it: case, versions, ranks, options."""

from __future__ import annotations

import json
import platform
from collections.abc import Mapping
from importlib import metadata
from typing import Any

import h5py
import numpy as np
from mpi4py import MPI

from .hdf5 import set_text

__all__ = ["describe_run", "read_attributes", "write_case"]


def describe_run(comm: MPI.Comm, attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Versions, number of ranks and PETSc options of this run, and the given attributes, which win."""
    from petsc4py import PETSc

    try:
        version = metadata.version("pfem_petsc")
    except metadata.PackageNotFoundError:
        version = "not installed"
    return {
        "pfem_petsc": version,
        "petsc": ".".join(map(str, PETSc.Sys.getVersion())),
        "numpy": np.__version__,
        "h5py": h5py.__version__,
        "hdf5": h5py.version.hdf5_version,
        "python": platform.python_version(),
        "mpi": MPI.Get_library_version().split("\x00")[0].splitlines()[0].strip(),
        "ranks": comm.size,
        "petsc_options": PETSc.Options().getAll(),
        **attributes,
    }


def write_case(file: h5py.File, case_text: str, attributes: Mapping[str, Any]) -> None:
    """Store the case in ``/case``: dataset ``text``, attributes. What is not a number or text is stored as JSON."""
    group = file.require_group("case")
    set_text(group, "text", case_text)
    for name, value in attributes.items():
        if isinstance(value, (bool, int, float, np.integer, np.floating, np.bool_)):
            group.attrs[name] = value
        else:
            text = value if isinstance(value, str) else "json:" + json.dumps(value, default=_plain)
            # Attributes over 64 KiB do not fit HDF5's default format; none has reason to be.
            group.attrs.create(name, text.encode(), dtype=h5py.string_dtype("utf-8", max(1, len(text.encode()))))


def read_attributes(group: h5py.Group) -> dict[str, Any]:
    """The attributes stored by :func:`write_case`, with their types."""
    found: dict[str, Any] = {}
    for name, value in group.attrs.items():
        if isinstance(value, bytes):
            value = value.decode()
        if isinstance(value, str) and value.startswith("json:"):
            value = json.loads(value.removeprefix("json:"))
        found[name] = value.item() if isinstance(value, np.generic) else value
    return found


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    return value.item() if isinstance(value, np.generic) else str(value)

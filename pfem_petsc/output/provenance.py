"""Provenance of a result file: case, versions, ranks and options of the run."""

from __future__ import annotations

import json
import platform
import zlib
from collections.abc import Mapping
from typing import Any

import h5py
import numpy as np
from mpi4py import MPI

from ..version import __version__
from .hdf5 import dataset_names, set_text

__all__ = ["describe_run", "read_attributes", "write_case"]

# HDF5 1.10 limits an attribute, including its metadata, to 64 KiB.
LONGEST_ATTRIBUTE = 1 << 15


def describe_run(comm: MPI.Comm, attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return versions, number of ranks and PETSc options of this run, updated with the given attributes."""
    from petsc4py import PETSc

    return {
        "pfem_petsc": __version__,
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
    """Store the case in ``/case``: dataset ``text`` and attributes. Values other than numbers or texts become JSON.

    Attributes that exceed the limit of HDF5 become datasets of the same name.
    """
    group = file.require_group("case")
    for name, value in attributes.items():
        if isinstance(value, (bool, int, float, np.integer, np.floating, np.bool_)):
            group.attrs[name] = value
        else:
            text = value if isinstance(value, str) else "json:" + json.dumps(value, default=_plain)
            raw = text.encode(errors="backslashreplace")
            group.pop(name, None)
            if len(raw) > LONGEST_ATTRIBUTE:
                set_text(group, name, text)
                group.attrs.pop(name, None)
            else:
                group.attrs.create(name, raw, dtype=h5py.string_dtype("utf-8", max(1, len(raw))))
    set_text(group, "text", case_text)
    group["text"].attrs["checksum"] = zlib.crc32(case_text.encode())


def read_attributes(group: h5py.Group) -> dict[str, Any]:
    """Return the attributes stored by :func:`write_case`, with their types."""
    found: dict[str, Any] = {}
    long = {name: group[name][()] for name in dataset_names(group) if name != "text"}
    for name, value in [*group.attrs.items(), *long.items()]:
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

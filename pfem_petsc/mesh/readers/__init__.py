"""Mesh files: the suffix chooses the reader."""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mpi4py import MPI

    from ..slab import MeshSlab

__all__ = ["SUFFIXES", "missing_field", "read_slab"]

SUFFIXES = {".msh": "gmsh", ".vtu": "vtk", ".vtkhdf": "vtk", ".h5": "hdf5"}
"""Reader module for each suffix; each has ``read(path, comm, fields) -> MeshSlab``, collective."""

_GEOMETRY = "; this is a geometry: mesh it by `gmsh -1 {name} -o {stem}.msh`"
_MESHIO = "; convert it by `meshio convert {name} {stem}.vtu`"
_CONVERT = {
    **dict.fromkeys((".geo", ".geo_unrolled", ".step", ".stp", ".brep"), _GEOMETRY),
    **dict.fromkeys((".vtk", ".inp", ".med", ".bdf", ".nas", ".fem", ".xdmf", ".mesh", ".unv"), _MESHIO),
}
"""How to make a file that is read out of another; meshio is installed with the program."""


def read_slab(path: Path, comm: MPI.Comm, fields: Mapping[str, str] | None = None) -> MeshSlab:
    """Read this rank's part of the mesh in a file, with cell fields by name, each with the key that asks for it, for
    messages. Collective.

    Raises
    ------
    InputError
        On all ranks, if there is no such file, no reader for its suffix, or its content is not a mesh of bars.
    """
    from ...errors import InputError
    from ...parallel.agreement import on_root

    on_root(comm, _check_file, path)
    reader = SUFFIXES.get(path.suffix.lower())
    if reader is None:
        hint = _CONVERT.get(path.suffix.lower(), "").format(name=path.name, stem=path.stem)
        raise InputError(f"mesh.file: no reader for {path.name!r}; known suffixes: {', '.join(SUFFIXES)}{hint}")
    return importlib.import_module(f"{__name__}.{reader}").read(path, comm, fields or {})


def missing_field(path: Path | str, fields: Mapping[str, str], known: Iterable[str]) -> str | None:
    """Return the message about the first of ``fields`` that is not among the ``known`` cell fields of a file."""
    known = sorted(known)
    for name, key in fields.items():
        if name not in known:
            there = f"; it has {', '.join(known)}" if known else ""
            return f"{key} = {name!r}: {path} has no cell field of this name with one number for each bar{there}"
    return None


def _check_file(path: Path) -> None:
    from ...errors import InputError

    try:
        with open(path, "rb"):
            pass
    except FileNotFoundError:
        raise InputError(f"mesh.file: there is no file {path}{_near(path)}") from None
    except OSError as error:
        raise InputError(f"mesh.file: cannot open {path}: {error.strerror}") from None


def _near(path: Path) -> str:
    """Return a hint at a mesh file with a similar name."""
    folder = path.parent
    try:
        there = sorted(entry.name for entry in folder.iterdir() if entry.suffix.lower() in SUFFIXES)
    except FileNotFoundError:
        return f": there is no folder {folder}"
    except OSError:
        return ""
    # the right name with another suffix comes first
    match = [name for name in there if Path(name).stem == path.stem] or difflib.get_close_matches(path.name, there, n=1)
    if match:
        return f", did you mean {match[0]!r}?"
    return f"; that folder has {', '.join(there[:5])}" + (", ..." if len(there) > 5 else "") if there else ""

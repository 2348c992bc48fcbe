"""Mesh files: the suffix chooses the reader.

Each module of this folder reads one format. It has ``SUFFIXES``, the suffixes of its files in small letters, and
``read(path, fields) -> WholeMesh``, which rank 0 calls: the mesh with those of the named bar fields that the file has
(None: all). A format that all ranks read together has ``read_on(path, comm, fields) -> MeshSlab | None`` as well; None
for files that it leaves to ``read``.
"""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mpi4py import MPI

    from ..slab import MeshSlab
    from ..whole import WholeMesh

__all__ = ["missing_field", "read_slab", "read_whole", "suffixes"]

_GEOMETRY = "; this is a geometry: mesh it by `gmsh -1 {name} -o {stem}.msh`"
_MESHIO = "; convert it by `meshio convert {name} {stem}.vtu`"
_CONVERT = {
    **dict.fromkeys((".geo", ".geo_unrolled", ".step", ".stp", ".brep"), _GEOMETRY),
    **dict.fromkeys((".vtk", ".med", ".bdf", ".nas", ".fem", ".xdmf", ".mesh", ".unv"), _MESHIO),
}
"""How to make a file that is read out of another; meshio is installed with the program."""


def suffixes() -> dict[str, str]:
    """Return the name of the reader of each suffix."""
    from ...registry import choices, lookup

    return {suffix: name for name in choices(__name__) for suffix in lookup(__name__, name, "").SUFFIXES}


def _reader_name(path: Path, key: str = "mesh.file: ") -> str:
    """Return the name of the module that reads a file; messages begin with the key that names it."""
    from ...errors import InputError

    _check_file(path, key)
    known = suffixes()
    reader = known.get(path.suffix.lower())
    if reader is None:
        hint = _CONVERT.get(path.suffix.lower(), "").format(name=path.name, stem=path.stem)
        raise InputError(f"{key}no reader for {path.name!r}; known suffixes: {', '.join(known)}{hint}")
    return reader


def read_slab(path: Path, comm: MPI.Comm, fields: Mapping[str, str] | None = None) -> MeshSlab:
    """Read this rank's part of the mesh in a file, with cell fields by name, each with the key that asks for it, for
    messages. Collective.

    Raises
    ------
    InputError
        On all ranks, if there is no such file, no reader for its suffix, or its content is not a mesh of bars.
    """
    from ...parallel.agreement import on_root
    from ...registry import lookup
    from ..whole import read_and_scatter

    reader = lookup(__name__, on_root(comm, _reader_name, path), "")
    wanted = fields or {}
    slab = reader.read_on(path, comm, wanted) if hasattr(reader, "read_on") else None
    if slab is not None:
        return slab

    def read(path: Path) -> WholeMesh:
        from ...errors import InputError

        whole = reader.read(path, list(wanted))
        missing = missing_field(path, wanted, whole.bar_fields if whole.known_fields is None else whole.known_fields)
        if missing is not None:
            raise InputError(missing)
        whole.bar_fields = {name: whole.bar_fields[name] for name in wanted}
        return whole

    return read_and_scatter(read, path, comm)


def read_whole(path: Path, fields: Collection[str] | None = None) -> WholeMesh:
    """Read a mesh file as it is, unchecked, with the named bar fields; None: with all. For one rank.

    Raises
    ------
    InputError
        As :func:`read_slab`.
    """
    from ...errors import InputError
    from ...registry import lookup

    path = Path(path)
    whole = lookup(__name__, _reader_name(path, ""), "").read(path, fields)
    known = list(whole.bar_fields) if whole.known_fields is None else whole.known_fields
    missing = missing_field(path, dict.fromkeys(fields or (), "bar_fields"), known)
    if missing is not None:
        raise InputError(missing)
    if fields is not None:
        whole.bar_fields = {name: whole.bar_fields[name] for name in fields}
    whole.source = str(path)
    return whole


def missing_field(path: Path | str, fields: Mapping[str, str], known: Iterable[str]) -> str | None:
    """Return the message about the first of ``fields`` that is not among the ``known`` cell fields of a file."""
    known = sorted(known)
    for name, key in fields.items():
        if name not in known:
            there = f"; it has {', '.join(known)}" if known else ""
            return f"{key} = {name!r}: {path} has no cell field of this name with one number for each bar{there}"
    return None


def _check_file(path: Path, key: str) -> None:
    from ...errors import InputError
    from ...files import readable_whole

    try:
        with open(readable_whole(path), "rb"):
            pass
    except FileNotFoundError:
        raise InputError(f"{key}there is no file {path}{_near(path)}") from None
    except OSError as error:
        raise InputError(f"{key}cannot open {path}: {error.strerror}") from None


def _near(path: Path) -> str:
    """Return a hint at a mesh file with a similar name."""
    folder = path.parent
    known = suffixes()
    try:
        there = sorted(entry.name for entry in folder.iterdir() if entry.suffix.lower() in known)
    except FileNotFoundError:
        return f": there is no folder {folder}"
    except OSError:
        return ""
    # the right name with another suffix comes first
    match = [name for name in there if Path(name).stem == path.stem] or difflib.get_close_matches(path.name, there, n=1)
    if match:
        return f", did you mean {match[0]!r}?"
    return f"; that folder has {', '.join(there[:5])}" + (", ..." if len(there) > 5 else "") if there else ""

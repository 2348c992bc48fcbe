"""Mesh files: the suffix chooses the format.

Each module of this folder is a format. It has ``SUFFIXES``, the suffixes of its files in small letters, and one or more
of the functions

- ``read(path, fields) -> WholeMesh``, which rank 0 calls: the mesh with those of the named fields of bars and nodes
  that the file has (None: all);
- ``read_on(path, comm, fields) -> MeshSlab``, in its place, of all ranks together: with exactly these fields, by the
  keys that ask for them;
- ``read_faces(path)``, which every rank calls: points (n, 3), the numbers of the corners of faces, one face after the
  other, and the place in them where each face begins, and the last ends;
- ``write(path, mesh)``, which one rank calls with a :class:`~pfem_petsc.mesh.whole.WholeMesh`. What it writes, one file
  or several in the folder of ``path``, takes its place when it is complete.
"""

from __future__ import annotations

import difflib
import importlib
import os
import shlex
from collections.abc import Collection, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from types import ModuleType

    import numpy as np
    from mpi4py import MPI

    from ..mesh.slab import MeshSlab
    from ..mesh.whole import WholeMesh

__all__ = ["read_slab", "read_triangles", "read_whole", "suffixes", "write_whole", "writer_of"]

_CONVERT = {
    **dict.fromkeys(
        (".geo", ".geo_unrolled", ".step", ".stp", ".iges", ".igs", ".brep"),
        "; this is a geometry: mesh its curves by `gmsh -1 -clmin 1e22 {name} -o {stem}.msh`, one bar each, or with "
        "the length of bars after -clmin (pip install gmsh)",
    ),
    **dict.fromkeys((".unv", ".med"), "; convert it by `gmsh {name} -save -o {stem}.msh` (pip install gmsh)"),
    **dict.fromkeys(
        (".xdmf", ".mesh", ".mdpa", ".avs"), "; convert it by `meshio convert {name} {stem}.vtk` (pip install meshio)"
    ),
    **dict.fromkeys(
        (".dxf", ".3dm"),
        "; export its lines as Wavefront OBJ from the program that made it, or convert it by the script for drawings "
        "in docs/meshes.md",
    ),
    **dict.fromkeys((".dwg", ".skp", ".blend", ".3ds", ".fbx"), "; export its lines as Wavefront OBJ or DXF"),
    ".ifc": "; export the axes of the members as lines (Wavefront OBJ or DXF) from the program that made it",
    ".fem": "; this is bulk data: `(echo SOL 101; echo CEND; cat {name}) > {stem}.bdf`",
    **dict.fromkeys((".xlsx", ".xls", ".ods"), "; save the sheets of nodes and bars as {stem}_nodes.csv and _bars.csv"),
}
"""How to make a file that is read out of another."""


def suffixes(*what: str) -> dict[str, ModuleType]:
    """Return the module of each suffix; ``what`` are functions of which it must have one, as ``write``."""
    from ..registry import modules

    return {
        suffix: each
        for each in modules(__name__).values()
        if any(hasattr(each, name) for name in what)
        for suffix in each.SUFFIXES
    }


def read_slab(path: Path, comm: MPI.Comm, fields: Mapping[str, str] | None = None) -> MeshSlab:
    """Read this rank's part of the mesh in a file, with fields of bars or nodes by name, each with the key that asks
    for it, for messages. Collective.

    Raises
    ------
    InputError
        On all ranks, if there is no such file, no reader for its suffix, or its content is not a mesh of bars.
    """
    from ..mesh.slab import check_size
    from ..mesh.whole import scattered
    from ..parallel.agreement import agreed, on_root

    # files that rank 0 sends on need not be there on other machines
    reader = importlib.import_module(on_root(comm, lambda: _reader_of(path, "mesh.file: ").__name__))
    if hasattr(reader, "read_on"):
        slab = reader.read_on(path, comm, fields or {})
        check_size(slab.n_nodes, str(path))
        return slab
    with agreed(comm):
        whole = _read(reader, path, fields or {}) if comm.rank == 0 else None
    return scattered(whole, str(path), comm)


def read_whole(path: Path, fields: Collection[str] | None = None) -> WholeMesh:
    """Read a mesh file as it is, with the named fields; None: with all. For one rank.

    The mesh need not be one that can be simulated, but its numbers are checked: coordinates and ends of bars.

    Raises
    ------
    InputError
        As :func:`read_slab`.
    """
    from mpi4py import MPI

    from ..mesh.whole import WholeMesh, check_numbers

    path = Path(path)
    reader = _reader_of(path, "")
    wanted = None if fields is None else dict.fromkeys(fields, "bar_fields")
    if hasattr(reader, "read_on"):
        slab = reader.read_on(path, MPI.COMM_SELF, wanted)
        whole = WholeMesh(slab.points, slab.bars.astype("int64"), slab.node_groups, slab.bar_groups, slab.bar_fields)
        whole.node_fields, whole.warnings = slab.node_fields, slab.warnings
    else:
        whole = _read(reader, path, wanted)
    whole.source = str(path)
    check_numbers(WholeMesh(whole.points, whole.bars).slab(whole.source), MPI.COMM_SELF)
    return whole


def read_triangles(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return points (n, 3) and the numbers (t, 3) of the corners of the triangles in a file; faces of more corners,
    which must be convex, are divided. For one rank; messages do not name the file.

    Raises
    ------
    InputError
        If there is no such file, no reader for its suffix, or its content is not a surface.
    """
    import numpy as np

    from ..errors import InputError
    from ._common import whole_numbers

    try:
        points, corners, offsets = _reader_of(path, "", "read_faces").read_faces(path)
        sizes = np.diff(offsets)
        if not sizes.size or not np.isfinite(points).all():
            raise InputError(f"has {'coordinates that are not finite' if sizes.size else 'no faces'}")
        if sizes.min() < 3:
            raise InputError(f"face {sizes.argmin()} (from 0) has {sizes.min()} corners: expected 3 or more")
        n = len(points)
        corners = whole_numbers(corners, 0, n, "there is no point ", f": the file has {n}, from 0")
    except InputError as error:
        raise InputError(str(error).removeprefix(f"{path}: ")) from None
    face = np.repeat(np.arange(len(sizes)), sizes - 2)
    second = np.arange(len(face)) + 2 * face + 1
    triangles = corners[np.stack([offsets[face], second, second + 1], axis=1)]
    a, b, c = (points[triangles[:, k]] for k in range(3))
    areas = np.cross(b - a, c - a)
    total = np.add.reduceat(areas, np.concatenate([[0], np.cumsum(sizes - 2)[:-1]]))[face]
    bent = np.flatnonzero((np.einsum("ti,ti->t", areas, total) < 0.0) & (sizes[face] > 3))
    if len(bent):
        x = ", ".join(f"{value:.6g}" for value in a[bent[0]])
        raise InputError(f"the face at ({x}) in the file is not convex: divide it into triangles")
    return points, triangles


def _read(reader: Any, path: Path, fields: Mapping[str, str] | None) -> WholeMesh:
    from ..errors import InputError
    from ..mesh.whole import check_fields

    try:
        whole = reader.read(path, fields)
    except MemoryError:
        raise InputError(f"{path}: the mesh does not fit in memory; write it as .h5 for many ranks") from None
    check_fields(path, fields, {*whole.bar_fields, *whole.node_fields})
    for kind in ("bar_fields", "node_fields") if fields is not None else ():
        own = getattr(whole, kind)
        setattr(whole, kind, {name: own[name] for name in fields if name in own})
    return whole


def _reader_of(path: Path, key: str, *what: str) -> Any:
    """Return the module that reads a file, by ``what``; messages begin with the key that names the file."""
    from ..errors import InputError
    from ..files import readable_whole

    known = suffixes(*(what or ("read", "read_on")))
    try:
        with open(readable_whole(path), "rb"):
            pass
    except FileNotFoundError:
        raise InputError(f"{key}there is no file {path}{_near(path, known)}") from None
    except OSError as error:
        raise InputError(f"{key}cannot open {path}: {error.strerror}") from None
    if path.suffix.lower() not in known:
        names = {"name": shlex.quote(str(path)), "stem": shlex.quote(str(path.with_suffix("")))}
        hint = "" if what else _CONVERT.get(path.suffix.lower(), "").format(**names)
        raise InputError(f"{key}no reader for {path.name!r}; known suffixes: {', '.join(known)}{hint}")
    return known[path.suffix.lower()]


def _near(path: Path, known: Collection[str]) -> str:
    """Return a hint at what the path is, or at a mesh file with a similar name."""
    if path.is_symlink():
        return f": it is a link to {path.readlink()}, which is not there"
    folder = path.parent
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


def writer_of(path: Path) -> Any:
    """Return the module that writes a file.

    Raises
    ------
    InputError
        If there is none for its suffix.
    """
    from ..errors import InputError

    known = suffixes("write")
    if path.suffix.lower() not in known:
        raise InputError(f"{path}: no writer for {path.suffix or 'no suffix'}; known suffixes: {', '.join(known)}")
    return known[path.suffix.lower()]


def write_whole(path: Path | str, mesh: WholeMesh) -> Path:
    """Write a mesh to a file; an earlier one of this name is replaced when the new one is complete.

    Returns
    -------
    The absolute path.

    Raises
    ------
    InputError
        If there is no writer for the suffix, the format cannot have what the mesh has, or the file cannot be written.
    """
    from ..errors import InputError

    given = path
    path = Path(path).absolute()
    writer = writer_of(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent, ignore_cleanup_errors=True) as folder:
            new = Path(folder, path.name)
            writer.write(new, mesh)
            for file in sorted(new.parent.iterdir()):
                os.replace(file, path.with_name(file.name))
    except InputError as error:
        raise InputError(str(error).replace(str(new), str(given))) from error
    except (OSError, RuntimeError) as error:
        raise InputError(f"{path}: cannot be written: {getattr(error, 'strerror', None) or error}") from error
    return path

"""Mesh files: the suffix chooses the writer.

Each module of this folder writes one format. It has ``SUFFIXES``, the suffixes of its files in small letters, and
``write(path, mesh)``, which is called on one rank with a :class:`~pfem_petsc.mesh.whole.WholeMesh`. What it writes, one
file or several in the folder of ``path``, takes its place when it is complete.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..whole import WholeMesh

__all__ = ["suffixes", "write_whole", "writer_name"]


def suffixes() -> dict[str, str]:
    """Return the name of the writer of each suffix."""
    from ...registry import choices, lookup

    return {suffix: name for name in choices(__name__) for suffix in lookup(__name__, name, "").SUFFIXES}


def writer_name(path: Path) -> str:
    """Return the name of the module that writes a file.

    Raises
    ------
    InputError
        If there is none for its suffix.
    """
    from ...errors import InputError

    known = suffixes()
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
    from ...errors import InputError
    from ...registry import lookup

    given = path
    path = Path(path).absolute()
    writer = lookup(__name__, writer_name(path), "")
    new = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        new.mkdir()
        try:
            writer.write(new / path.name, mesh)
            for file in sorted(new.iterdir()):
                os.replace(file, path.with_name(file.name))
        finally:
            shutil.rmtree(new, ignore_errors=True)
    except InputError as error:
        raise InputError(str(error).replace(str(new / path.name), str(given))) from error
    except (OSError, RuntimeError) as error:
        raise InputError(f"{path}: cannot be written: {getattr(error, 'strerror', None) or error}") from error
    return path

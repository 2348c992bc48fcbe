"""Meshes: generators, readers, checks, and distribution over the ranks."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from mpi4py import MPI

    from .slab import MeshSlab

__all__ = ["load_slab"]


def load_slab(
    mesh: Any, comm: MPI.Comm, fields: Mapping[str, str] | None = None, groups: Collection[str] | None = None
) -> MeshSlab:
    """Return this rank's part of the mesh of a case after checks, with warnings in ``warnings``. Collective.

    Parameters
    ----------
    mesh : the ``[mesh]`` table of a case
        With ``generator`` and ``parameters`` (arrays are one), or ``file``: the suffix chooses the reader (``.msh``,
        ``.vtu``, ``.vtkhdf``, ``.h5``).
    fields : names of cell fields to read, each with the key that asks for it, for messages
    groups : names of the groups that are used; a generator may leave out other bar groups. None: all are

    Raises
    ------
    InputError
        On all ranks, if the mesh cannot be generated or read, or is invalid.
    """
    from ..parallel.agreement import agreed
    from ..registry import lookup
    from .whole import check_mesh

    if mesh.generator is not None:
        from ..errors import InputError

        with agreed(comm):
            generator = lookup("pfem_petsc.mesh.generators", mesh.generator, "mesh.generator")
        if hasattr(generator, "generate_on"):
            slab = generator.generate_on(mesh.parameters, comm, fields or {}, groups)
        else:
            with agreed(comm):
                for name, key in (fields or {}).items():
                    raise InputError(f"{key} = {name!r}: generator {mesh.generator} has no cell fields; give area")
                try:
                    slab = generator.generate(mesh.parameters, comm.rank, comm.size)
                except MemoryError:
                    raise InputError(f"mesh: the {mesh.generator} does not fit in this machine's memory") from None
    else:
        from ..formats import read_slab

        slab = read_slab(Path(mesh.file), comm, fields or {})
    slab.warnings = check_mesh(slab, comm)
    return slab

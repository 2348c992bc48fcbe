"""Nodes and bars given by arrays from Python, or by lists in the case file."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any

from mpi4py import MPI
from pydantic import model_validator

from ...case.base import StrictModel
from ...errors import InputError
from ...parallel.agreement import agreed
from ..slab import MeshSlab, check_size, slab_of_whole
from ..truss import Truss
from ..whole import WholeMesh, check_fields, scattered


class Parameters(StrictModel):
    """Keys of ``[mesh]`` with ``generator = "arrays"``; a :class:`~pfem_petsc.mesh.truss.Truss` takes their place."""

    points: Any = None
    """positions of the nodes [m], rows [x, y, z]"""
    bars: Any = None
    """nodes at the ends of each bar, rows [a, b], numbered from 0"""
    node_groups: dict[str, Any] | None = None
    """numbers of the nodes of each group, by name"""
    bar_groups: dict[str, Any] | None = None
    """numbers of the bars of each group, by name"""
    bar_fields: dict[str, Any] | None = None
    """a number for each bar, by name, as areas for ``area_field`` of sections"""
    digest: str | None = None
    """identifies the arrays of a large truss from Python, which the text of a case does not have"""
    truss: Any = None
    """Truss from Python"""

    @model_validator(mode="after")
    def _whole(self) -> Parameters:
        if self.truss is None and self.digest is None:
            missing = [key for key in ("points", "bars") if getattr(self, key) is None]
            if missing:
                raise ValueError(f"expected the keys points and bars; {missing[0]} is missing")
            try:
                self.__dict__["truss"] = Truss(
                    self.points,
                    self.bars,
                    node_groups=self.node_groups,
                    bar_groups=self.bar_groups,
                    bar_fields=self.bar_fields,
                )
            except InputError as error:
                raise InputError(str(error).removeprefix("Truss: ")) from error
        elif self.truss is not None and self.digest not in (None, self.truss.digest):
            raise ValueError(
                f"the arrays are not those that the case was made with: their digest is {self.truss.digest[:12]}..., "
                f"expected {self.digest[:12]}..."
            )
        given = {"truss"} if self.truss is not None else {"digest"}
        self.__dict__.update({key: None for key in type(self).model_fields if key not in given})
        object.__setattr__(self, "__pydantic_fields_set__", given)
        return self

    def table(self) -> dict[str, Any]:
        """Return the mesh as nested lists with these keys; see :meth:`~pfem_petsc.mesh.truss.Truss.table`."""
        return {"digest": self.digest} if self.truss is None else self.truss.table()


def generate_on(
    parameters: Parameters, comm: MPI.Comm, fields: Mapping[str, str], groups: Collection[str] | None = None
) -> MeshSlab:
    """Return this rank's part of the truss, with the named bar fields and all groups. Collective.

    Raises
    ------
    InputError
        On all ranks, if the arrays are missing, or differ from rank to rank, or lack a field.
    """
    truss: Truss | None = parameters.truss
    digest = parameters.digest if truss is None else truss.digest
    found = comm.allgather((digest, truss is not None and truss.points is not None))
    if any(other != found[0][0] for other, _ in found):
        rank = next(rank for rank, (other, _) in enumerate(found) if other != found[0][0])
        raise InputError(
            f"mesh: the arrays of rank {rank} differ from those of rank 0: give all ranks the same arrays, or rank 0 "
            "alone, by Truss(..., comm=comm)"
        )
    if not found[0][1]:  # nobody has, or not the one that would send them
        raise InputError(
            f"mesh: the arrays of this case (digest {str(digest)[:12]}...) are not in its text, as they are large: "
            "give the truss, as in Case.load(path, mesh=truss)"
        )
    with agreed(comm):
        if comm.rank == 0:
            check_fields("mesh", fields, truss.bar_fields)
    check_size(truss.n_nodes, "mesh")
    if not all(whole for _, whole in found):
        whole = None
        if comm.rank == 0:
            own = {name: truss.bar_fields[name] for name in fields}
            whole = WholeMesh(truss.points, truss.bars, dict(truss.node_groups), dict(truss.bar_groups), own)
        return scattered(whole, "mesh", comm)
    slab = slab_of_whole(truss.points, truss.bars, truss.node_groups, truss.bar_groups, "mesh", comm.rank, comm.size)
    here = slice(slab.first_bar, slab.first_bar + len(slab.bars))
    return replace(slab, bar_fields={name: truss.bar_fields[name][here] for name in fields}, structured=False)

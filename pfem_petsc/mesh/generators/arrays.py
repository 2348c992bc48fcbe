"""Trusses from arrays, used as meshes of cases: nodes and bars from Python, or from lists in the case file."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterable, Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI
from pydantic import model_validator

from ...case.base import StrictModel
from ...errors import InputError
from ...parallel.agreement import agreed, on_root
from ..slab import MeshSlab, check_size, slab_from_arrays
from ..whole import WholeMesh, case_tables, check_fields, check_mesh, scattered, without_slashes

if TYPE_CHECKING:
    import pyvista
    from numpy.typing import ArrayLike

INLINE = 10_000
"""Number of nodes and bars up to which the text of a case has the arrays; beyond, it has their digest."""


_NAMED = ("node_groups", "bar_groups", "bar_fields")


class Truss:
    """Nodes and bars as the mesh of a case: ``Case(mesh=truss, ...)``.

    Without ``comm``, every rank passes the same arrays and keeps all of them; their equality is checked when the mesh
    is distributed. With ``comm``, only rank 0 passes arrays (those of other ranks are ignored and may be None). It
    checks them, and sends each rank its part when the mesh is distributed. A truss of up to 10,000 nodes and bars is
    sent to all ranks at once. The call is then collective.

    Parameters
    ----------
    points : (nodes, 3) positions [m]
    bars : (bars, 2) integers, the nodes at both ends of each bar, numbered from 0
    node_groups, bar_groups : numbers of the members, or a boolean mask, for each name
    bar_fields : (bars,) numbers for each name, such as areas [m2] for ``area_field`` of sections
    comm : communicator whose rank 0 passes the arrays; default: all ranks pass the same arrays
    source : name of the truss in messages

    Attributes
    ----------
    n_nodes, n_bars : int
    points, bars, node_groups, bar_groups, bar_fields : as passed, read-only; None if only rank 0 has them
    digest : str
        Identifies the content.
    tables : dict
        Tables of a case (``material``, ``section``, ``node_set``, ``support``, ``load``, ``gravity``), if the truss was
        read from a file that has them.
    warnings : list of str
        About bars that are far shorter than the others, and parts of a file that were left out.

    Raises
    ------
    InputError
        For arrays of wrong shape or type, and for a mesh that cannot be simulated: coordinates that are not finite,
        bars of zero length, two bars between the same nodes, nodes without bars. With ``comm`` on all ranks.
    """

    points: np.ndarray | None = None
    bars: np.ndarray | None = None
    node_groups: Mapping[str, np.ndarray] | None = None
    bar_groups: Mapping[str, np.ndarray] | None = None
    bar_fields: Mapping[str, np.ndarray] | None = None

    def __init__(
        self,
        points: ArrayLike | None,
        bars: ArrayLike | None,
        *,
        node_groups: Mapping[str, ArrayLike] | None = None,
        bar_groups: Mapping[str, ArrayLike] | None = None,
        bar_fields: Mapping[str, ArrayLike] | None = None,
        comm: MPI.Comm | None = None,
        source: str = "Truss",
    ) -> None:
        given = points, bars, node_groups or {}, bar_groups or {}, bar_fields or {}, source
        self.tables: dict[str, dict[str, Any]] = {}
        if comm is None:
            self._take(*given)
        else:
            self.__dict__.update(on_root(comm, self._take_on_root, *(given if comm.rank == 0 else ())))

    def _take_on_root(self, *given: Any) -> dict[str, Any]:
        """Take the arrays of rank 0, and return what all ranks have: all of a small truss, which is part of texts."""
        self._take(*given)
        if self.n_nodes + self.n_bars <= INLINE:
            return self.__dict__
        return {key: self.__dict__[key] for key in ("n_nodes", "n_bars", "digest", "warnings")}

    def _take(self, points: Any, bars: Any, node_groups: Any, bar_groups: Any, bar_fields: Any, source: str) -> None:
        slab = slab_from_arrays(source, points, bars, node_groups, bar_groups, bar_fields)
        self.warnings = check_mesh(slab, MPI.COMM_SELF)
        self.points, self.bars = _kept(slab.points), _kept(slab.bars)
        for kind in _NAMED:
            setattr(self, kind, {name: _kept(array) for name, array in getattr(slab, kind).items()})
        self.n_nodes, self.n_bars, self.digest = slab.n_nodes, slab.n_bars, _digest(slab)

    @classmethod
    def read(cls, path: Path | str, bar_fields: Iterable[str] | None = None, *, clean: float | None = None) -> Truss:
        """Read a mesh file with its groups and bar fields; ``docs/meshes.md`` lists the formats.

        Parameters
        ----------
        path : name of the file, whose suffix chooses the reader
        bar_fields : names of the bar fields to be read; default: all
        clean : distance [m] up to which nodes are merged before double bars, bars without length and nodes without bars
            are removed (0: coincident nodes); default: files with these defects are rejected

        Raises
        ------
        InputError
            As for the mesh file of a case.
        """
        from ...formats import read_whole

        mesh = read_whole(Path(path), None if bar_fields is None else list(bar_fields))
        if clean is not None:
            from ..tools import cleaned

            mesh, _ = cleaned(mesh, clean)
        return cls.from_mesh(mesh)

    @classmethod
    def from_mesh(cls, mesh: WholeMesh) -> Truss:
        """Return the truss of a mesh returned by a reader, with its tables and warnings."""
        named: dict[str, Any] = {kind: without_slashes(getattr(mesh, kind)) for kind in _NAMED}
        truss = cls(mesh.points, mesh.bars, **named, source=mesh.source)
        truss.tables = case_tables(mesh.tables)
        truss.warnings = mesh.warnings + truss.warnings
        if mesh.node_fields:
            names = ", ".join(mesh.node_fields)
            truss.warnings.append(f"{mesh.source}: left out fields of nodes ({names}): a truss from arrays has none")
        return truss

    def to_mesh(self) -> WholeMesh:
        """Return the truss as a mesh for writers."""
        self._require("written")
        groups = [{name: rows.copy() for name, rows in getattr(self, kind).items()} for kind in _NAMED]
        tables = {name: dict(self.tables[name]) for name in ("material", "section") if name in self.tables}
        return WholeMesh(self.points.copy(), self.bars.copy(), *groups, tables=tables)

    def write(self, path: Path | str) -> Path:
        """Write the truss to a file, whose suffix chooses the format; ``docs/meshes.md`` lists them.

        Returns
        -------
        The absolute path.

        Raises
        ------
        InputError
            If there is no writer for the suffix, or the file cannot be written.
        """
        from ...formats import write_whole

        return write_whole(path, self.to_mesh())

    @cached_property
    def lengths(self) -> np.ndarray:
        """Lengths of the bars (bars,) [m]."""
        self._require("measured")
        return np.linalg.norm(self.points[self.bars[:, 1]] - self.points[self.bars[:, 0]], axis=1)

    @property
    def mesh_table(self) -> dict[str, Any]:
        """The table ``[mesh]`` of a case that has this truss."""
        return {"generator": "arrays", "truss": self}

    def table(self) -> dict[str, Any]:
        """Return the truss as nested lists with the keys of ``[mesh]``; for a large truss, only its digest."""
        if self.points is None or self.n_nodes + self.n_bars > INLINE:
            return {"digest": self.digest}
        tables = {kind: getattr(self, kind) for kind in _NAMED}
        lists = {kind: {name: rows.tolist() for name, rows in table.items()} for kind, table in tables.items() if table}
        return {"points": self.points.tolist(), "bars": self.bars.tolist(), **lists}

    def grid(self) -> pyvista.UnstructuredGrid:
        """Return a pyvista grid of lines with the bar fields; groups are ``group:NAME``, 1 for members."""
        from ...formats.vtk import grid_of

        self._require("drawn")
        return grid_of(self.to_mesh())

    def _require(self, what: str) -> None:
        if self.points is None:
            raise InputError(f"Truss: only rank 0 has the arrays of this truss, which cannot be {what} elsewhere")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Truss) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    def __repr__(self) -> str:
        groups = [*(self.node_groups or ()), *(self.bar_groups or ())]
        named = f", groups {', '.join(groups)}" if groups else ""
        return f"<Truss of {self.n_nodes} nodes and {self.n_bars} bars{named}>"


def write_mesh(
    path: Path | str,
    points: ArrayLike,
    bars: ArrayLike,
    *,
    node_groups: Mapping[str, ArrayLike] | None = None,
    bar_groups: Mapping[str, ArrayLike] | None = None,
    bar_fields: Mapping[str, ArrayLike] | None = None,
    comm: MPI.Comm | None = None,
) -> Path:
    """Write nodes and bars to a file for ``mesh.file``; an earlier file of this name is replaced. Collective.

    Parameters
    ----------
    path : name of the file; its suffix selects the format (``docs/meshes.md``); ``.h5`` stores everything exactly
    points : (nodes, 3) positions [m]
    bars : (bars, 2) integers, the nodes at both ends of each bar, numbered from 0
    node_groups, bar_groups : numbers of the members, or a boolean mask, for each name
    bar_fields : (bars,) numbers for each name, such as areas [m2] for ``area_field`` of sections
    comm : communicator whose rank 0 writes its arrays; default: COMM_WORLD

    Returns
    -------
    The absolute path.

    Raises
    ------
    InputError
        On all ranks, for arrays of wrong shape or type; a mesh that cannot be simulated (coordinates that are not
        finite, bars of zero length, two bars between the same nodes, nodes without bars); a file that cannot be
        written.
    """
    from ...formats import writer_of

    def write(path: Path) -> Path:
        writer_of(path)
        named = {"node_groups": node_groups, "bar_groups": bar_groups, "bar_fields": bar_fields}
        return Truss(points, bars, **named, source=str(path)).write(path)

    return on_root(MPI.COMM_WORLD if comm is None else comm, write, Path(path).absolute())


def _kept(array: np.ndarray) -> np.ndarray:
    kept = array.copy()
    kept.flags.writeable = False
    return kept


def _digest(slab: MeshSlab) -> str:
    """Return a digest of all arrays with their names."""
    found = hashlib.sha256()
    arrays = [(array.shape, array) for array in (slab.points, slab.bars)]
    for kind, named in (("node", slab.node_groups), ("bar", slab.bar_groups), ("field", slab.bar_fields)):
        arrays += [((kind, name, array.shape), array) for name, array in named.items()]
    for head, array in arrays:
        found.update(repr(head).encode())
        found.update(np.ascontiguousarray(array))
    return found.hexdigest()


class Parameters(StrictModel):
    """Keys of ``[mesh]`` with ``generator = "arrays"``; a :class:`Truss` takes their place."""

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
            for key in [key for key in ("points", "bars") if getattr(self, key) is None][:1]:
                raise ValueError(f"expected the keys points and bars; {key} is missing")
            try:
                named = {kind: getattr(self, kind) for kind in _NAMED}
                self.__dict__["truss"] = Truss(self.points, self.bars, **named)
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
        """Return the mesh as nested lists with these keys; see :meth:`Truss.table`."""
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
    for rank in [rank for rank, (other, _) in enumerate(found) if other != found[0][0]][:1]:
        raise InputError(
            f"mesh: the arrays of rank {rank} differ from those of rank 0: give all ranks the same arrays, or rank 0 "
            "alone, by Truss(..., comm=comm)"
        )
    if not found[0][1]:
        raise InputError(
            f"mesh: the arrays of this case (digest {str(digest)[:12]}...) are not in its text, as they are large: "
            "give the truss, as in Case.load(path, mesh=truss)"
        )
    with agreed(comm):
        if comm.rank == 0:
            check_fields("mesh", fields, truss.bar_fields)
    check_size(truss.n_nodes, "mesh")
    mesh = None
    if truss is not None and truss.points is not None:
        own = {name: truss.bar_fields[name] for name in fields}
        mesh = WholeMesh(truss.points, truss.bars, dict(truss.node_groups), dict(truss.bar_groups), own)
    if all(whole for _, whole in found):
        return mesh.slab("mesh").share(comm.rank, comm.size)
    return scattered(mesh if comm.rank == 0 else None, "mesh", comm)

"""A mesh that one rank has whole: what readers return and writers take, and its distribution to all ranks as slabs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from ..errors import InputError
from ..parallel.agreement import agreed
from .slab import MeshSlab, check_size, slab_range

__all__ = ["WholeMesh", "case_tables", "missing_field", "read_and_scatter", "scattered", "without_slashes"]


@dataclass
class WholeMesh:
    """A mesh that one rank has; numbers from 0."""

    points: np.ndarray
    """(n_nodes, 3) float64 [m]."""
    bars: np.ndarray
    """(n_bars, 2) int64."""
    node_groups: dict[str, np.ndarray] = field(default_factory=dict)
    bar_groups: dict[str, np.ndarray] = field(default_factory=dict)
    bar_fields: dict[str, np.ndarray] = field(default_factory=dict)
    """(n_bars,) float64; the field ``area`` has the areas of cross-sections [m2]."""
    tables: dict[str, dict[str, Any]] = field(default_factory=dict)
    """What a file has besides the mesh: ``material``, ``section``, ``support`` and ``load`` (by node group),
    ``gravity``, each with the keys of a case by name, and ``analysis``: ``static``, ``time`` and ``modes``."""
    warnings: list[str] = field(default_factory=list)
    known_fields: list[str] | None = None
    """Names of all fields of a file; None: those in ``bar_fields``."""
    source: str = "mesh"
    """The file, for messages."""


def case_tables(tables: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Return tables of a mesh in the form that a case takes: lists of supports and loads, and their node sets."""
    found: dict[str, Any] = {name: table for name, table in tables.items() if name in ("material", "section")}
    for name in ("support", "load"):
        if tables.get(name):
            found[name] = list(tables[name].values())
            found.setdefault("node_set", {}).update({own: {"group": own} for own in tables[name]})
    for table in tables.get("gravity", {}).values():
        found["gravity"] = table
    return found


def without_slashes(named: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return groups or fields with names that HDF5 and trusses can have: an underscore for each slash."""
    found: dict[str, np.ndarray] = {}
    for name, values in named.items():
        own = name.replace("/", "_")
        while own in found or (own != name and own in named):
            own += "_"
        found[own] = values
    return found


def missing_field(path: Path | str, fields: Mapping[str, str], known: Iterable[str]) -> str | None:
    """Return the message about the first of ``fields`` that is not among the ``known`` cell fields of a file."""
    known = sorted(known)
    for name, key in fields.items():
        if name not in known:
            there = f"; it has {', '.join(known)}" if known else ""
            return f"{key} = {name!r}: {path} has no cell field of this name with one number for each bar{there}"
    return None


def read_and_scatter(read: Callable[[Path], WholeMesh], path: Path, comm: MPI.Comm) -> MeshSlab:
    """Read a file on rank 0 and send every rank its slab. Collective.

    Raises
    ------
    InputError
        On all ranks, as raised by ``read`` on rank 0, and if the mesh does not fit in memory.
    """
    whole: WholeMesh | None = None
    with agreed(comm):
        if comm.rank == 0:
            try:
                whole = read(path)
            except MemoryError:
                raise InputError(f"{path}: the mesh does not fit in memory; write it as .h5 for many ranks") from None
    return scattered(whole, str(path), comm)


def scattered(whole: WholeMesh | None, source: str, comm: MPI.Comm) -> MeshSlab:
    """Send every rank its slab of the mesh that rank 0 has; None on the others. Collective."""
    head = None
    if whole is not None:
        names = [list(named) for named in (whole.node_groups, whole.bar_groups, whole.bar_fields)]
        head = (len(whole.points), len(whole.bars), *names, whole.warnings)
    n_nodes, n_bars, node_names, bar_names, field_names, warnings = comm.bcast(head)
    check_size(n_nodes, source)
    points = _scatter(comm, whole.points if whole else np.empty((0, 3)), n_nodes)
    bars = _scatter(comm, whole.bars if whole else np.empty((0, 2), np.int64), n_bars)
    return MeshSlab(
        n_nodes=n_nodes,
        n_bars=n_bars,
        first_node=slab_range(n_nodes, comm.rank, comm.size)[0],
        points=points,
        first_bar=slab_range(n_bars, comm.rank, comm.size)[0],
        bars=bars,
        node_groups={name: _members(comm, whole and whole.node_groups[name], n_nodes) for name in node_names},
        bar_groups={name: _members(comm, whole and whole.bar_groups[name], n_bars) for name in bar_names},
        bar_fields={
            name: _scatter(comm, whole.bar_fields[name][:, None] if whole else np.empty((0, 1)), n_bars)[:, 0]
            for name in field_names
        },
        source=source,
        warnings=warnings,
    )


def _scatter(comm: MPI.Comm, rows: np.ndarray, n: int) -> np.ndarray:
    """Scatter the rows of rank 0 in the ranges of slab_range."""
    if comm.size == 1:
        return rows
    ranges = [slab_range(n, rank, comm.size) for rank in range(comm.size)]
    mine = np.empty((ranges[comm.rank][1] - ranges[comm.rank][0], rows.shape[1]), rows.dtype)
    row = MPI.BYTE.Create_contiguous(rows.dtype.itemsize * rows.shape[1]).Commit()
    try:
        sizes = ([last - first for first, last in ranges], [first for first, _ in ranges])
        comm.Scatterv([np.ascontiguousarray(rows), sizes, row], [mine, len(mine), row])
    finally:
        row.Free()
    return mine


def _members(comm: MPI.Comm, members: np.ndarray | None, n: int) -> np.ndarray:
    """Return the members of rank 0's group within this rank's range of ``n``, ascending and unique."""
    parts = None
    if members is not None:
        members = np.unique(members).astype(np.int64)
        firsts = [slab_range(n, rank, comm.size)[0] for rank in range(1, comm.size)]
        parts = np.split(members, np.searchsorted(members, firsts))
    return comm.scatter(parts)

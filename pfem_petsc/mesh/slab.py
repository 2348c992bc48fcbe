"""The part of a mesh on a rank before its distribution: contiguous ranges of nodes and bars."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from mpi4py import MPI

from ..errors import InputError
from ..files import memory_of_machine

__all__ = [
    "MeshSlab",
    "check_length",
    "check_memory",
    "check_size",
    "index_type",
    "slab_of",
    "slab_of_whole",
    "slab_range",
]

_PER_NODE, _PER_BAR = 200.0, 24.0
"""Least memory of a model [B]: positions, velocities, accelerations, forces of nodes; ends and rest lengths of bars."""


@dataclass
class MeshSlab:
    """One rank's contiguous ranges of the nodes and bars of a mesh, in mesh numbering (from 0).

    Ranges are those of :func:`slab_range`. ``structured`` is True for a generated mesh, which is valid by construction
    and needs neither checks nor the graph partitioner.
    """

    n_nodes: int
    """Nodes of the whole mesh."""
    n_bars: int
    """Bars of the whole mesh."""
    first_node: int
    points: np.ndarray
    """(nodes here, 3) float64 [m]."""
    first_bar: int
    bars: np.ndarray
    """(bars here, 2) int32 or int64: the ends as mesh numbers of nodes, anywhere in the mesh."""
    node_groups: dict[str, np.ndarray] = field(default_factory=dict)
    """Members (int64 mesh numbers) within this rank's nodes; the same names in the same order on all ranks."""
    bar_groups: dict[str, np.ndarray] = field(default_factory=dict)
    """Members (int64 mesh numbers) within this rank's bars; the same names in the same order on all ranks."""
    bar_fields: dict[str, np.ndarray] = field(default_factory=dict)
    """Values of this rank's bars, (bars here,) float64, of the cell fields that were asked for; the same names on all
    ranks."""
    source: str = "mesh"
    """The file or the generator, for messages."""
    structured: bool = False
    warnings: list[str] = field(default_factory=list)
    """Warnings of the reader and the checks, for the log."""
    volume: float | None = None
    """What a lattice fills [m3], for its relative density."""


def slab_range(n: int, rank: int, size: int) -> tuple[int, int]:
    """Return the range (first, end) of a rank if ``n`` items are distributed evenly and in order."""
    share, rest = divmod(n, size)
    first = rank * share + min(rank, rest)
    return first, first + share + (rank < rest)


def slab_of(numbers: np.ndarray, n: int, size: int) -> np.ndarray:
    """Return the rank (int64) whose :func:`slab_range` of ``n`` contains each number."""
    share, rest = divmod(n, size)
    split = rest * (share + 1)
    numbers = np.asarray(numbers, dtype=np.int64)
    return np.where(numbers < split, numbers // (share + 1), rest + (numbers - split) // max(share, 1))


def index_type(n: int) -> type[np.signedinteger]:
    """Return the smaller of int32 and int64 that can number ``n`` items."""
    return np.int32 if n <= np.iinfo(np.int32).max else np.int64


def check_size(n_nodes: int, where: str, n_bars: int = 0) -> None:
    """Refuse a mesh that cannot be run, before anything is allocated for it. Collective (PETSc starts).

    Raises
    ------
    InputError
        If three unknowns per node do not fit in PETSc's integers, or the arrays of the model in the memory.
    """
    from petsc4py import PETSc

    limit = int(np.iinfo(PETSc.IntType).max)
    if 3 * n_nodes > limit:
        raise InputError(
            f"{where}: {n_nodes:,} nodes have {3 * n_nodes:,} unknowns, more than this PETSc can number ({limit:,}): "
            "make the mesh smaller, or use a PETSc configured with 64-bit indices"
        )
    check_memory(n_nodes, where, n_bars)


def check_memory(n_nodes: int, where: str, n_bars: int = 0) -> None:
    """Refuse a mesh whose model the memory does not hold, even if each rank has a machine of its own; on any rank.

    Raises
    ------
    InputError
    """
    needed, memory = _PER_NODE * n_nodes + _PER_BAR * n_bars, memory_of_machine() * MPI.COMM_WORLD.size
    if needed > memory:
        bars = f" and {n_bars:,} bars" if n_bars else ""
        raise InputError(
            f"{where}: {n_nodes:,} nodes{bars} need {needed / 1e9:,.0f} GB of memory or more, and there are "
            f"{memory / 1e9:,.0f} GB: make the mesh smaller, or use more machines"
        )


def check_length(value: float, where: str) -> None:
    """Refuse lengths [m] whose square overflows or underflows.

    Raises
    ------
    InputError
        If the length is outside 1e-150 to 1e150.
    """
    if not 1e-150 < value < 1e150:
        raise InputError(
            f"{where}: length {value:g} m overflows double precision when squared; choose one between 1e-150 and 1e150"
        )


def slab_of_whole(
    points: np.ndarray,
    bars: np.ndarray,
    node_groups: Mapping[str, np.ndarray],
    bar_groups: Mapping[str, np.ndarray],
    source: str,
    rank: int,
    size: int,
) -> MeshSlab:
    """A rank's part of a mesh that every rank has whole: points (nodes, 3) [m], bars (bars, 2), members."""
    first_node, last_node = slab_range(len(points), rank, size)
    first_bar, last_bar = slab_range(len(bars), rank, size)

    def within(groups: Mapping[str, np.ndarray], first: int, last: int) -> dict[str, np.ndarray]:
        found = {name: np.asarray(members, dtype=np.int64) for name, members in groups.items()}
        return {name: members[(members >= first) & (members < last)] for name, members in found.items()}

    return MeshSlab(
        n_nodes=len(points),
        n_bars=len(bars),
        first_node=first_node,
        points=np.array(points[first_node:last_node], dtype=np.float64).reshape(-1, 3),
        first_bar=first_bar,
        bars=np.asarray(bars[first_bar:last_bar], dtype=index_type(len(points))).reshape(-1, 2),
        node_groups=within(node_groups, first_node, last_node),
        bar_groups=within(bar_groups, first_bar, last_bar),
        source=source,
        structured=True,
    )

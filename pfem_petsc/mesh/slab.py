"""A slab of a mesh: the contiguous range of nodes and bars that a rank has before distribution."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..errors import InputError
from ..files import memory_of_machine
from .exchange import Router

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


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
    """Values of this rank's bars, (bars here,) float64, of the fields that were asked for; the same names on all
    ranks."""
    node_fields: dict[str, np.ndarray] = field(default_factory=dict)
    """Values of this rank's nodes, in the same way; a field that was asked for is one of bars, of nodes or of both."""
    source: str = "mesh"
    """The file or the generator, for messages."""
    structured: bool = False
    undisturbed: np.ndarray | None = None
    """(nodes here, 3) [m]: where the nodes of a disturbed lattice would be without, in whose order they are kept; None
    on all ranks: the points."""
    warnings: list[str] = field(default_factory=list)
    """Warnings of the reader and the checks, for the log."""
    volume: float | None = None
    """What a lattice fills [m3], for its relative density."""
    filled: float | None = None
    """Of a lattice in a surface: the volume of the cells that its struts are of [m3], for comparison."""

    def share(self, rank: int, size: int) -> MeshSlab:
        """Return a rank's part of a slab that has the whole mesh."""
        if size == 1:
            return self
        first_node, last_node = slab_range(self.n_nodes, rank, size)
        first_bar, last_bar = slab_range(self.n_bars, rank, size)
        nodes, bars = slice(first_node, last_node), slice(first_bar, last_bar)

        def within(groups: Mapping[str, np.ndarray], first: int, last: int) -> dict[str, np.ndarray]:
            return {name: members[(members >= first) & (members < last)] for name, members in groups.items()}

        return replace(
            self,
            first_node=first_node,
            points=self.points[nodes].copy(),
            first_bar=first_bar,
            bars=self.bars[bars].copy(),
            node_groups=within(self.node_groups, first_node, last_node),
            bar_groups=within(self.bar_groups, first_bar, last_bar),
            bar_fields={name: values[bars].copy() for name, values in self.bar_fields.items()},
            node_fields={name: values[nodes].copy() for name, values in self.node_fields.items()},
        )


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
    groups = [
        {name: np.asarray(members, np.int64) for name, members in each.items()} for each in (node_groups, bar_groups)
    ]
    ends = np.asarray(bars, index_type(len(points)))
    whole = MeshSlab(len(points), len(bars), 0, np.asarray(points, float), 0, ends, *groups, source=source)
    whole.structured = True
    return whole.share(rank, size)


def with_bars(
    slab: MeshSlab,
    comm: MPI.Comm,
    ends: np.ndarray,
    sections: np.ndarray,
    new_sections: np.ndarray,
    field: tuple[str, np.ndarray],
) -> tuple[MeshSlab, np.ndarray]:
    """Return a slab with further bars after those of the mesh, and the section of each of its bars. Collective.

    Parameters
    ----------
    ends : (m, 2) mesh numbers of the nodes of the new bars, the same on all ranks
    sections : (bars here,) of the bars of the slab; new_sections : (m,) of the new ones
    field : name and values (m,) of a further field of the bars; it is zero for the others
    """
    total = slab.n_bars + len(ends)
    numbers = slab.first_bar + np.arange(len(slab.bars), dtype=np.int64)
    # contiguous ranges arrive in order, and the new bars are the last ones
    router = Router(comm, slab_of(numbers, total, comm.size))
    first, last = slab_range(total, comm.rank, comm.size)
    own = slice(max(first - slab.n_bars, 0), max(last - slab.n_bars, 0))
    name, values = field
    fields = {key: np.concatenate([router.send(old), np.zeros(len(ends[own]))]) for key, old in slab.bar_fields.items()}
    fields[name] = np.concatenate([np.zeros(router.n_received), values[own]])
    groups = {
        key: Router(comm, slab_of(members, total, comm.size)).send(members) for key, members in slab.bar_groups.items()
    }
    made = replace(
        slab,
        n_bars=total,
        first_bar=first,
        bars=np.concatenate([router.send(slab.bars), ends[own].astype(slab.bars.dtype)]),
        bar_groups=groups,
        bar_fields=fields,
    )
    return made, np.concatenate([router.send(sections), new_sections[own]]).astype(np.int32)


def slab_from_arrays(
    source: str,
    points: ArrayLike,
    bars: ArrayLike,
    node_groups: Mapping[str, ArrayLike],
    bar_groups: Mapping[str, ArrayLike],
    bar_fields: Mapping[str, ArrayLike],
) -> MeshSlab:
    """Return the slab of one rank that has the whole mesh; ``source`` names it in messages.

    Raises
    ------
    InputError
        For arrays of wrong shape or type, and members of groups that do not exist.
    """
    nodes, ends = _array(source, "points", points, 3, "fiu"), _array(source, "bars", bars, 2, "iu")
    return MeshSlab(
        n_nodes=len(nodes),
        n_bars=len(ends),
        first_node=0,
        points=nodes.astype(np.float64),
        first_bar=0,
        bars=ends.astype(np.int64),
        node_groups={name: _members(source, "node_groups", name, m, len(nodes)) for name, m in node_groups.items()},
        bar_groups={name: _members(source, "bar_groups", name, m, len(ends)) for name, m in bar_groups.items()},
        bar_fields={name: _field(source, name, values, len(ends)) for name, values in bar_fields.items()},
        source=source,
    )


def _array(where: str, name: str, values: ArrayLike, width: int, kinds: str) -> np.ndarray:
    try:
        array = np.asarray(values)
    except ValueError:
        array = np.empty(0, object)  # rows of different lengths
    if array.ndim != 2 or array.shape[1] != width or array.dtype.kind not in kinds:
        what = "positions [m]" if name == "points" else "integers, the nodes at both ends"
        raise InputError(
            f"{where}: {name} has shape {array.shape} and type {array.dtype}; expected ({name}, {width}) {what}"
        )
    return array


def _field(source: str, name: str, values: ArrayLike, n: int) -> np.ndarray:
    """Return the values of a cell field."""
    where, array = f"{source}: bar_fields[{name!r}]", np.asarray(values)
    _check_name(where, name)
    if array.shape != (n,) or array.dtype.kind not in "fiu":
        raise InputError(f"{where} has shape {array.shape} and type {array.dtype}; expected ({n},) numbers")
    return array.astype(np.float64)


def _check_name(where: str, name: str) -> None:
    if not isinstance(name, str) or not name or "/" in name or name == ".":
        raise InputError(f"{where}: expected a name without slashes")


def _members(source: str, kind: str, name: str, values: ArrayLike, n: int) -> np.ndarray:
    """Return the numbers of the members of a group, ascending."""
    where, array = f"{source}: {kind}[{name!r}]", np.asarray(values)
    _check_name(where, name)
    if array.dtype.kind == "b" and array.shape == (n,):
        return np.flatnonzero(array)
    array = array if array.size else np.empty(0, np.int64)
    if array.ndim != 1 or array.dtype.kind not in "iu":
        raise InputError(
            f"{where} has shape {array.shape} and type {array.dtype}; expected a list of numbers from 0, or ({n},) "
            "booleans"
        )
    for wrong in array[(array < 0) | (array >= n)][:1]:
        raise InputError(f"{where} has member {wrong}, but numbers go from 0 to {n - 1}")
    return np.unique(array.astype(np.int64))

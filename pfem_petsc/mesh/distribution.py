"""A mesh distributed over ranks: owned nodes, ghosts, bars connected to owned nodes, updates of ghosts, node sets."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..errors import InputError
from ..parallel.natural import NaturalOrder
from ..registry import nearest
from .exchange import GhostExchange, Messages, Router
from .ordering import bar_order, bounding_box, partition, sweep_axes, sweep_keys
from .slab import MeshSlab, index_type, slab_of

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..case.tables import NodeSet

__all__ = ["Block", "DistributedMesh", "bars_of_group", "distribute", "group_hint", "resolve_node_sets"]

_PIECE = 1 << 18  # number of bars whose ends are looked up at a time, to keep temporary arrays small


@dataclass(frozen=True)
class Block:
    """The local bars of one section: ``[start, counted)`` are counted here, ``[counted, stop)`` only evaluated.

    A bar is counted on the rank that owns its first end, so that sums over all ranks include each bar once.
    """

    section: int
    start: int
    counted: int
    stop: int


@dataclass(eq=False)
class DistributedMesh:
    """One rank's part of a distributed mesh; created by :func:`distribute`.

    Local nodes are the owned ones, in PETSc order, then the ghosts: the other ends of bars that touch an owned node,
    sorted by owner and PETSc number.
    """

    comm: MPI.Comm
    n_nodes: int
    """Nodes of the whole mesh."""
    n_bars: int
    """Bars of the whole mesh."""
    partitioner: str
    """The partitioner, for the log."""
    n_owned: int
    n_local: int
    first_node: int
    """First PETSc number owned: the PETSc number of an owned node is this plus its local index."""
    node_ids: np.ndarray
    """(n_local,) int64: mesh numbers."""
    ghost_numbers: np.ndarray
    """(n_ghost,) int64: PETSc numbers of the ghosts."""
    points: np.ndarray
    """(n_local, 3) float64 [m]: reference positions."""
    node_groups: dict[str, np.ndarray]
    """int32 local indices of owned members, ascending."""
    bars: np.ndarray
    """(b, 2) int32: local ends, in the order of the mesh."""
    bar_ids: np.ndarray
    """(b,) mesh numbers: int64, or the smallest sufficient integer type."""
    blocks: list[Block]
    """By section, ascending; only sections with local bars."""
    bar_groups: dict[str, np.ndarray]
    """int32 local bar indices, ascending."""
    bar_fields: dict[str, np.ndarray]
    """(b,) float64: values of local bars."""
    _exchange: GhostExchange
    n_connectors: int = 0
    """Of the bars the last ones are springs and dashpots."""
    volume: float | None = None
    """What a lattice fills [m3]; None for other meshes."""
    filled: float | None = None
    """Volume of the cells whose struts are left in a surface [m3]."""

    @cached_property
    def counted(self) -> slice | np.ndarray:
        """Local bars that are counted on this rank, as an index into arrays of local bars."""
        if len(self.blocks) == 1:
            return slice(self.blocks[0].start, self.blocks[0].counted)
        parts = [np.arange(block.start, block.counted) for block in self.blocks]
        return np.concatenate(parts) if parts else np.empty(0, dtype=np.int64)

    @cached_property
    def node_order(self) -> NaturalOrder:
        """Maps between owned nodes and slabs in mesh numbering. Collective at first use."""
        return NaturalOrder(self.comm, self.node_ids[: self.n_owned], self.n_nodes)

    @cached_property
    def bar_order(self) -> NaturalOrder:
        """Maps between counted bars and slabs in mesh numbering. Collective at first use."""
        return NaturalOrder(self.comm, self.bar_ids[self.counted], self.n_bars)

    @property
    def n_neighbours(self) -> int:
        """Number of ranks with which this rank exchanges ghosts."""
        return self._exchange.n_neighbours

    def extremes(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the smallest and largest coordinates (3,) of all nodes [m]. Collective."""
        return bounding_box(self.points[: self.n_owned], self.comm)

    def update_ghosts(self, array: np.ndarray) -> None:
        """Fill the ghost rows of ``array`` (n_local, k) float64, C-contiguous, with the owners' values. Collective."""
        self._exchange.update(array)

    def with_ghosts(self, nodes: np.ndarray, matrices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the place (local,) int32 of each node among those with matrices, ghosts included, -1 for none, and
        these matrices (k, 3, 3), from those (m, 3, 3) of owned nodes (m,), ascending. Collective."""
        shared = np.zeros((self.n_local, 10))
        shared[nodes, 0] = 1.0
        shared[nodes, 1:] = matrices.reshape(-1, 9)
        self.update_ghosts(shared)
        every = np.flatnonzero(shared[:, 0])
        place = np.full(self.n_local, -1, dtype=np.int32)
        place[every] = np.arange(len(every), dtype=np.int32)
        return place, np.ascontiguousarray(shared[every, 1:]).reshape(-1, 3, 3)

    def messages(self) -> Messages:
        """Return the messages that update ghosts of positions, for compiled loops."""
        return self._exchange.messages()

    def close(self) -> None:
        """Free the message requests (optional at the end of a program)."""
        self._exchange.close()


def distribute(slab: MeshSlab, bar_section: np.ndarray, comm: MPI.Comm, keep: bool = True) -> DistributedMesh:
    """Distribute a mesh over the ranks. Collective; no rank ever has the whole mesh.

    Parameters
    ----------
    slab : MeshSlab
        This rank's contiguous part, not needed afterwards.
    bar_section : (bars of the slab,) int32
        Section of each bar.
    comm : MPI.Comm
    keep : bool
        False: the slab loses its points and bars on the way, which saves memory.

    Returns
    -------
    DistributedMesh
        Reproducible for the same mesh and number of ranks.
    """
    owners, partitioner = partition(slab, comm)
    # nodes are numbered on their owners
    to_owner = Router(comm, owners)
    ids = to_owner.send(np.arange(slab.first_node, slab.first_node + len(owners)))
    own_points = to_owner.send(slab.points)
    places = own_points if slab.undisturbed is None else to_owner.send(slab.undisturbed)
    if not keep:
        slab.points, slab.undisturbed = slab.points[:0].copy(), None
    order = np.lexsort((ids, sweep_keys(places, sweep_axes(*bounding_box(places, comm)))))
    del places
    n_owned = len(ids)
    starts = np.concatenate([[0], np.cumsum(comm.allgather(n_owned))]).astype(np.int64)
    first, last = starts[comm.rank], starts[comm.rank + 1]
    numbers = np.empty(n_owned, np.int64)
    numbers[order] = np.arange(first, last)
    # The directory has the PETSc numbers (and with `starts` the owners) of the slab's nodes on the rank of the slab.
    directory = to_owner.reply(numbers)
    del to_owner, numbers

    # bars go to the owners of their ends
    bars, *of_bars = _fetch_bars(slab, np.asarray(bar_section, dtype=np.int32), directory, starts, comm, keep)
    outside = (bars < first) | (bars >= last)
    ghosts = np.unique(bars[outside]).astype(np.int64)
    ends = (bars - first).astype(np.int32)
    ends[outside] = n_owned + np.searchsorted(ghosts, bars[outside])
    del bars, outside

    n_local, exchange = n_owned + len(ghosts), GhostExchange(comm, starts, ghosts)
    # Mesh numbers are far below 2^53, so they are exact as floating-point numbers.
    points, travelling = np.empty((n_local, 3)), np.empty((n_local, 1))
    points[:n_owned], travelling[:n_owned, 0] = own_points[order], ids[order]
    exchange.update(points)
    exchange.update(travelling)
    node_groups = {}
    for name, members in slab.node_groups.items():
        member_numbers = directory[members - slab.first_node]
        arrived = Router(comm, _owner(member_numbers, starts)).send(member_numbers)
        node_groups[name] = np.sort(arrived - first).astype(np.int32)
    bars, bar_ids, blocks, bar_groups, bar_fields = _arranged(ends, *of_bars, n_owned, n_local)
    return DistributedMesh(
        comm=comm,
        n_nodes=slab.n_nodes,
        n_bars=slab.n_bars,
        partitioner=partitioner,
        n_owned=n_owned,
        n_local=n_local,
        first_node=int(first),
        node_ids=travelling[:, 0].astype(np.int64),
        ghost_numbers=ghosts,
        points=points,
        node_groups=node_groups,
        bars=bars,
        bar_ids=bar_ids,
        blocks=blocks,
        bar_groups=bar_groups,
        bar_fields=bar_fields,
        _exchange=exchange,
        volume=slab.volume,
        filled=slab.filled,
    )


def _fetch_bars(
    slab: MeshSlab, section: np.ndarray, directory: np.ndarray, starts: np.ndarray, comm: MPI.Comm, keep: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray, dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return ends (PETSc numbers), mesh numbers, sections, group memberships and fields of bars connected to owned
    nodes."""
    numbers = np.empty(slab.bars.shape, index_type(slab.n_nodes))
    # all ranks take as many pieces as the one with most bars
    for start in range(0, -(-slab.n_bars // comm.size), _PIECE):
        wanted, place = np.unique(slab.bars[start : start + _PIECE], return_inverse=True)
        asking = Router(comm, slab_of(wanted, slab.n_nodes, comm.size))
        asked = asking.send(wanted.astype(np.int64)) - slab.first_node
        numbers[start : start + _PIECE] = asking.reply(directory[asked])[place.reshape(-1, 2)]

    if not keep:
        slab.bars = slab.bars[:0].copy()
    n_bars = len(numbers)
    owner = np.empty(numbers.shape, np.uint16 if comm.size <= np.iinfo(np.uint16).max else np.int32)
    for start in range(0, n_bars, _PIECE):
        owner[start : start + _PIECE] = _owner(numbers[start : start + _PIECE], starts)
    kind = index_type(n_bars)
    both = np.flatnonzero(owner[:, 0] != owner[:, 1]).astype(kind)
    rows = np.concatenate([np.arange(n_bars, dtype=kind), both])
    to_owners = Router(comm, np.concatenate([owner[:, 0], owner[both, 1]]), rows)
    del owner, both, rows
    numbers_here = np.arange(slab.first_bar, slab.first_bar + n_bars)
    groups = {name: to_owners.send(np.isin(numbers_here, members)) for name, members in slab.bar_groups.items()}
    fields = {name: to_owners.send(values) for name, values in slab.bar_fields.items()}
    ids = to_owners.send(np.arange(slab.first_bar, slab.first_bar + n_bars, dtype=index_type(slab.n_bars)))
    return to_owners.send(numbers), ids, to_owners.send(section), groups, fields


def _arranged(
    ends: np.ndarray,
    bar_ids: np.ndarray,
    section: np.ndarray,
    groups: dict[str, np.ndarray],
    fields: dict[str, np.ndarray],
    n_owned: int,
    n_local: int,
) -> tuple[np.ndarray, np.ndarray, list[Block], dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return bars, mesh numbers, blocks, groups and fields sorted by section, counted bars first, then for locality."""
    borrowed, kind = ends[:, 0] >= n_owned, None
    if borrowed.any() or (len(section) and section.min() != section.max()) or section[:1].any():
        kind = 2 * section + borrowed
    order = bar_order(ends, kind, n_local)
    counts = np.bincount(kind) if kind is not None else np.array([len(ends)])
    counts = np.append(counts, np.zeros(len(counts) % 2, counts.dtype)).reshape(-1, 2)
    blocks, start = [], 0
    for number, (counted, others) in enumerate(counts.tolist()):
        if counted + others:
            blocks.append(Block(number, start, start + counted, start + counted + others))
        start += counted + others
    members = {name: np.flatnonzero(mask[order]).astype(np.int32) for name, mask in groups.items()}
    return ends[order], bar_ids[order], blocks, members, {name: values[order] for name, values in fields.items()}


def _owner(numbers: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Return the rank that owns each PETSc number."""
    return np.searchsorted(starts, numbers, side="right") - 1


def resolve_node_sets(case: Case, mesh: DistributedMesh) -> dict[str, np.ndarray]:
    """Return the owned local indices (int64, ascending) of each node set. Collective.

    Raises
    ------
    InputError
        On all ranks, for a group that the mesh does not have, a node number out of range, or a set without nodes.
    """
    sets = {}
    for name, node_set in case.node_set.items():
        where = f"{case.source}: node_set.{name}"
        members = _members_of(case, where, node_set, mesh)
        if mesh.comm.allreduce(len(members)) == 0:
            raise InputError(f"{where}: no node of the mesh is in this set; correct the box or the group")
        sets[name] = members.astype(np.int64)
    return sets


def group_hint(case: Case, name: str, known: list[str], entity: str = "Point") -> str:
    """What follows the message about a group that the mesh lacks: the nearest known one, or how to make one."""
    if known:
        return nearest(name, known)
    example = f' (in Gmsh: Physical {entity}("{name}") = {{...}};)' if str(case.mesh.file).endswith(".msh") else ""
    return ("; the mesh has no groups" if entity == "Point" else "; the mesh has no bar groups") + example


def bars_of_group(case: Case, mesh: DistributedMesh, key: str, name: str) -> np.ndarray:
    """Return the local bars (k,) of a group, whose text is ``name``, that a key of the case names.

    Raises
    ------
    InputError
        If the mesh has no such group.
    """
    if name not in mesh.bar_groups:
        hint = group_hint(case, name, sorted(mesh.bar_groups), "Curve")
        raise InputError(f"{case.source}: {key} = {name!r}: no such group of bars{hint}")
    return mesh.bar_groups[name]


def _members_of(case: Case, where: str, node_set: NodeSet, mesh: DistributedMesh) -> np.ndarray:
    points, ids = mesh.points[: mesh.n_owned], mesh.node_ids[: mesh.n_owned]
    if node_set.nearest is not None:
        distance = np.linalg.norm(points - np.array(node_set.nearest), axis=1)
        shortest = float(distance.min(initial=np.inf))
        best = shortest, int(ids[distance == shortest].min(initial=mesh.n_nodes))
        _, winner = min(mesh.comm.allgather(best))
        return np.flatnonzero(ids == winner)
    if node_set.box is not None:
        low, high = map(np.array, node_set.box)
        return np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))
    if node_set.group is not None:
        if node_set.group in mesh.node_groups:
            return np.sort(mesh.node_groups[node_set.group])
        if node_set.group in mesh.bar_groups:
            ends = np.unique(mesh.bars[mesh.bar_groups[node_set.group]])
            return ends[ends < mesh.n_owned]
        hint = group_hint(case, node_set.group, [*sorted(mesh.node_groups), *sorted(mesh.bar_groups)])
        raise InputError(f"{where}.group = {node_set.group!r}: no such group in the mesh{hint}")
    if node_set.selection is not None:
        return np.sort(mesh.node_groups[str(node_set.selection)])
    if node_set.indices is not None:
        wanted = np.array(node_set.indices, dtype=np.int64)
        for node in wanted[(wanted < 0) | (wanted >= mesh.n_nodes)][:1]:
            raise InputError(f"{where}.indices: node {node} does not exist; the mesh has nodes 0 to {mesh.n_nodes - 1}")
        return np.flatnonzero(np.isin(ids, wanted))
    return np.arange(mesh.n_owned)

"""Distribution of contact pairs over ranks: a rank has the pairs of its own nodes, and those connected with them.

The tables of a case are matched among the ranks (:mod:`~pfem_petsc.contact.matching`), so that the owner of a second
node learns of its first one. Who has which pair then is as for all rows: :mod:`~pfem_petsc.contact.row_search`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..errors import InputError
from ..mesh.exchange import GhostExchange, Router
from ..mesh.slab import slab_of
from .matching import nearest_among_ranks
from .row_search import owner_starts, to_owners, with_groups

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..mesh.distribution import DistributedMesh

__all__ = ["PairNodes", "find_pairs"]

_TAG = 7500  # of the messages between partners, distinct from those of the mesh's ghosts
_TABLE, _SECOND, _SECOND_AT, _FIRST, _FIRST_AT = range(5)  # columns of pairs: mesh and PETSc numbers


@dataclass(frozen=True)
class PairNodes:
    """The pairs of this rank, sorted by table and then by the mesh number of the second node.

    Attributes
    ----------
    table : (p,) index of a pair's table
    numbers : (2, p) mesh numbers of the first and second ends
    where : (2, p) local index of an end that this rank owns, else -1 minus its row among those of other ranks
    owners : (p,) owner of the second end if this rank owns the first, else owner of the first
    partners : exchanges values at ends that other ranks own
    """

    table: np.ndarray
    numbers: np.ndarray
    where: np.ndarray
    owners: np.ndarray
    partners: GhostExchange


def find_pairs(case: Case, nodes: dict[str, np.ndarray], mesh: DistributedMesh) -> PairNodes:
    """Match the tables of a case. Collective.

    Raises
    ------
    InputError
        On all ranks, for sets of unequal size, a node paired with itself, or two nodes paired with the same node.
    """
    comm = mesh.comm
    starts = owner_starts(mesh)
    found = np.concatenate([_match(case, k, nodes, mesh) for k in range(len(case.contact_pair))])
    _refuse_itself(found, case.source, comm)
    # a second node is in one pair of a table: table and second node tell pairs apart
    ends = [_FIRST_AT, _SECOND_AT]
    pairs = with_groups(to_owners(found, ends, starts, comm), ends, starts, comm)
    first, last = starts[comm.rank], starts[comm.rank + 1]
    at = pairs[:, [_FIRST_AT, _SECOND_AT]].T
    mine = (at >= first) & (at < last)
    ghosts = np.unique(at[~mine])
    where = np.where(mine, at - first, -1 - np.searchsorted(ghosts, at))
    numbers = np.ascontiguousarray(pairs[:, [_FIRST, _SECOND]].T)
    owners = np.searchsorted(starts, at, side="right") - 1
    partners = GhostExchange(comm, starts, ghosts, _TAG)
    return PairNodes(pairs[:, _TABLE].copy(), numbers, where, np.where(mine[0], owners[1], owners[0]), partners)


def _match(case: Case, index: int, nodes: dict[str, np.ndarray], mesh: DistributedMesh) -> np.ndarray:
    """Return the pairs of a table (m, 5): each second node of this rank with the first node nearest to it."""
    pair, comm = case.contact_pair[index], mesh.comm
    key = f"{case.source}: contact_pair {pair.name!r}"
    normal = np.array(pair.direction) / np.linalg.norm(pair.direction)
    first, second = nodes[pair.first], nodes[pair.second]
    counts = np.array([len(first), len(second)])
    comm.Allreduce(MPI.IN_PLACE, counts)
    if counts[0] != counts[1]:
        raise InputError(f"{key}: first has {counts[0]} nodes and second {counts[1]}: they cannot be paired")
    if counts[0] == 0:
        return np.empty((0, 5), dtype=np.int64)
    ends = [np.column_stack([mesh.node_ids[some], mesh.first_node + some.astype(np.int64)]) for some in (first, second)]
    nearest = nearest_among_ranks(comm, ends[0], mesh.points[first], mesh.points[second], normal)
    met = np.sort(Router(comm, slab_of(nearest[:, 0], mesh.n_nodes, comm.size)).send(nearest[:, 0]))
    if comm.allreduce(bool((np.diff(met) == 0).any()), op=MPI.LOR):
        raise InputError(f"{key}: two nodes of second are nearest to the same node of first, seen along the direction")
    return np.column_stack([np.full(len(second), index), ends[1], nearest])


def _refuse_itself(pairs: np.ndarray, source: str, comm: MPI.Comm) -> None:
    same = pairs[pairs[:, _FIRST] == pairs[:, _SECOND]]
    lowest = min(comm.allgather(tuple(same[:, [_TABLE, _FIRST]].min(axis=0).tolist()) if len(same) else (np.inf,)))
    if len(lowest) > 1:
        raise InputError(f"{source}: contact_pair: node {lowest[1]} is paired with itself")

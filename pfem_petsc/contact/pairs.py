"""Contact pairs: each second node with the nearest first node, seen along a direction, as a row with that direction."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..errors import InputError
from ..mesh.exchange import Router
from ..mesh.slab import slab_of
from .constraints.base import Constraint

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..case.tables import ContactPair
    from ..mesh.distribution import DistributedMesh


class PairRows(Constraint):
    """The pairs of a table: n . (x_2 - x_1) >= gap.

    Parameters
    ----------
    pair : ContactPair
    nodes : (r, 2) mesh numbers of the first and second nodes; the second ones are different from each other
    """

    fixed = True

    def __init__(self, pair: ContactPair, nodes: np.ndarray) -> None:
        self.nodes, self.data = nodes, np.empty((len(nodes), 0))
        self.ids = nodes[:, 1]
        self.normal = np.array(pair.direction) / np.linalg.norm(pair.direction)
        self.gap = float(pair.gap)

    def values(self, x: np.ndarray) -> np.ndarray:
        n, apart = self.normal, x[:, 1] - x[:, 0]
        return n[0] * apart[:, 0] + n[1] * apart[:, 1] + n[2] * apart[:, 2] - self.gap

    def gradients(self, x: np.ndarray) -> np.ndarray:
        return np.tile(np.stack([-self.normal, self.normal]), (len(x), 1, 1))


def find_pairs(case: Case, index: int, nodes: dict[str, np.ndarray], mesh: DistributedMesh) -> PairRows:
    """Match the nodes of a table of a case. Collective.

    ``nodes``: owned local indices of each node set.

    Raises
    ------
    InputError
        On all ranks, for sets of unequal size, a node paired with itself, or two nodes paired with the same node.
    """
    pair, comm = case.contact_pair[index], mesh.comm
    key = f"{case.source}: contact_pair {pair.name!r}"
    normal = np.array(pair.direction) / np.linalg.norm(pair.direction)
    first, second = nodes[pair.first], nodes[pair.second]
    counts = comm.allreduce(np.array([len(first), len(second)]))
    if counts[0] != counts[1]:
        raise InputError(f"{key}: first has {counts[0]} nodes and second {counts[1]}: they cannot be paired")
    numbers = mesh.node_ids[second].astype(np.int64)
    if counts[0] == 0:
        return PairRows(pair, np.empty((0, 2), dtype=np.int64))
    # the nodes of a set lie on a surface, few enough for each rank to have those of all
    known = np.concatenate(comm.allgather(mesh.node_ids[first].astype(np.int64)))
    points, order = np.concatenate(comm.allgather(mesh.points[first])), np.argsort(known)
    at = nearest_points(across(points[order], normal), across(mesh.points[second], normal))
    nearest = known[order[at]]
    met = np.sort(Router(comm, slab_of(nearest, mesh.n_nodes, comm.size)).send(nearest))
    if comm.allreduce(bool((np.diff(met) == 0).any()), op=MPI.LOR):
        raise InputError(f"{key}: two nodes of second are nearest to the same node of first, seen along the direction")
    lowest = comm.allreduce(int(nearest[nearest == numbers].min(initial=mesh.n_nodes)), op=MPI.MIN)
    if lowest < mesh.n_nodes:
        raise InputError(f"{case.source}: contact_pair: node {lowest} is paired with itself")
    return PairRows(pair, np.column_stack([nearest, numbers]))


def across(points: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return points (n, 3) minus their part along a unit vector, bitwise independent of their index in the array."""
    along = points[:, 0] * normal[0] + points[:, 1] * normal[1] + points[:, 2] * normal[2]
    return points - along[:, None] * normal


def nearest_points(points: np.ndarray, queries: np.ndarray) -> np.ndarray:
    """Return the indices (m,) of the points (n, 3) nearest to queries (m, 3), the first of several at bitwise the same
    distance; n > 0."""
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    distance, at = tree.query(queries, k=[1, 2])  # a second one that does not exist is at infinity
    radius, nearest = distance[:, 0] * (1.0 + 1e-9), at[:, 0]
    for k in np.flatnonzero(distance[:, 1] <= radius):
        equal = np.sort(tree.query_ball_point(queries[k], radius[k]))
        nearest[k] = equal[np.argmin(((points[equal] - queries[k]) ** 2).sum(axis=1))]
    return nearest

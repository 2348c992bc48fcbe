"""Nodes that start beyond walls: ``adjust = true`` moves them before the model is built; others are rejected."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError, SimulationFailure
from ..parallel.agreement import agreed
from ..tolerances import BEYOND, ON_BOUND, PROJECTED
from .contact import Contact

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..mesh.distribution import DistributedMesh

__all__ = ["adjust_start", "check_start"]


def adjust_start(case: Case, nodes: dict[str, np.ndarray], mesh: DistributedMesh) -> int:
    """Move nodes onto walls with ``adjust = true``; bars are unstressed in the new positions. Collective.

    Returns
    -------
    int
        Number of nodes moved on all ranks.

    Raises
    ------
    InputError
        On all ranks, for infeasible walls at a node, or a bar that loses its length.
    """
    # friction, restitution and ties play no role here
    plain = {"friction": 0.0, "static_friction": None, "restitution": 0.0, "tied": False}
    walls = [wall.model_copy(update=plain) for wall in case.wall if wall.adjust]
    if not walls:
        return 0
    owned = mesh.n_owned
    contact = Contact(case, nodes, mesh, np.zeros((owned, 3), dtype=bool), walls)
    points, way = mesh.points[:owned], np.zeros((owned, 3))
    moved = np.empty(0, dtype=np.int64)
    with agreed(mesh.comm):
        try:
            moved, *_ = contact.explicit(points, way, np.ones(owned), 0.0, PROJECTED * contact.size)
        except SimulationFailure as failure:
            raise InputError(f"{case.source}: wall.adjust: {failure}") from failure
    points += way
    mesh.update_ghosts(mesh.points)
    a, b = mesh.bars.T
    length = np.linalg.norm(mesh.points[b] - mesh.points[a], axis=1)
    with agreed(mesh.comm):
        if len(length) and length.min() <= BEYOND * contact.size:
            bar = int(np.argmin(length))
            ends = mesh.node_ids[[a[bar], b[bar]]]
            raise InputError(
                f"{case.source}: wall.adjust: bar {mesh.bar_ids[bar]} between nodes {ends[0]} and {ends[1]} has zero "
                "length once its nodes are on the wall; move the wall or the mesh"
            )
    return mesh.comm.allreduce(len(moved))


def check_start(contact: Contact, x: np.ndarray, length: float) -> None:
    """Check that no node starts beyond a wall by more than rounding of the model's size ``length`` [m]. Collective.

    Raises
    ------
    InputError
        On all ranks; names the wall, the deepest node and its depth.
    """
    if not contact.any:
        return
    comm = contact.mesh.comm
    gaps = contact.gaps(x, 0.0)
    for k, wall in enumerate(contact.walls):
        if wall.partial:  # no node starts beyond a wall that nodes can pass beside
            continue
        deepest, node, count = 0.0, -1, 0
        if len(gaps):
            at = int(np.argmin(gaps[:, k]))
            deepest, node = float(gaps[at, k]), int(contact.mesh.node_ids[at])
            count = int((gaps[:, k] < -ON_BOUND * length).sum())
        depth, node = min(comm.allgather((deepest, node)))
        count = comm.allreduce(count)
        if count:
            raise InputError(
                f"{contact.source}: wall {contact.names[k]!r}: node {node} starts {-depth:.6g} "
                f"m beyond the wall ({count} node{'s' if count > 1 else ''} in all); move the wall or the mesh, "
                "turn the normal to the allowed side, name the nodes that it applies to with 'node_set', or let "
                "'adjust = true' move the nodes"
            )

"""Nodes that start beyond walls with ``adjust = true`` are moved onto them before anything is built on their places."""

from __future__ import annotations

import numpy as np

from ..errors import InputError, SimulationFailure
from ..parallel.agreement import agreed
from ..tolerances import BEYOND, PROJECTED
from .contact import Contact

__all__ = ["adjust_start"]


def adjust_start(case, nodes: dict[str, np.ndarray], mesh) -> int:
    """Move nodes of the mesh onto the walls that ask for it; the bars are unstressed there. Collective.

    Returns
    -------
    int
        Number of nodes moved on all ranks.

    Raises
    ------
    InputError
        On all ranks: walls that leave a node no room, or a bar that loses its length.
    """
    # where nodes come from, and what they do there, is no matter yet
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
            moved, *_ = contact.explicit(points, way, np.ones(owned), 0.0, PROJECTED * contact.length)
        except SimulationFailure as failure:
            raise InputError(f"{case.source}: wall.adjust: {failure}") from failure
    points += way
    mesh.update_ghosts(mesh.points)
    a, b = mesh.bars.T
    length = np.linalg.norm(mesh.points[b] - mesh.points[a], axis=1)
    with agreed(mesh.comm):
        if len(length) and length.min() <= BEYOND * contact.length:
            bar = int(np.argmin(length))
            ends = mesh.node_ids[[a[bar], b[bar]]]
            raise InputError(
                f"{case.source}: wall.adjust: bar {mesh.bar_ids[bar]} between nodes {ends[0]} and {ends[1]} has no "
                "length left once its nodes are on the wall; move the wall or the mesh"
            )
    return mesh.comm.allreduce(len(moved))

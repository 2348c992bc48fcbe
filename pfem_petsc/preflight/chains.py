"""Chains of collinear bars, which result from mesh generators that subdivide the members of a truss."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .rigidity import model_directions

if TYPE_CHECKING:
    from ..stepping.model import Model

__all__ = ["chain_nodes", "chain_warning"]

_STRAIGHT = 1e-4  # angle between two bars that count as collinear [rad]


def chain_nodes(model: Model) -> tuple[int, int]:
    """Return the number of unsupported nodes with exactly two collinear bars, and the first of them. Collective.

    A straight rod is excluded: its nodes are intended, so a truss on one line has no such nodes.
    """
    mesh, owned = model.mesh, model.mesh.n_owned
    if len(model_directions(model)) < 2:
        return 0, mesh.n_nodes
    way = mesh.points[mesh.bars[:, 1]] - mesh.points[mesh.bars[:, 0]]
    way /= np.linalg.norm(way, axis=1)[:, None]
    degree = np.bincount(mesh.bars.ravel(), minlength=mesh.n_local)[:owned]
    leaving = np.zeros((mesh.n_local, 3))
    np.add.at(leaving, mesh.bars[:, 0], way)
    np.subtract.at(leaving, mesh.bars[:, 1], way)
    found = (degree == 2) & (np.linalg.norm(leaving[:owned], axis=1) < _STRAIGHT)
    found &= ~model.supports.spans().any(axis=(1, 2))
    ids = mesh.node_ids[:owned][found]
    first = min(model.comm.allgather(min(ids.tolist(), default=mesh.n_nodes)))
    return model.comm.allreduce(len(ids)), first


def chain_warning(count: int, first: int) -> str:
    """Return the warning about nodes of :func:`chain_nodes`."""
    nodes = "1 node is" if count == 1 else f"{count} nodes are"
    return (
        f"{nodes} only connected to two collinear bars, and nothing supports them laterally; the first is node "
        f"{first}. "
        "Was the mesh subdivided? Each member of a truss is one bar: in Gmsh `Transfinite Curve {:} = 2;` (an intended "
        "chain of bars, such as a cable, needs tension to be stiff)"
    )

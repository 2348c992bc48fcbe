"""Named node sets of a case, as local indices of owned nodes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from ..registry import nearest

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..case.tables import NodeSet
    from .distribution import DistributedMesh

__all__ = ["bars_of_group", "group_hint", "resolve_node_sets"]


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
        members = _members(case, where, node_set, mesh)
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


def _members(case: Case, where: str, node_set: NodeSet, mesh: DistributedMesh) -> np.ndarray:
    points = mesh.points[: mesh.n_owned]
    ids = mesh.node_ids[: mesh.n_owned]
    if node_set.nearest is not None:
        distance = np.linalg.norm(points - np.array(node_set.nearest), axis=1)
        best = (np.inf, -1)
        if len(distance):
            shortest = distance.min()
            best = (float(shortest), int(ids[distance == shortest].min()))
        winner = min(entry for entry in mesh.comm.allgather(best) if entry[1] >= 0)
        return np.flatnonzero(ids == winner[1])
    if node_set.box is not None:
        low, high = np.array(node_set.box[0]), np.array(node_set.box[1])
        return np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))
    if node_set.group is not None:
        groups = sorted(mesh.node_groups)
        if node_set.group in mesh.node_groups:
            return np.sort(mesh.node_groups[node_set.group])
        bars = mesh.bar_groups.get(node_set.group)
        if bars is not None:
            ends = np.unique(mesh.bars[bars])
            return ends[ends < mesh.n_owned]
        known = groups + sorted(mesh.bar_groups)
        hint = group_hint(case, node_set.group, known)
        raise InputError(f"{where}.group = {node_set.group!r}: no such group in the mesh{hint}")
    if node_set.selection is not None:
        return np.sort(mesh.node_groups[str(node_set.selection)])
    if node_set.indices is not None:
        wanted = np.array(node_set.indices, dtype=np.int64)
        outside = wanted[(wanted < 0) | (wanted >= mesh.n_nodes)]
        if len(outside):
            raise InputError(
                f"{where}.indices: node {outside[0]} does not exist; the mesh has nodes 0 to {mesh.n_nodes - 1}"
            )
        return np.flatnonzero(np.isin(ids, wanted))
    return np.arange(mesh.n_owned)

"""Search for nodes near walls: one compiled pass over all nodes for all flat walls."""

from __future__ import annotations

from ..mechanics.compiled import kernel

__all__ = ["near_planes"]


@kernel
def near_planes(x, normals, offsets, all_nodes, members, reach, near):
    """Mark nodes within reach of a plane.

    Parameters
    ----------
    x : (n, 3) positions [m]
    normals : (w, 3); offsets : (w,) [m]: planes n . x = d
    all_nodes : (w,) bool, whether a plane applies to all nodes
    members : (n, w) bool, nodes to which a plane applies otherwise
    reach : (n,) or (1,) distance below which a node counts as near [m]
    near : (n,) bool, updated

    Returns
    -------
    int
        Number of nodes marked here.
    """
    count = 0
    per_node = len(reach) > 1
    for i in range(len(x)):
        limit = reach[i] if per_node else reach[0]
        for k in range(len(offsets)):
            gap = normals[k, 0] * x[i, 0] + normals[k, 1] * x[i, 1] + normals[k, 2] * x[i, 2] - offsets[k]
            if gap < limit and (all_nodes[k] or members[i, k]):
                near[i] = True
                count += 1
                break
    return count

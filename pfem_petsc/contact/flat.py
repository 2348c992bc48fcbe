"""Explicit contact with flat walls only: search, projection, forces and their sums in one compiled pass."""

from __future__ import annotations

import math

import numpy as np

from ..mechanics.compiled import borrowing, kernel
from ..mesh.ordering import NODE_BLOCK
from .projection import project

__all__ = ["find_beyond", "press_nodes", "press_planes"]


@borrowing
def find_beyond(first, free, normals, offsets, all_nodes, members, found):
    """Write the nodes, from node ``first`` on, whose positions ``free`` (3 m,) lie beyond a plane to ``found``; return
    their number. Other arguments: see :func:`press_planes`.
    """
    n = len(free) // 3
    beyond = 0
    for k in range(len(offsets)):  # without branches
        nx, ny, nz, offset = normals[k, 0], normals[k, 1], normals[k, 2], offsets[k]
        for i in range(n):
            gap = -offset + nx * free[3 * i] + ny * free[3 * i + 1] + nz * free[3 * i + 2]
            beyond += 1 if gap < 0.0 else 0
    if beyond == 0:
        return 0
    m = 0
    for i in range(n):
        for k in range(len(offsets)):
            gap = -offsets[k]
            for c in range(3):
                gap += normals[k, c] * free[3 * i + c]
            if gap < 0.0 and (all_nodes[k] or members[first + i, k]):
                found[m] = first + i
                m += 1
                break
    return m


@kernel
def press_nodes(
    nodes, places, fixed, normals, offsets, all_nodes, members, tolerance, stiffness, force, contacts, moment
):
    """Project ``nodes`` (m,) at ``places`` (m, 3) [m], in place, and add the forces of the planes to their sums:
    ``force`` (w, 3) [N], number of ``contacts`` (w,) and ``moment`` about the origin (w, 3) [N m].

    ``stiffness`` (m,) force for a displacement of each of them [N/m]; other arguments: see :func:`press_planes`.
    Returns the index of the first infeasible node among them, or -1; their offsets (m, w), -inf where a plane does not
    apply; the total force (m, 3) [N]; and planes that they touch (m, w).
    """
    w, m = len(offsets), len(nodes)
    held = np.empty((m, 3), dtype=np.bool_)
    all_normals = np.empty((m, w, 3))
    all_offsets = np.empty((m, w))
    for j in range(m):
        i = nodes[j]
        for c in range(3):
            held[j, c] = fixed[i, c]
        for k in range(w):
            for c in range(3):
                all_normals[j, k, c] = normals[k, c]
            all_offsets[j, k] = offsets[k] if all_nodes[k] or members[i, k] else -math.inf
    multipliers = np.zeros((m, w))
    infeasible = project(places, held, all_normals, all_offsets, tolerance, multipliers)
    total = np.zeros((m, 3))
    touching = np.zeros((m, w), dtype=np.bool_)
    for j in range(m):
        x, y, z = places[j, 0], places[j, 1], places[j, 2]
        for k in range(w):
            strength = multipliers[j, k] * stiffness[j]
            if strength == 0.0:
                continue
            fx, fy, fz = strength * normals[k, 0], strength * normals[k, 1], strength * normals[k, 2]
            total[j, 0] += fx
            total[j, 1] += fy
            total[j, 2] += fz
            force[k, 0] += fx
            force[k, 1] += fy
            force[k, 2] += fz
            moment[k, 0] += y * fz - z * fy
            moment[k, 1] += z * fx - x * fz
            moment[k, 2] += x * fy - y * fx
            touching[j, k] = True
            contacts[k] += 1
    return infeasible, all_offsets, total, touching


@kernel
def press_planes(predictor, u, fixed, normals, offsets, all_nodes, members, tolerance, stiffness, room):
    """Project nodes that lie beyond planes onto them, and sum the forces of the planes.

    Parameters
    ----------
    predictor, u : (n, 3); the free positions are predictor + u [m]; ``u`` is corrected in place
    fixed : (n, 3) bool, components that supports prescribe
    normals, offsets : (w, 3), (w,) planes n . x >= d [m]
    all_nodes : (w,) bool, whether a plane applies to all nodes; members : (n, w) bool, to which nodes otherwise
    tolerance : [m]
    stiffness : (n,) force for a displacement of the node [N/m]
    room : (n,) int64, workspace

    Returns
    -------
    tuple
        Nodes (m,); index of the first infeasible node among them, or -1; their offsets (m, w), -inf where a plane does
        not apply; total force (m, 3) [N]; planes that they touch (m, w); positions (m, 3) [m]; and per plane the force
        (w, 3) [N], number of contacts (w,) and moment about the origin (w, 3) [N m].
    """
    n, w = len(u), len(offsets)
    free = np.empty(3 * NODE_BLOCK)
    m = 0
    for first in range(0, n, NODE_BLOCK):
        last = min(first + NODE_BLOCK, n)
        where, more = predictor[first:last].reshape(-1), u[first:last].reshape(-1)
        for j in range(len(where)):
            free[j] = where[j] + more[j]
        m += find_beyond(first, free[: len(where)], normals, offsets, all_nodes, members, room[m:])
    nodes = room[:m].copy()
    places, own = np.empty((m, 3)), np.empty(m)
    for j in range(m):
        own[j] = stiffness[nodes[j]]
        for c in range(3):
            places[j, c] = predictor[nodes[j], c] + u[nodes[j], c]
    start = places.copy()
    force, contacts, moment = np.zeros((w, 3)), np.zeros(w, dtype=np.int64), np.zeros((w, 3))
    infeasible, all_offsets, total, touching = press_nodes(
        nodes, places, fixed, normals, offsets, all_nodes, members, tolerance, own, force, contacts, moment
    )
    for j in range(m):
        for c in range(3):
            u[nodes[j], c] += places[j, c] - start[j, c]
    return nodes, infeasible, all_offsets, total, touching, places, force, contacts, moment

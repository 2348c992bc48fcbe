"""Explicit contact with flat walls only: search, projection, forces and their sums in one compiled pass."""

from __future__ import annotations

import math

import numpy as np

from ..mechanics.compiled import kernel
from .projection import project

__all__ = ["press_planes"]


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
    w = len(offsets)
    m = 0
    for i in range(len(u)):
        for k in range(w):
            gap = -offsets[k]
            for c in range(3):
                gap += normals[k, c] * (predictor[i, c] + u[i, c])
            if gap < 0.0 and (all_nodes[k] or members[i, k]):
                room[m] = i
                m += 1
                break
    nodes = room[:m].copy()
    places = np.empty((m, 3))
    held = np.empty((m, 3), dtype=np.bool_)
    all_normals = np.empty((m, w, 3))
    all_offsets = np.empty((m, w))
    for j in range(m):
        i = nodes[j]
        for c in range(3):
            places[j, c] = predictor[i, c] + u[i, c]
            held[j, c] = fixed[i, c]
        for k in range(w):
            for c in range(3):
                all_normals[j, k, c] = normals[k, c]
            all_offsets[j, k] = offsets[k] if all_nodes[k] or members[i, k] else -math.inf
    free = places.copy()
    multipliers = np.zeros((m, w))
    infeasible = project(places, held, all_normals, all_offsets, tolerance, multipliers)
    total = np.zeros((m, 3))
    touching = np.zeros((m, w), dtype=np.bool_)
    force = np.zeros((w, 3))
    contacts = np.zeros(w, dtype=np.int64)
    moment = np.zeros((w, 3))
    for j in range(m):
        i = nodes[j]
        x, y, z = places[j, 0], places[j, 1], places[j, 2]
        for c in range(3):
            u[i, c] += places[j, c] - free[j, c]
        for k in range(w):
            strength = multipliers[j, k] * stiffness[i]
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
    return nodes, infeasible, all_offsets, total, touching, places, force, contacts, moment

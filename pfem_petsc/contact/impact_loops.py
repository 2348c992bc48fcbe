"""Compiled loops over closing contacts at walls; see :mod:`pfem_petsc.contact.impact` for the formula."""

from __future__ import annotations

import numpy as np

from ..mechanics.compiled import kernel

__all__ = ["join_nodes", "plane_gaps", "stop_nodes", "unpressed"]


@kernel
def join_nodes(met, touched, present):
    """Return the union of two lists of nodes, the first one first; ``present`` (owned,) is workspace, all False."""
    nodes = np.empty(len(met) + len(touched), dtype=np.int64)
    count = 0
    for i in met:
        present[i] = True
        nodes[count] = i
        count += 1
    for i in touched:
        if not present[i]:
            nodes[count] = i
            count += 1
    for i in met:
        present[i] = False
    return nodes[:count].copy()


@kernel
def plane_gaps(nodes, x, normals, offsets):
    """Return normals (m, w, 3) and distances (m, w) [m] of nodes (m,) at x (owned, 3) from planes (w, 3), (w,)."""
    w = len(offsets)
    every = np.empty((len(nodes), w, 3))
    gaps = np.empty((len(nodes), w))
    for j in range(len(nodes)):
        i = nodes[j]
        for k in range(w):
            gap = -offsets[k]
            for c in range(3):
                gap += normals[k, c] * x[i, c]
                every[j, k, c] = normals[k, c]
            gaps[j, k] = gap
    return every, gaps


@kernel
def unpressed(nodes, v, a, contact, mass, damping, alpha, eta):
    """Return velocities and accelerations (m, 3) of nodes (m,) without the contact forces (owned, 3)."""
    free_v, free_a = np.empty((len(nodes), 3)), np.empty((len(nodes), 3))
    damped = len(damping) > 0
    for j in range(len(nodes)):
        i = nodes[j]
        k = alpha * mass[i] + (eta * damping[i] if damped else 0.0)
        for c in range(3):
            u = contact[i, c] / k
            free_v[j, c] = v[i, c] - eta * u
            free_a[j, c] = a[i, c] - alpha * u
    return free_v, free_a


@kernel
def stop_nodes(
    nodes, touching, closed, normals, gaps, v, a, rates, pulls, mass, fixed, restitution, counted, slack, speeds
):
    """Return the energy [J] that nodes (m,) lose when they close on walls, and the nodes that are on walls afterwards.

    Parameters
    ----------
    touching : (owned, w) bool, contacts in this step
    closed : (owned, w) bool, contacts that have closed and whose node has not left the wall; updated
    normals, gaps : (m, w, 3), (m, w) at the start of the step [m]
    v, a : (m, 3) there, without contact; rates, pulls : (w, 3) velocities and accelerations of the walls
    mass, fixed : (owned,), (owned, 3)
    restitution, counted : (w,); only counted walls contribute to the energy
    slack : distance at which a node has left [m]
    speeds : (m, w) output: approach velocities of closing contacts, else zero [m/s]
    """
    w = closed.shape[1]
    met = np.empty(len(nodes), dtype=np.int64)
    count = 0
    loss = 0.0
    basis = np.empty((3, 3))
    row = np.empty(3)
    before, after = np.empty(3), np.empty(3)
    for j in range(len(nodes)):
        i = nodes[j]
        fresh = False
        here = False
        for k in range(w):
            speeds[j, k] = 0.0
            if touching[i, k]:
                if not closed[i, k]:
                    closed[i, k] = True
                    speed, towards = 0.0, 0.0
                    for c in range(3):
                        speed += normals[j, k, c] * (v[j, c] - rates[k, c])
                        towards -= normals[j, k, c] * (a[j, c] - pulls[k, c])
                    if speed < 0.0:
                        square = speed * speed + 2.0 * towards * max(gaps[j, k], 0.0)
                        speeds[j, k] = np.sqrt(max(square, 0.0))
                        fresh = fresh or counted[k]
            elif closed[i, k] and gaps[j, k] > slack:
                closed[i, k] = False
            here = here or closed[i, k]
        if here:
            met[count] = i
            count += 1
        if not fresh:
            continue
        # the minimum-norm velocity with these components along the normals, from an orthogonal basis of their span
        size = 0
        for first in (True, False):
            for k in range(w):
                if size == 3 or not touching[i, k] or not counted[k] or (speeds[j, k] > 0.0) != first:
                    continue
                left, left_after = speeds[j, k], restitution[k] * speeds[j, k]
                for c in range(3):
                    row[c] = 0.0 if fixed[i, c] else normals[j, k, c]
                for b in range(size):
                    share = row[0] * basis[b, 0] + row[1] * basis[b, 1] + row[2] * basis[b, 2]
                    for c in range(3):
                        row[c] -= share * basis[b, c]
                    left -= share * before[b]
                    left_after -= share * after[b]
                length = np.sqrt(row[0] * row[0] + row[1] * row[1] + row[2] * row[2])
                if length <= 1e-8:
                    continue
                for c in range(3):
                    basis[size, c] = row[c] / length
                before[size], after[size] = left / length, left_after / length
                size += 1
        for b in range(size):
            loss += 0.5 * mass[i] * (before[b] * before[b] - after[b] * after[b])
    return loss, met[:count].copy()

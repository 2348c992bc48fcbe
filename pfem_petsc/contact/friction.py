"""Coulomb friction of nodes on walls in explicit steps.

Each wall k presses a node with lambda_k >= 0 along its normal and drags it by tau_k in its plane. With the slip s_k of
the step, which is the node's motion relative to the wall in the wall's plane: the node sticks (s_k = 0) where
|tau_k| <= mu_static lambda_k does it, else it slips and tau_k = -mu lambda_k s_k/|s_k|. On one wall this is solved
exactly, also where supports leave the node one component; several walls at a node are swept until nothing changes.
"""

from __future__ import annotations

import math

import numpy as np

from ..mechanics.compiled import inlined, kernel

__all__ = ["add_friction"]

_SWEEPS = 2000
_SLIDES = 1e-13  # of the position: slips beyond are no rounding
_OVERSHOOT = 0.9  # of the drag over the normal force, from which on sweeps go a part of the way


@inlined
def slides_along_guide(i, x, before, way, fixed, normals, dynamic, normal_forces, drag):
    """Forces on a node that supports leave one component, pressed by one wall with friction: in closed form.

    Where it is, and so its slip s, is decided by the wall alone. Along the free component f, with lambda_0 the normal
    force without friction, lambda (n_f - mu s_f/|s|) = lambda_0 n_f: no sweeps are needed, which creep where the wall
    is almost parallel to the guide.

    Returns
    -------
    bool
        Whether it is such a node, slides, and a normal force does it; otherwise nothing has changed.
    """
    free = -1
    for c in range(3):
        if not fixed[i, c]:
            if free >= 0:
                return False
            free = c
    if free < 0:
        return False
    wall = -1
    for k in range(normal_forces.shape[1]):
        if normal_forces[i, k] > 0.0:
            if wall >= 0:
                return False
            wall = k
    if wall < 0 or not dynamic[wall] > 0.0:
        return False
    n = normals[i, wall]
    along = 0.0
    for c in range(3):
        along += (x[i, c] - before[i, c] - way[wall, c]) * n[c]
    size, where = 0.0, 0.0
    for c in range(3):
        slip = x[i, c] - before[i, c] - way[wall, c] - along * n[c]
        size += slip * slip
        where += abs(x[i, c])
    size = math.sqrt(size)
    if not size > _SLIDES * where:
        return False
    slip = x[i, free] - before[i, free] - way[wall, free] - along * n[free]
    helped = 1.0 - dynamic[wall] * slip / (size * n[free])
    if not helped > _SLIDES:
        return False
    normal_forces[i, wall] /= helped
    for c in range(3):
        slip = x[i, c] - before[i, c] - way[wall, c] - along * n[c]
        drag[i, wall, c] = -dynamic[wall] * normal_forces[i, wall] * slip / size
    return True


@kernel
def add_friction(x, before, way, fixed, normals, offsets, dynamic, static, stiffness, normal_forces, drag):
    """Apply friction forces to the nodes in contact with walls that have friction.

    Parameters
    ----------
    x : (m, 3) positions under the normal forces alone, changed in place [m]
    before : (m, 3) positions at the start of the step [m]
    way : (w, 3) displacements of the walls in the step [m]
    fixed : (m, 3) bool, components that supports prescribe
    normals, offsets : (m, w, 3), (m, w) planes n . x >= d; -inf where a wall does not apply
    dynamic, static : (w,) coefficients of friction
    stiffness : (m,) force for a displacement of the node [N/m]
    normal_forces : (m, w) normal forces [N], changed in place
    drag : (m, w, 3) friction forces, output [N]

    Returns
    -------
    int
        First node whose sweeps did not converge, or -1.
    """
    m, w = offsets.shape
    trial = np.zeros(3)
    unsettled = -1
    for i in range(m):
        rubbing = False
        for k in range(w):
            for c in range(3):
                drag[i, k, c] = 0.0
            if normal_forces[i, k] > 0.0:
                rubbing = rubbing or static[k] > 0.0
        if not rubbing or slides_along_guide(i, x, before, way, fixed, normals, dynamic, normal_forces, drag):
            continue
        soft = 1.0 / stiffness[i]
        reach = stiffness[i] * (
            abs(x[i, 0]) + abs(x[i, 1]) + abs(x[i, 2])
        )  # forces that correspond to the rounding of positions
        # where supports leave little of a normal free, the friction force moves the node r times as far as the normal
        # force; sweeps overshoot for r >= 1 unless they are underrelaxed
        part = 1.0
        for k in range(w):
            if offsets[i, k] > -math.inf and static[k] > 0.0:
                length = 0.0
                for c in range(3):
                    if not fixed[i, c]:
                        length += normals[i, k, c] * normals[i, k, c]
                if length >= 1e-12:
                    ratio = static[k] * math.sqrt(max(1.0 - length, 0.0) / length)
                    if ratio > _OVERSHOOT:
                        part = min(part, 1.0 / (1.0 + ratio))
        settled = False
        for _ in range(_SWEEPS):
            change = 0.0
            largest = 0.0
            least = 1.0  # where supports leave little of a normal free, rounding is amplified in forces
            for k in range(w):
                if offsets[i, k] == -math.inf:
                    continue
                length = 0.0
                gap = -offsets[i, k]
                for c in range(3):
                    gap += normals[i, k, c] * x[i, c]
                    if not fixed[i, c]:
                        length += normals[i, k, c] * normals[i, k, c]
                if length < 1e-12:
                    continue
                # normal
                old = normal_forces[i, k]
                new = max(0.0, old - gap * stiffness[i] / length)
                if new == 0.0 and old == 0.0:
                    continue
                least = min(least, length)
                change = max(change, abs(new - old))
                if part < 1.0:
                    new = old + part * (new - old)
                for c in range(3):
                    if not fixed[i, c]:
                        x[i, c] += (new - old) * normals[i, k, c] * soft
                normal_forces[i, k] = new
                largest = max(largest, new)
                # tangential: the force that would stop the slip, limited by Coulomb's law
                if static[k] == 0.0:
                    continue
                slip = 0.0
                for c in range(3):
                    trial[c] = x[i, c] - before[i, c] - way[k, c]
                    slip += trial[c] * normals[i, k, c]
                size = 0.0
                for c in range(3):
                    trial[c] = drag[i, k, c] - stiffness[i] * (trial[c] - slip * normals[i, k, c])
                    size += trial[c] * trial[c]
                size = math.sqrt(size)
                factor = 1.0
                if size > static[k] * new:
                    factor = dynamic[k] * new / size
                for c in range(3):
                    force = factor * trial[c]
                    move = force - drag[i, k, c]
                    change = max(change, abs(move))
                    if part < 1.0:
                        move *= part
                        force = drag[i, k, c] + move
                    drag[i, k, c] = force
                    if not fixed[i, c]:
                        x[i, c] += move * soft
            if change <= 1e-15 * (largest + reach / least) or largest == 0.0:
                settled = True
                break
        if not settled and unsettled < 0:
            unsettled = i
    return unsettled

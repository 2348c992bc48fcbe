"""Coulomb friction of nodes on walls in explicit steps.

Each wall k exerts a normal force lambda_k >= 0 and a friction force tau_k in its plane on a node. The slip s_k of the
step is the node's displacement relative to the wall in the wall's plane. The node sticks (s_k = 0) if this is possible
with |tau_k| <= mu_static lambda_k; else it slips and tau_k = -mu lambda_k s_k/|s_k|. One wall at a node is solved
exactly; several walls are swept until nothing changes.
"""

from __future__ import annotations

import math

import numpy as np

from ..mechanics.compiled import kernel

__all__ = ["add_friction"]

_SWEEPS = 2000
_OVERSHOOT = 0.9  # ratio of displacements by friction and by the normal force above which sweeps are underrelaxed


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
        if not rubbing:
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

"""Flat walls in the fused loop: each block of nodes is pressed while it is in the cache.

Arguments are those of :mod:`~pfem_petsc.stepping.fused_blocks`; ``walls`` are a
:class:`~pfem_petsc.stepping.fused_arrays.WallArrays`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..contact.flat import find_beyond, press_nodes
from ..mechanics.compiled import borrowing, kernel
from ..mesh.ordering import NODE_BLOCK

__all__ = ["Pressed", "find_pressed", "mark_blocks", "new_pressed", "press_block"]


class Pressed(NamedTuple):
    """Results of :func:`~pfem_petsc.contact.flat.press_nodes` for all blocks of a step: room for ``nodes`` (n,), the
    planes that they are ``touching`` (n, w), and their ``places`` (n, 3); ``offsets`` (w,) of the infeasible node; and
    the sums of each wall, ``force`` (w, 3), ``contacts`` (w,) and ``moment`` (w, 3)."""

    nodes: np.ndarray
    touching: np.ndarray
    places: np.ndarray
    offsets: np.ndarray
    force: np.ndarray
    contacts: np.ndarray
    moment: np.ndarray


@kernel
def new_pressed(n, w):
    """Return room for ``n`` nodes and ``w`` walls. Pages of memory that no node needs are not touched."""
    nodes = np.empty(n if w > 0 else 0, dtype=np.int64)
    touching, places = np.empty((len(nodes), w), dtype=np.bool_), np.empty((len(nodes), 3))
    force, contacts, moment = np.zeros((w, 3)), np.zeros(w, dtype=np.int64), np.zeros((w, 3))
    return Pressed(nodes, touching, places, np.empty(w), force, contacts, moment)


@kernel
def mark_blocks(marks, nodes, value):
    """Set ``marks`` of the blocks of ``nodes`` to ``value``."""
    for i in nodes:
        marks[i // NODE_BLOCK] = value


@borrowing
def find_pressed(block, walls, free):
    """Write the nodes of a block that lie beyond a plane at ``free`` (3 m,) to ``walls.room``; return their number."""
    first = NODE_BLOCK * block
    return find_beyond(first, free, walls.normals, walls.offsets, walls.all_nodes, walls.members, walls.room)


@kernel
def press_block(block, m, nodes, walls, free, u, alpha, eta, contact, pressed, count):
    """Press the ``m`` nodes of a block that :func:`find_pressed` has found, and append them to the ``count`` nodes of
    ``pressed``; correct their increments in ``u``, and write their forces to ``contact`` (n, 3) [N]. Return the first
    infeasible node among all of them, or -1.

    ``free``, ``u``: positions and increments of the nodes of the block, flat.
    """
    first = NODE_BLOCK * block
    planes = (walls.normals, walls.offsets, walls.all_nodes, walls.members)
    damped = len(nodes.damping) > 0
    found = walls.room[:m].copy()
    places, stiffness = np.empty((m, 3)), np.empty(m)
    for j in range(m):
        i = found[j]
        stiffness[j] = alpha * nodes.mass[i] + (eta * nodes.damping[i] if damped else 0.0)
        for c in range(3):
            places[j, c] = free[3 * (i - first) + c]
    sums = (pressed.force, pressed.contacts, pressed.moment)
    infeasible, offsets, total, touching = press_nodes(
        found, places, walls.fixed, *planes, walls.tolerance, stiffness, *sums
    )
    for j in range(m):
        i = found[j]
        for c in range(3):
            at = 3 * (i - first) + c
            u[at] += places[j, c] - free[at]
            contact[i, c] = total[j, c]
            pressed.places[count + j, c] = places[j, c]
        pressed.nodes[count + j] = i
        for k in range(touching.shape[1]):
            pressed.touching[count + j, k] = touching[j, k]
    if infeasible >= 0:
        pressed.offsets[:] = offsets[infeasible]
        infeasible += count
    return infeasible

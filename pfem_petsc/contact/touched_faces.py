"""The faces of a surface of triangles that nodes touch in a step."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from ..mechanics.compiled import inlined, kernel
from .triangles import faces_at, nearest

if TYPE_CHECKING:
    from .walls.surface import Wall

_SAME = 1.0 - 1e-10
"""Cosine between the normals of faces of one plane."""

_BEHIND = 2
"""Mark of nodes that are behind an open surface, which they have passed beside; of others in this step 1, else 0."""


@inlined
def _tangent(triangles, i, x, normals, offsets):
    """Write the plane through the place nearest to a position (3,) across the way there, as the i-th node's only one;
    return the distance [m]."""
    distance, face, feature, px, py, pz = nearest(triangles, x[0], x[1], x[2], math.inf)
    offsets[i, :] = -math.inf
    if face < 0:  # of a position that is no number
        return distance
    clearance, rounding = triangles.limits[0, 1], triangles.limits[0, 2]
    both = triangles.limits[0, 0] > 0.0
    place, size = (px, py, pz), max(abs(distance), 1e-300)
    side = -1.0 if distance < 0.0 and not both else 1.0
    length, offset = 0.0, clearance
    for c in range(3):
        away = side * (x[c] - place[c]) / size
        if abs(distance) <= 1e3 * rounding:
            away = triangles.normals[face, feature, c]
        normals[i, 0, c] = away
        length += away * away
    if not length > 0.0:  # at the border of an open surface
        for c in range(3):
            normals[i, 0, c] = triangles.normals[face, 0, c]
        length = 1.0
    for c in range(3):
        normals[i, 0, c] /= math.sqrt(length)
        offset += normals[i, 0, c] * place[c]
    offsets[i, 0] = offset
    return (abs(distance) if both else distance) - clearance


@kernel
def tangent_planes(triangles, x, normals, offsets):
    """Write the plane nearest to positions (m, 3) into normals (m, 3, 3) and offsets (m, 3), of which the first has it;
    the others are -inf."""
    for i in range(len(x)):
        _tangent(triangles, i, x[i], normals, offsets)


@kernel
def _mark_near(triangles, starts, ends, reach, slack, near):
    """Mark nodes that move from ``starts`` to ``ends`` (n, 3) and come within ``reach`` (n,) or (1,) of the surface
    there, or, with a reach that is not positive, are behind it by more than that."""
    normals, offsets, fixed = np.empty((3, 3)), np.empty(3), np.zeros(3, np.bool_)
    clearance, root = triangles.limits[0, 1], triangles.boxes[1]
    for i in range(len(ends)):
        limit = reach[i] if len(reach) > 1 else reach[0]
        least, apart = max(limit, 0.0) + clearance + slack[i], False
        for c in range(3):
            low, high = min(starts[i, c], ends[i, c]), max(starts[i, c], ends[i, c])
            apart = apart or low > root[c + 3] + least or high < root[c] - least
        if apart:
            continue
        if limit > 0.0:
            distance, _, _, _, _, _ = nearest(triangles, ends[i, 0], ends[i, 1], ends[i, 2], least)
            near[i] = abs(distance) < max(limit, 0.0) + clearance
        if not near[i] and faces_at(triangles, starts[i], ends[i], fixed, slack[i], normals, offsets) > 0:
            for k in range(3):
                gap = -offsets[k]
                for c in range(3):
                    gap += normals[k, c] * ends[i, c] if offsets[k] > -math.inf else 0.0
                near[i] = near[i] or gap < min(limit, 0.0)


@inlined
def _put(i, j, normal, offset, table, kept):
    """Give node i, the j-th of some, a plane, in the slot in which it touched it before, or else in one that is free: a
    node that touches another face has hit it."""
    _, normals, offsets = table
    before, occupied = kept
    best, slot = -1, 0
    for k in range(3):
        if offsets[i, k] > -math.inf:
            continue
        along = 0.0
        for c in range(3):
            along += normal[c] * before[i, 3 * k + c]
        value = 1 if not occupied[j, k] else (2 if along > _SAME else 0)
        if value > best:
            best, slot = value, k
    offsets[i, slot] = offset
    for c in range(3):
        normals[i, slot, c] = before[i, 3 * slot + c] = normal[c]


@kernel
def _find(triangles, nodes, ways, tolerance, table, kept):
    """Find the planes of nodes (m,) on their ways; return whether any changed.

    Parameters
    ----------
    ways : starts and ends (m, 3), fixed (m, 3) bool, and by how much each may have been behind the surface (m,) [m]
    table : marks of nodes (owned,), their normals (owned, 3, 3) and offsets (owned, 3)
    kept : normals (owned, 9) of the planes of earlier steps, and which of these they touch (m, 3) bool
    """
    starts, ends, fixed, slack = ways
    known, normals, offsets = table
    changed, both = False, triangles.limits[0, 0] > 0.0
    own, level, gaps = np.zeros((1, 3, 3)), np.empty((1, 3)), np.empty(3)
    for j in range(len(nodes)):
        i, x = nodes[j], ends[j]
        if not known[i]:
            known[i], offsets[i, :], changed = 1, -math.inf, True
            if faces_at(triangles, starts[j], x, fixed[j], slack[j], own[0], level[0]) == 0 and tolerance > 0.0:
                if not both and _tangent(triangles, 0, starts[j], own, level) < -slack[j]:
                    known[i] = _BEHIND
                    continue
                _tangent(triangles, 0, x, own, level)
            for k in range(3):
                if level[0, k] > -math.inf:
                    _put(i, j, own[0, k], level[0, k], table, kept)
            continue
        if known[i] == _BEHIND:
            continue
        distance = _tangent(triangles, 0, x, own, level)
        on, there, worst = False, False, 0
        for k in range(3):
            gaps[k] = math.inf
            if offsets[i, k] > -math.inf:
                gaps[k], along = -offsets[i, k], 0.0
                for c in range(3):
                    gaps[k] += normals[i, k, c] * x[c]
                    along += normals[i, k, c] * own[0, 0, c]
                on = on or abs(gaps[k]) <= tolerance
                there = there or (along > _SAME and abs(offsets[i, k] - level[0, 0]) <= tolerance)
            worst = k if gaps[k] > gaps[worst] else worst
        if distance > tolerance and on:  # on the plane of a face, beside it
            offsets[i, :] = -math.inf
        elif there or not distance < -tolerance:  # else a plane found for the same position would take all slots
            continue
        changed = True
        offsets[i, worst] = -math.inf
        _put(i, j, own[0, 0], level[0, 0], table, kept)
    return changed


class TouchedFaces:
    """The planes, up to three, along which nodes touch a surface of triangles in a step. Positions are those relative
    to the surface, as it is at rest.

    Parameters
    ----------
    wall : a surface of triangles
    n_owned : number of nodes
    """

    def __init__(self, wall: Wall, n_owned: int) -> None:
        self._triangles = wall.compiled
        self._table = np.zeros(n_owned, dtype=np.int8), np.zeros((n_owned, 3, 3)), np.full((n_owned, 3), -np.inf)

    def forget(self) -> None:
        """Begin a step."""
        self._table[0][:] = 0

    def near(self, starts: np.ndarray, ends: np.ndarray, reach: np.ndarray, slack: np.ndarray) -> np.ndarray:
        """Return (n,) bool: nodes that move from ``starts`` to ``ends`` (n, 3) [m] and come within ``reach``, (n,) or
        (1,) [m], of the surface, or, if it is not positive, end behind it by more than that; ``slack`` (n,): by how
        much each may have been behind it at the start [m]."""
        near = np.zeros(len(ends), dtype=bool)
        _mark_near(self._triangles, starts, np.ascontiguousarray(ends), reach, slack, near)
        return near

    def find(
        self,
        nodes: np.ndarray,
        ways: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
        tolerance: float,
        kept: tuple[np.ndarray, np.ndarray],
    ) -> bool:
        """Find planes of nodes (m,), beside those that were found in this step; return whether there are others now.

        A node that is behind the surface although it satisfies its planes gets one more; one that is on the plane of a
        face, but beside it, gets that of the nearest place. ``ways``, ``kept``: see :func:`_find`; ``tolerance``: depth
        that counts as zero [m]; without any, nodes that are not stopped have no plane.
        """
        starts, ends, fixed, slack = ways
        ways = np.ascontiguousarray(starts), np.ascontiguousarray(ends), fixed, slack
        return bool(_find(self._triangles, nodes, ways, tolerance, self._table, kept))

    def planes(self, nodes: np.ndarray | None, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the normals (m, 3, 3) of the planes of nodes (m,) at (m, 3), and distances along them (m, 3) [m],
        infinite for none; of nodes for which none were sought, or of no nodes, the plane of the nearest place."""
        known, normals, offsets = self._table
        normals, offsets = (
            (np.zeros((len(x), 3, 3)), np.full((len(x), 3), -np.inf))
            if nodes is None
            else (normals[nodes], offsets[nodes])
        )
        at = np.arange(len(x)) if nodes is None else np.flatnonzero(known[nodes] == 0)
        if len(at):
            own, level = np.zeros((len(at), 3, 3)), np.empty((len(at), 3))
            tangent_planes(self._triangles, np.ascontiguousarray(x[at]), own, level)
            normals[at], offsets[at] = (own, level) if nodes is None else (own[:, :1], level[:, :1])
        return normals, np.einsum("mki,mi->mk", normals, x) - offsets

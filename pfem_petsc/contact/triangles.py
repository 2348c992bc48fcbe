"""Surfaces of triangles in compiled loops: signed distances, the planes of the faces that stop a node, and those that
nodes touch in a step.

Triangles are in the order of a tree of boxes: box k has the halves 2 k and 2 k + 1 of its triangles, and each of the
boxes of the last level a few. The sign of a distance is that of its scalar product with the normal of the place nearest
to a point: on edges and vertices sums of the normals of the faces there, by their angles (J. A. Baerentzen, H. Aanaes,
IEEE Transactions on Visualization and Computer Graphics 11, 2005). Places on the border of an open surface have none:
what is beside the surface is in front of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple, Self

import numpy as np

from ..mechanics.compiled import inlined, kernel, record
from .projection import project
from .rotations import along, dot, minus, put, times, vector

ROUNDING = 1e-13
"""Distances below this fraction of the largest coordinate count as zero where planes meet."""

_IN_LEAF = 4
"""Least number of triangles in a box of the last level, of surfaces with more."""


_ROUNDS = 8
"""Most planes that are tried for the end of a way; those that do not push give their place to others."""

_SAME = 1.0 - 1e-10
"""Cosine between the normals of faces of one plane."""

_BEHIND = 2
"""Mark of nodes that are behind an open surface, which they have passed beside; of others in this step 1, else 0."""


@record
class Triangles(NamedTuple):
    """A surface of t triangles where it is at rest.

    Attributes
    ----------
    points : (t, 3, 3) corners [m], counter-clockwise seen from the front
    normals : (t, 7, 3) of the face, its edges 0-1, 1-2, 2-0 and its corners; unit vectors for the face only, and zero
        at the border of open surfaces
    boxes : (2 l, 6) lower and upper corners [m]; the leaves of the tree are the last l
    limits : (1, 3) 1.0 if the surface stops nodes from either side, else 0.0; the distance [m] at which it stops them;
        the rounding of distances [m]
    """

    points: np.ndarray
    normals: np.ndarray
    boxes: np.ndarray
    limits: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray, corners: np.ndarray, both: bool = False, clearance: float = 0.0) -> Self:
        """Return the surface of points (n, 3) [m] and the numbers (t, 3) of the corners of its triangles.

        Each edge has one triangle, or two with the same side in front. ``both``: whether nodes are stopped from either
        side; ``clearance``: the distance [m] at which they are.
        """
        places = points[corners]
        order, first = _sorted_by_place(places.mean(axis=1))
        places, leaves = places[order], len(first)
        boxes = np.zeros((2 * leaves, 6))
        boxes[leaves:, :3] = np.minimum.reduceat(places.min(axis=1), first)
        boxes[leaves:, 3:] = np.maximum.reduceat(places.max(axis=1), first)
        while leaves > 1:
            halves = boxes[leaves : 2 * leaves].reshape(-1, 2, 6)
            leaves //= 2
            boxes[leaves : 2 * leaves, :3] = halves[:, :, :3].min(axis=1)
            boxes[leaves : 2 * leaves, 3:] = halves[:, :, 3:].max(axis=1)
        limits = np.array([[float(both), clearance, ROUNDING * np.abs(places).max()]])
        return cls(places, _normals(places, corners[order]), boxes, limits)


def _sorted_by_place(centres: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the order (t,) of triangles with centres (t, 3) in the tree, and where in it each leaf begins: halves are
    divided at the median along the longest axis."""
    n = len(centres)
    order, first = np.arange(n), np.zeros(1, int)
    while n >= 2 * _IN_LEAF * len(first):
        part = np.repeat(np.arange(len(first)), np.diff(first, append=n))
        own = centres[order]
        spans = np.maximum.reduceat(own, first) - np.minimum.reduceat(own, first)
        order = order[np.lexsort((own[np.arange(n), spans.argmax(axis=1)[part]], part))]
        first = n * np.arange(2 * len(first)) // (2 * len(first))
    return order, first


def _normals(places: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return :attr:`Triangles.normals` of triangles (t, 3, 3) with the corners (t, 3)."""
    sides = np.roll(places, -1, axis=1) - places
    sides /= np.linalg.norm(sides, axis=2)[:, :, None]
    normals = np.zeros((len(places), 7, 3))
    face = np.cross(sides[:, 0], sides[:, 1])
    face /= np.linalg.norm(face, axis=1)[:, None]
    normals[:, 0] = face
    ends = np.sort(np.stack([corners, np.roll(corners, -1, axis=1)], axis=2), axis=2).reshape(-1, 2)
    _, edge, count = np.unique(ends @ [corners.max() + 1, 1], return_inverse=True, return_counts=True)
    total = np.zeros((len(count), 3))
    np.add.at(total, edge.ravel(), np.repeat(face, 3, axis=0))
    total[count == 1] = 0.0
    normals[:, 1:4] = total[edge].reshape(-1, 3, 3)
    angles = np.arccos(np.clip(-np.einsum("tki,tki->tk", sides, np.roll(sides, 1, axis=1)), -1.0, 1.0))
    total = np.zeros((corners.max() + 1, 3))
    np.add.at(total, corners, angles[:, :, None] * face[:, None])
    total[ends[(count == 1)[edge.ravel()]]] = 0.0
    normals[:, 4:] = total[corners]
    return normals


@inlined
def _arm(points, normals, place):
    """Return the vector from the nearest place of a triangle (3, 3) to another place, and what that lies on: 0 the
    face, 1 to 3 an edge, 4 to 6 a corner (C. Ericson, Real-Time Collision Detection, 2005, section 5.1.5)."""
    first = vector(points, 0)
    u, v, w = minus(vector(points, 1), first), minus(vector(points, 2), first), minus(place, first)
    uu, uv, vv, wu, wv = dot(u, u), dot(u, v), dot(v, v), dot(w, u), dot(w, v)
    if wu <= 0.0 and wv <= 0.0:
        return w, 4
    if wu >= uu and wv - uv <= wu - uu:
        return minus(w, u), 5
    if wv >= vv and wu - uv <= wv - vv:
        return minus(w, v), 6
    second, third = vv * wu - uv * wv, uu * wv - uv * wu  # areas opposite the corners, times 2 |u x v|
    if third <= 0.0 and wu >= 0.0 and wu <= uu:
        return along(w, -wu / uu, u), 1
    if second <= 0.0 and wv >= 0.0 and wv <= vv:
        return along(w, -wv / vv, v), 3
    if uu * vv - uv * uv - second - third <= 0.0:
        return along(minus(w, u), -(wv - uv - wu + uu) / (uu + vv - 2.0 * uv), minus(v, u)), 2
    n = vector(normals, 0)
    return times(dot(w, n), n), 0


@inlined
def _away(box, low, high):
    """Return the squared distance of two boxes, the second from its lower to its upper corner."""
    x, y = max(box[0] - high[0], low[0] - box[3], 0.0), max(box[1] - high[1], low[1] - box[4], 0.0)
    z = max(box[2] - high[2], low[2] - box[5], 0.0)
    return x * x + y * y + z * z


@inlined
def _box(one, other):
    """Return the lower and upper corner of the box of two places (3,)."""
    low = min(one[0], other[0]), min(one[1], other[1]), min(one[2], other[2])
    return low, (max(one[0], other[0]), max(one[1], other[1]), max(one[2], other[2]))


@inlined
def _next_leaf(triangles, k, low, high, square):
    """Return the leaf of the tree after leaf ``k``, or the first if that is 0, whose squared distance from a box is at
    most as given; 0 after the last."""
    leaves, begun = len(triangles.boxes) >> 1, k > 0
    while True:
        k += 1
        while k & 1 == 0:  # to what follows a box and all that it has
            k >>= 1
        if begun and k == 1:
            return 0
        begun = True
        while _away(triangles.boxes[k], low, high) <= square:
            if k >= leaves:
                return k
            k *= 2


@inlined
def _of_leaf(triangles, k):
    """Return the range of the triangles of a leaf."""
    n, leaves = len(triangles.points), len(triangles.boxes) >> 1
    return range(n * (k - leaves) // leaves, n * (k - leaves + 1) // leaves)


@inlined
def nearest(triangles, x, y, z, reach):
    """Return the signed distance of a point from a surface, negative behind it [m]; the nearest face, of equally near
    ones the first; what of it is nearest, an index of its ``normals``; and the nearest place [m].

    The distance is infinite, and the face -1, for a point that is farther away than ``reach`` [m].
    """
    points, normals, boxes, place = triangles.points, triangles.normals, triangles.boxes, (x, y, z)
    best, face, feature, arm = reach * reach, -1, 0, (math.inf, 0.0, 0.0)
    leaf, descends = 1, True
    if _away(boxes[1], place, place) <= best:
        while leaf < len(boxes) >> 1:  # the leaf that is likely to have it comes first, so that the others are far
            leaf *= 2
            leaf += _away(boxes[leaf + 1], place, place) < _away(boxes[leaf], place, place)
        while leaf > 0:
            for j in _of_leaf(triangles, leaf):
                found, part = _arm(points[j], normals[j], place)
                square = dot(found, found)
                if square < best or (square == best and (face < 0 or j < face)):
                    best, face, feature, arm = square, j, part, found
            leaf = _next_leaf(triangles, 0 if descends else leaf, place, place, best)
            descends = False
    if face < 0:
        return math.inf, face, feature, x, y, z
    side = 1.0 if dot(vector(normals[face], feature), arm) >= 0.0 else -1.0
    return side * math.sqrt(best), face, feature, x - arm[0], y - arm[1], z - arm[2]


@inlined
def _gap(triangles, face, place):
    """Return the distance of a place (3,) from the plane of a face [m]."""
    return dot(vector(triangles.normals[face], 0), minus(place, vector(triangles.points[face], 0)))


@inlined
def _square(one, other):
    """Return the squared distance of two places (3,) [m2]."""
    way = minus(one, other)
    return dot(way, way)


@inlined
def _passed(triangles, face, start, place, when, near, ahead):
    """Return whether a way that leads behind a face at its border remains ``ahead`` [m] of the other face of a convex
    edge there."""
    points, normals, both = triangles.points, triangles.normals, triangles.limits[0, 0] > 0.0
    at = along(start, when, minus(place, start))
    leaf = _next_leaf(triangles, 0, at, at, near * near)
    while leaf > 0:
        for j in _of_leaf(triangles, leaf):
            side = -1.0 if both and _gap(triangles, j, start) < 0.0 else 1.0
            if j == face or side * _gap(triangles, j, place) < ahead:
                continue
            arm, _ = _arm(points[j], normals[j], at)
            side = -1.0 if both and _gap(triangles, face, start) < 0.0 else 1.0
            bend = _gap(triangles, face, points[j, 0]) + _gap(triangles, face, points[j, 1])
            bend = side * (bend + _gap(triangles, face, points[j, 2]))
            if dot(arm, arm) <= near * near and bend < -triangles.limits[0, 2]:
                return True
        leaf = _next_leaf(triangles, leaf, at, at, near * near)
    return False


@inlined
def _crossed(triangles, start, place, tolerance, least):
    """Return the first face through which a node moves from ``start`` to a ``place`` behind it by more than ``least``,
    of faces at one place that behind which it is the least; -1 if there is none.

    A ``start`` that is behind a face by no more than the tolerance is in front of it.
    """
    both, rounding = triangles.limits[0, 0] > 0.0, triangles.limits[0, 2]
    found, soonest, highest = -1, math.inf, -math.inf
    slack, way = max(tolerance, rounding), math.sqrt(_square(start, place))
    # a node that falls on an edge along one of its faces is stopped, one that has been stopped moves along them
    ahead = -least if least > 0.0 else rounding
    low, high = _box(start, place)
    leaf = _next_leaf(triangles, 0, low, high, 3.0 * slack * slack)
    while leaf > 0:
        for j in _of_leaf(triangles, leaf):
            before, after = _gap(triangles, j, start), _gap(triangles, j, place)
            if both and before < 0.0:
                before, after = -before, -after
            if before < -slack or after >= -least or after >= before:
                continue
            when = max(before, 0.0) / (max(before, 0.0) - after)
            if when > soonest or (when == soonest and after <= highest):
                continue
            arm, _ = _arm(triangles.points[j], triangles.normals[j], along(start, when, minus(place, start)))
            # where a way that is almost parallel to the face crosses it is known but roughly
            near = rounding * (1.0 + way / (before - after))
            if dot(arm, arm) - min(before, 0.0) ** 2 <= near * near and not _passed(
                triangles, j, start, place, when, max(near, slack), ahead
            ):
                found, soonest, highest = j, when, after
        leaf = _next_leaf(triangles, leaf, low, high, 3.0 * slack * slack)
    return found


@inlined
def _behind(triangles, start, place, tolerance, least):
    """Return the face nearest to a place that is behind it by more than ``least`` while ``start`` is not, or -1:
    neither are places beside the surface behind it, nor those that are farther from it than from the start."""
    both, clearance = triangles.limits[0, 0] > 0.0, triangles.limits[0, 1]
    reach = math.sqrt(_square(start, place)) + tolerance + clearance
    distance, face, feature, _, _, _ = nearest(triangles, place[0], place[1], place[2], reach)
    if face < 0:
        return face
    border = triangles.normals[face, feature]
    if (abs(distance) if both else distance) - clearance >= -least or border[0] == border[1] == border[2] == 0.0:
        return -1
    return face if both or _gap(triangles, face, start) - clearance >= -max(tolerance, triangles.limits[0, 2]) else -1


@inlined
def faces_at(triangles, start, free, fixed, tolerance, normals, offsets):
    """Find the planes of the faces that stop a node which moves from ``start`` to ``free`` (3,) [m], both relative to
    the surface: the point nearest to ``free`` in front of all planes is not behind the surface.

    The faces are those nearest to the end of the way, and where the way passes through the surface all the same, as
    through a thin body, those that it crosses first. A node behind the surface which was so at the start by more than
    the tolerance [m] is not stopped.

    Parameters
    ----------
    fixed : (3,) bool, components that do not move
    normals : (3, 3) output, unit normals to the allowed side; offsets : (3,) output [m]: the plane n . x >= d, -inf if
        there is none

    Returns
    -------
    int
        Number of planes.
    """
    both, clearance, rounding = triangles.limits[0, 0] > 0.0, triangles.limits[0, 1], triangles.limits[0, 2]
    place, held, moves = np.empty((1, 3)), np.empty((1, 3), np.bool_), np.empty((1, 3))
    planes, levels = np.zeros((1, 3, 3)), np.empty((1, 3))
    count = 0
    for sweeps in range(2):
        count = 0
        place[0, :], held[0, :], levels[0, :], moves[0, :] = free, fixed, -math.inf, 0.0
        for _ in range(_ROUNDS):
            least = rounding if count else 0.0
            behind = _behind(triangles, start, place[0], tolerance, least)
            crossed = _crossed(triangles, start, place[0], tolerance, least)
            face = crossed if (sweeps or both) and crossed >= 0 else behind
            if face < 0 and crossed >= 0:  # the nearest faces do not stop the node on its way
                face = crossed
                break
            slot = count
            for k in range(count):
                slot = k if moves[0, k] == 0.0 else slot
            if face < 0 or slot == 3:
                break
            # what has not passed through a sheet is on its own side, even if the face of the start has another one
            gap = _gap(triangles, face, start) if face == crossed else _gap(triangles, face, place[0])
            side = -1.0 if both and gap < 0.0 else 1.0
            normal = times(side, vector(triangles.normals[face], 0))
            put(planes[0], slot, normal)
            levels[0, slot] = clearance + dot(normal, vector(triangles.points[face], 0))
            count, place[0, :] = max(count, slot + 1), free
            if project(place, held, planes, levels, rounding, moves) >= 0:
                face = -1  # the caller finds the same
                break
        if face < 0:
            break
    if face >= 0:  # more than three planes: the node stays where it is
        normal = times(1.0 / math.sqrt(_square(start, free)), minus(start, free))
        put(planes[0], 0, normal)
        levels[0, 0], levels[0, 1], levels[0, 2], count = dot(normal, start), -math.inf, -math.inf, 1
    offsets[:], normals[:, :] = levels[0], planes[0]
    return count


@kernel
def stopping_faces(triangles, ways, fixed, tolerance, normals, offsets):
    """Write :func:`faces_at` of nodes that move from ``ways[0]`` to ``ways[1]``, (2, m, 3), with the ``fixed``
    components (m, 3) bool and the tolerance (m,), into normals (m, 3, 3) and offsets (m, 3)."""
    for i in range(ways.shape[1]):
        faces_at(triangles, ways[0, i], ways[1, i], fixed[i], tolerance[i], normals[i], offsets[i])


@inlined
def _tangent(triangles, x):
    """Return the distance of a position (3,) from the surface [m], and the plane through the nearest place across the
    way there: its normal, and its offset, which is -inf for a position that is no number."""
    distance, face, feature, px, py, pz = nearest(triangles, x[0], x[1], x[2], math.inf)
    if face < 0:
        return distance, (0.0, 0.0, 0.0), -math.inf
    both, clearance, rounding = triangles.limits[0, 0] > 0.0, triangles.limits[0, 1], triangles.limits[0, 2]
    side = -1.0 if distance < 0.0 and not both else 1.0
    normal = times(side / max(abs(distance), 1e-300), minus(x, (px, py, pz)))
    if abs(distance) <= 1e3 * rounding:  # the direction from the place is that of rounding
        normal = vector(triangles.normals[face], feature)
    if not dot(normal, normal) > 0.0:  # at the border of an open surface
        normal = vector(triangles.normals[face], 0)
    normal = times(1.0 / math.sqrt(dot(normal, normal)), normal)
    return (abs(distance) if both else distance) - clearance, normal, clearance + dot(normal, (px, py, pz))


@kernel
def tangent_planes(triangles, x, normals, offsets, distances):
    """Write the planes nearest to positions (m, 3), and their distances from the surface, into normals (m, 3), offsets
    and distances (m,) [m]."""
    for i in range(len(x)):
        distances[i], normal, offsets[i] = _tangent(triangles, x[i])
        put(normals, i, normal)


@kernel
def _mark_near(triangles, starts, ends, reach, slack, near):
    """Mark nodes that move from ``starts`` to ``ends`` (n, 3) and come within ``reach`` (n,) or (1,) of the surface
    there, or, with a reach that is not positive, are behind it by more than that."""
    normals, offsets, fixed = np.empty((3, 3)), np.empty(3), np.zeros(3, np.bool_)
    for i in range(len(ends)):
        limit = reach[i] if len(reach) > 1 else reach[0]
        least = max(limit, 0.0) + triangles.limits[0, 1]
        beyond = least + slack[i]
        if _away(triangles.boxes[1], *_box(starts[i], ends[i])) > 3.0 * beyond * beyond:
            continue
        if limit > 0.0:
            near[i] = abs(nearest(triangles, ends[i, 0], ends[i, 1], ends[i, 2], beyond)[0]) < least
        if not near[i] and faces_at(triangles, starts[i], ends[i], fixed, slack[i], normals, offsets) > 0:
            for k in range(3):
                gap = dot(vector(normals, k), ends[i]) - offsets[k] if offsets[k] > -math.inf else math.inf
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
        value = 1 if not occupied[j, k] else (2 if dot(normal, before[i, 3 * k : 3 * k + 3]) > _SAME else 0)
        if value > best:
            best, slot = value, k
    offsets[i, slot] = offset
    put(normals[i], slot, normal)
    put(before[:, 3 * slot :], i, normal)


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
    own, level = np.zeros((3, 3)), np.empty(3)
    for j in range(len(nodes)):
        i, x = nodes[j], ends[j]
        if known[i] == _BEHIND:
            continue
        if not known[i]:
            known[i], offsets[i, :], changed = 1, -math.inf, True
            if faces_at(triangles, starts[j], x, fixed[j], slack[j], own, level) == 0 and tolerance > 0.0:
                if not both and _tangent(triangles, starts[j])[0] < -slack[j]:
                    known[i] = _BEHIND
                    continue
                _, normal, level[0] = _tangent(triangles, x)
                put(own, 0, normal)
            for k in range(3):
                if level[k] > -math.inf:
                    _put(i, j, vector(own, k), level[k], table, kept)
            continue
        distance, normal, offset = _tangent(triangles, x)
        on, there, worst, farthest = False, False, 0, -math.inf
        for k in range(3):
            gap = math.inf
            if offsets[i, k] > -math.inf:
                gap = dot(vector(normals[i], k), x) - offsets[i, k]
                on = on or abs(gap) <= tolerance
                same = dot(vector(normals[i], k), normal) > _SAME
                there = there or (same and abs(offsets[i, k] - offset) <= tolerance)
            if gap > farthest:
                worst, farthest = k, gap
        if distance > tolerance and on:  # on the plane of a face, beside it
            offsets[i, :] = -math.inf
        elif there or not distance < -tolerance:  # else a plane found for the same position would take all slots
            continue
        changed = True
        offsets[i, worst] = -math.inf
        _put(i, j, normal, offset, table, kept)
    return changed


class TouchedFaces:
    """The planes, up to three, along which nodes touch a surface of triangles in a step. Positions are those relative
    to the surface, as it is at rest.

    Parameters
    ----------
    triangles : Triangles, for loops
    planes_of : returns the planes nearest to positions, see :class:`~pfem_petsc.contact.walls.base.BaseWall`
    n_owned : number of nodes
    """

    def __init__(
        self, triangles: Any, planes_of: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]], n_owned: int
    ) -> None:
        self._triangles, self._planes_of = triangles, planes_of
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
        at, shape = np.arange(len(x)), (len(x), 3)
        if nodes is None:
            normals, offsets = np.zeros((*shape, 3)), np.full(shape, -np.inf)
        else:
            normals, offsets, at = normals[nodes], offsets[nodes], np.flatnonzero(known[nodes] == 0)
        if len(at):
            slots = slice(1 if nodes is None else 3)
            own, level = self._planes_of(x[at])
            normals[at, slots], offsets[at, slots] = own[:, None], level[:, None]
        return normals, np.einsum("mki,mi->mk", normals, x) - offsets

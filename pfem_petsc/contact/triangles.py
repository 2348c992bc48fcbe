"""Surfaces of triangles in compiled loops: signed distances, and the planes of the faces that stop a node.

Triangles are in the order of a tree of boxes: box k has the halves 2 k and 2 k + 1 of its triangles, and each of the
boxes of the last level a few. The sign of a distance is that of its scalar product with the normal of the place nearest
to a point: on edges and vertices sums of the normals of the faces there, by their angles (J. A. Baerentzen, H. Aanaes,
IEEE Transactions on Visualization and Computer Graphics 11, 2005). Places on the border of an open surface have none:
what is beside the surface is in front of it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np

from ..mechanics.compiled import inlined, kernel, record
from .projection import project
from .vectors import along, dot, minus, put, times, vector

ROUNDING = 1e-13
"""Distances below this fraction of the largest coordinate count as zero where planes meet."""

_IN_LEAF = 4
"""Least number of triangles in a box of the last level, of surfaces with more."""


_ROUNDS = 8
"""Most planes that are tried for the end of a way; those that do not push give their place to others."""


@record
class Triangles(NamedTuple):
    """A surface of t triangles where it is at rest, or several.

    Attributes
    ----------
    points : (t, 3, 3) corners [m], counter-clockwise seen from the front
    normals : (t, 7, 3) of the face, its edges 0-1, 1-2, 2-0 and its corners; unit vectors for the face only, and zero
        at the border of open surfaces
    boxes : (2 l, 6) lower and upper corners [m]; the leaves of the tree are the last l
    limits : (1, 3) 1.0 if the surface stops nodes from either side, else 0.0; the distance [m] at which it stops them;
        the rounding of distances [m]
    starts : (s + 1, 3) first row in ``points``, ``boxes``, ``limits`` of each of s surfaces
    """

    points: np.ndarray
    normals: np.ndarray
    boxes: np.ndarray
    limits: np.ndarray
    starts: np.ndarray

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
        starts = np.array([[0, 0, 0], [len(places), len(boxes), 1]])
        return cls(places, _normals(places, corners[order]), boxes, limits, starts)

    @classmethod
    def joined(cls, surfaces: Sequence[Triangles]) -> Triangles:
        """Return several surfaces as one record, of which :func:`surface` takes one."""
        none = cls(np.empty((0, 3, 3)), np.empty((0, 7, 3)), np.empty((0, 6)), np.empty((0, 3)), np.zeros((1, 3), int))
        *arrays, _ = (np.concatenate(parts) for parts in zip(none, *surfaces, strict=True))
        ends = [each.starts[-1] for each in surfaces]
        return cls(*arrays, starts=np.cumsum([none.starts[0], *ends], axis=0))


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
def surface(triangles, k):
    """Return surface k of several, :meth:`Triangles.joined`."""
    starts = triangles.starts[k : k + 2]
    points, normals = triangles.points[starts[0, 0] : starts[1, 0]], triangles.normals[starts[0, 0] : starts[1, 0]]
    boxes, limits = triangles.boxes[starts[0, 1] : starts[1, 1]], triangles.limits[starts[0, 2] : starts[1, 2]]
    return Triangles(points, normals, boxes, limits, starts)


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
    low = min(start[0], place[0]), min(start[1], place[1]), min(start[2], place[2])
    high = max(start[0], place[0]), max(start[1], place[1]), max(start[2], place[2])
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
def signed_distances(triangles, k, x, reach, distances, faces, places):
    """Write :func:`nearest` of points (m, 3) to surface k into distances (m,), faces (m, 2), with what of them is
    nearest, and places (m, 3)."""
    one = surface(triangles, k)
    for i in range(len(x)):
        distances[i], faces[i, 0], faces[i, 1], places[i, 0], places[i, 1], places[i, 2] = nearest(
            one, x[i, 0], x[i, 1], x[i, 2], reach
        )


@kernel
def stopping_faces(triangles, k, ways, fixed, tolerance, normals, offsets):
    """Write :func:`faces_at` of nodes that move from ``ways[0]`` to ``ways[1]``, (2, m, 3) relative to surface k, with
    the ``fixed`` components (m, 3) bool and the tolerance (m,), into normals (m, 3, 3) and offsets (m, 3)."""
    one = surface(triangles, k)
    for i in range(ways.shape[1]):
        faces_at(one, ways[0, i], ways[1, i], fixed[i], tolerance[i], normals[i], offsets[i])

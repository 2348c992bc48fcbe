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

from ..mechanics.compiled import inlined, kernel
from ..mechanics.records import record
from .projection import project

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
def _arm(points, normals, x, y, z):
    """Return the vector from the nearest place of a triangle (3, 3) to a point, and what that lies on: 0 the face, 1 to
    3 an edge, 4 to 6 a corner (C. Ericson, Real-Time Collision Detection, 2005, section 5.1.5)."""
    ux, uy, uz = points[1, 0] - points[0, 0], points[1, 1] - points[0, 1], points[1, 2] - points[0, 2]
    vx, vy, vz = points[2, 0] - points[0, 0], points[2, 1] - points[0, 1], points[2, 2] - points[0, 2]
    x, y, z = x - points[0, 0], y - points[0, 1], z - points[0, 2]
    uu, uv, vv = ux * ux + uy * uy + uz * uz, ux * vx + uy * vy + uz * vz, vx * vx + vy * vy + vz * vz
    along_u, along_v = x * ux + y * uy + z * uz, x * vx + y * vy + z * vz
    if along_u <= 0.0 and along_v <= 0.0:
        return x, y, z, 4
    if along_u >= uu and along_v - uv <= along_u - uu:
        return x - ux, y - uy, z - uz, 5
    if along_v >= vv and along_u - uv <= along_v - vv:
        return x - vx, y - vy, z - vz, 6
    # areas opposite the corners, times 2 |u x v|
    third = uu * along_v - uv * along_u
    second = vv * along_u - uv * along_v
    if third <= 0.0 and along_u >= 0.0 and along_u <= uu:
        part = along_u / uu
        return x - part * ux, y - part * uy, z - part * uz, 1
    if second <= 0.0 and along_v >= 0.0 and along_v <= vv:
        part = along_v / vv
        return x - part * vx, y - part * vy, z - part * vz, 3
    if uu * vv - uv * uv - second - third <= 0.0:
        part = (along_v - uv - along_u + uu) / (uu + vv - 2.0 * uv)
        x, y, z = x - ux - part * (vx - ux), y - uy - part * (vy - uy), z - uz - part * (vz - uz)
        return x, y, z, 2
    nx, ny, nz = normals[0, 0], normals[0, 1], normals[0, 2]
    gap = x * nx + y * ny + z * nz
    return gap * nx, gap * ny, gap * nz, 0


@inlined
def _away(box, x, y, z):
    """Return the squared distance of a point from a box (6,)."""
    x = max(box[0] - x, x - box[3], 0.0)
    y = max(box[1] - y, y - box[4], 0.0)
    z = max(box[2] - z, z - box[5], 0.0)
    return x * x + y * y + z * z


@inlined
def _after(k):
    """Return the box of the tree that follows box k and all that it has; 1 after the last."""
    k += 1
    while k & 1 == 0:
        k >>= 1
    return k


@inlined
def nearest(triangles, x, y, z, reach):
    """Return the signed distance of a point from a surface, negative behind it [m]; the nearest face, of equally near
    ones the first; what of it is nearest, an index of its ``normals``; and the nearest place [m].

    The distance is infinite, and the face -1, for a point that is farther away than ``reach`` [m].
    """
    points, normals, boxes = triangles.points, triangles.normals, triangles.boxes
    n, leaves = len(points), len(boxes) >> 1
    best, face, feature = reach * reach, -1, 0
    ax, ay, az = math.inf, 0.0, 0.0
    k, descends = 1, True
    if _away(boxes[1], x, y, z) <= best:
        while k < leaves:  # the leaf that is likely to have it comes first, so that the others are far
            k *= 2
            k += _away(boxes[k + 1], x, y, z) < _away(boxes[k], x, y, z)
        while True:
            if _away(boxes[k], x, y, z) <= best:
                if k < leaves:
                    k *= 2
                    continue
                for j in range(n * (k - leaves) // leaves, n * (k - leaves + 1) // leaves):
                    bx, by, bz, part = _arm(points[j], normals[j], x, y, z)
                    square = bx * bx + by * by + bz * bz
                    if square < best or (square == best and (face < 0 or j < face)):
                        best, face, feature = square, j, part
                        ax, ay, az = bx, by, bz
            if descends:
                descends = False
                k = 1
                continue
            k = _after(k)
            if k == 1:
                break
    if face < 0:
        return math.inf, face, feature, x, y, z
    m = normals[face, feature]
    side = 1.0 if m[0] * ax + m[1] * ay + m[2] * az >= 0.0 else -1.0
    return side * math.sqrt(best), face, feature, x - ax, y - ay, z - az


@inlined
def _gap(triangles, face, place):
    """Return the distance of a place (3,) from the plane of a face [m]."""
    points, normals = triangles.points[face], triangles.normals[face]
    gap = 0.0
    for c in range(3):
        gap += normals[0, c] * (place[c] - points[0, c])
    return gap


@inlined
def _square(one, other):
    """Return the squared distance of two places (3,) [m2]."""
    return (one[0] - other[0]) ** 2 + (one[1] - other[1]) ** 2 + (one[2] - other[2]) ** 2


@inlined
def _passed(triangles, face, start, place, when, near, ahead):
    """Return whether a way that leads behind a face at its border remains ``ahead`` [m] of the other face of a convex
    edge there."""
    points, normals, boxes = triangles.points, triangles.normals, triangles.boxes
    both = triangles.limits[0, 0] > 0.0
    n, leaves = len(points), len(boxes) >> 1
    x = start[0] + when * (place[0] - start[0])
    y = start[1] + when * (place[1] - start[1])
    z = start[2] + when * (place[2] - start[2])
    k = 1
    while True:
        if _away(boxes[k], x, y, z) <= near * near:
            if k < leaves:
                k *= 2
                continue
            for j in range(n * (k - leaves) // leaves, n * (k - leaves + 1) // leaves):
                side = -1.0 if both and _gap(triangles, j, start) < 0.0 else 1.0
                if j == face or side * _gap(triangles, j, place) < ahead:
                    continue
                ax, ay, az, _ = _arm(points[j], normals[j], x, y, z)
                side = -1.0 if both and _gap(triangles, face, start) < 0.0 else 1.0
                bend = _gap(triangles, face, points[j, 0]) + _gap(triangles, face, points[j, 1])
                bend = side * (bend + _gap(triangles, face, points[j, 2]))
                if ax * ax + ay * ay + az * az <= near * near and bend < -triangles.limits[0, 2]:
                    return True
        k = _after(k)
        if k == 1:
            return False


@inlined
def _crossed(triangles, start, place, tolerance, least):
    """Return the first face through which a node moves from ``start`` to a ``place`` behind it by more than ``least``,
    of faces at one place that behind which it is the least; -1 if there is none.

    A ``start`` that is behind a face by no more than the tolerance is in front of it.
    """
    points, normals, boxes = triangles.points, triangles.normals, triangles.boxes
    both, rounding = triangles.limits[0, 0] > 0.0, triangles.limits[0, 2]
    n, leaves = len(points), len(boxes) >> 1
    found, soonest, highest = -1, math.inf, -math.inf
    slack = max(tolerance, rounding)
    way = math.sqrt(_square(start, place))
    # a node that falls on an edge along one of its faces is stopped, one that has been stopped moves along them
    ahead = -least if least > 0.0 else rounding
    k = 1
    while True:
        box = boxes[k]
        meets = True
        for c in range(3):
            low, high = min(start[c], place[c]), max(start[c], place[c])
            meets = meets and low <= box[c + 3] + slack and high >= box[c] - slack
        if meets:
            if k < leaves:
                k *= 2
                continue
            for j in range(n * (k - leaves) // leaves, n * (k - leaves + 1) // leaves):
                before, after = _gap(triangles, j, start), _gap(triangles, j, place)
                if both and before < 0.0:
                    before, after = -before, -after
                if before < -slack or after >= -least or after >= before:
                    continue
                when = max(before, 0.0) / (max(before, 0.0) - after)
                if when > soonest or (when == soonest and after <= highest):
                    continue
                x = start[0] + when * (place[0] - start[0])
                y = start[1] + when * (place[1] - start[1])
                z = start[2] + when * (place[2] - start[2])
                x, y, z, part = _arm(points[j], normals[j], x, y, z)
                # where a way that is almost parallel to the face crosses it is known but roughly
                near = rounding * (1.0 + way / (before - after))
                if x * x + y * y + z * z - min(before, 0.0) ** 2 <= near * near and not _passed(
                    triangles, j, start, place, when, max(near, slack), ahead
                ):
                    found, soonest, highest = j, when, after
        k = _after(k)
        if k == 1:
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
        for c in range(3):
            place[0, c], held[0, c], levels[0, c], moves[0, c] = free[c], fixed[c], -math.inf, 0.0
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
            level = clearance
            for c in range(3):
                planes[0, slot, c] = side * triangles.normals[face, 0, c]
                level += planes[0, slot, c] * triangles.points[face, 0, c]
            levels[0, slot], count = level, max(count, slot + 1)
            for c in range(3):
                place[0, c] = free[c]
            if project(place, held, planes, levels, rounding, moves) >= 0:
                face = -1  # the caller finds the same
                break
        if face < 0:
            break
    if face >= 0:  # more than three planes: the node stays where it is
        way = math.sqrt(_square(start, free))
        levels[0, 0], levels[0, 1], levels[0, 2], count = 0.0, -math.inf, -math.inf, 1
        for c in range(3):
            planes[0, 0, c] = (start[c] - free[c]) / way
            levels[0, 0] += planes[0, 0, c] * start[c]
    for k in range(3):
        offsets[k] = levels[0, k]
        for c in range(3):
            normals[k, c] = planes[0, k, c]
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

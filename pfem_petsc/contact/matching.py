"""Nearest neighbours across a direction: how the nodes of a pair table find each other.

Points are sorted into the cells of a square grid in the plane across the direction, about one point a cell, and each
query looks at rings of cells around its own until no cell left can hold a nearer point.
"""

from __future__ import annotations

import numpy as np

__all__ = ["nearest_across"]

_CHUNK = 1 << 21  # candidates looked at in one go


def nearest_across(points: np.ndarray, queries: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Indices (m,) of the points (n, 3) that are nearest to queries (m, 3) across a unit vector; n >= 1.

    Of points at the same distance, to the last bit, the first one is taken.
    """
    points = points - np.outer(points @ normal, normal)
    queries = queries - np.outer(queries @ normal, normal)
    return _Grid(points, normal).nearest(queries)


class _Grid:
    """Points (n, 3) in a plane through the origin, in square cells."""

    def __init__(self, points: np.ndarray, normal: np.ndarray) -> None:
        self.points = points
        axis = np.eye(3)[np.argmin(np.abs(normal))]
        first = np.cross(normal, axis)
        first /= np.linalg.norm(first)
        self.axes = np.stack([first, np.cross(normal, first)], axis=1)
        flat = points @ self.axes
        self.low, self.high = flat.min(axis=0), flat.max(axis=0)
        extent, n = self.high - self.low, len(points)
        # of points on a line the area is none
        self.edge = max(float(np.sqrt(extent.prod() / n)), float(extent.max()) / n) or 1.0
        self.rounding = 1e-12 * float(np.abs(flat).max()) + 1e-300
        self.shape = np.floor(extent / self.edge).astype(np.int64) + 1
        cells = self._cells(flat)
        keys = cells[:, 0] * self.shape[1] + cells[:, 1]
        self.order = np.argsort(keys, kind="stable")
        self.keys = keys[self.order]

    def _cells(self, flat: np.ndarray) -> np.ndarray:
        return np.clip(np.floor((flat - self.low) / self.edge).astype(np.int64), 0, self.shape - 1)

    def nearest(self, queries: np.ndarray) -> np.ndarray:
        """Indices (m,) of the points nearest to queries (m, 3) in the plane."""
        flat = queries @ self.axes
        inside = np.clip(flat, self.low, self.high)
        # the points lie in a box: p is no nearer to a query than sqrt(|q - c|^2 + |c - p|^2), c the box's nearest place
        outside = ((flat - inside) ** 2).sum(axis=1)
        cells = self._cells(inside)
        best, distance = np.full(len(queries), len(self.points)), np.full(len(queries), np.inf)
        left = np.arange(len(queries))
        for ring in range(int(self.shape.max()) + 1):
            for begin, end in self._ranges(cells[left], ring):
                self._look(queries, left, begin, end, best, distance)
            reached = np.maximum(ring * self.edge - self.rounding, 0.0) ** 2 + (1.0 - 1e-12) * outside[left]
            left = left[distance[left] * (1.0 + 1e-12) >= reached]
            if len(left) == 0:
                break
        return best

    def _ranges(self, cells: np.ndarray, ring: int):
        """For each run of cells of the ring around cells (m, 2): the places (m,), (m,) of its points in the order."""
        for row in range(-ring, ring + 1):
            runs = [(-ring, ring)] if abs(row) == ring else [(-ring, -ring), (ring, ring)]
            at = cells[:, 0] + row
            for first, last in runs:
                low, high = cells[:, 1] + first, cells[:, 1] + last
                there = (at >= 0) & (at < self.shape[0]) & (high >= 0) & (low < self.shape[1])
                key = at * self.shape[1]
                begin = np.searchsorted(self.keys, key + np.maximum(low, 0))
                end = np.searchsorted(self.keys, key + np.minimum(high, self.shape[1] - 1), side="right")
                yield begin, np.where(there, end, begin)

    def _look(self, queries, left, begin, end, best, distance) -> None:
        """Compare queries ``left`` with their points at begin..end of the order; best and distance are brought up."""
        counts = end - begin
        met = np.flatnonzero(counts)
        parts = np.flatnonzero(np.diff(np.cumsum(counts[met]) // _CHUNK)) + 1
        for some in np.split(met, parts):
            if len(some) == 0:
                continue
            count = counts[some]
            starts = np.append(0, np.cumsum(count)[:-1])
            place = np.arange(count.sum()) + np.repeat(begin[some] - starts, count)
            found, query = self.order[place], left[some]
            square = ((self.points[found] - np.repeat(queries[query], count, axis=0)) ** 2).sum(axis=1)
            least = np.minimum.reduceat(square, starts)
            first = np.minimum.reduceat(np.where(square == np.repeat(least, count), found, len(self.points)), starts)
            nearer = (least < distance[query]) | ((least == distance[query]) & (first < best[query]))
            best[query[nearer]], distance[query[nearer]] = first[nearer], least[nearer]

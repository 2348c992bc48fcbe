"""Detection of bars across walls: only nodes are in contact, so a bar can pass through a wall between its nodes.

The regions that planes and the inside of spheres and cylinders allow are convex, so a bar whose ends lie in them does
too. Outside a sphere or a cylinder, a bar whose ends touch it is a chord, which is normal; only a bar deeper than a
quarter of the radius is reported. A bar crosses a rectangle if its ends lie on opposite sides of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

if TYPE_CHECKING:
    from ..stepping.model import Model
    from .walls.base import BaseWall

__all__ = ["DEEP", "Piercing", "distances", "small_walls"]

DEEP = 0.25
"""Depth, as a fraction of the radius, beyond which a bar inside a curved wall is reported."""


def small_walls(walls: Sequence[BaseWall]) -> list[int]:
    """Return the indices of the walls that a bar can cross while its nodes satisfy them."""
    return [k for k, wall in enumerate(walls) if wall.partial or getattr(wall, "sign", -1.0) > 0.0]


def distances(starts: np.ndarray, ends: np.ndarray, point: np.ndarray, axis: np.ndarray | None) -> np.ndarray:
    """Return distances (m,) [m] of segments (m, 3) from a point, or from the line through it along a unit ``axis``."""
    first, way = starts - point, ends - starts
    if axis is not None:
        first, way = first - np.outer(first @ axis, axis), way - np.outer(way @ axis, axis)
    squares = np.einsum("ij,ij->i", way, way)
    part = -np.einsum("ij,ij->i", first, way) / np.maximum(squares, np.finfo(float).tiny)
    return np.linalg.norm(first + np.clip(part, 0.0, 1.0)[:, None] * way, axis=1)


def _crossing(wall: BaseWall, starts: np.ndarray, ends: np.ndarray, slack: float) -> np.ndarray:
    """Return (m,) bool: segments, relative to the rectangle at rest, that cross it."""
    first, second = starts @ wall.normal - wall.offset, ends @ wall.normal - wall.offset
    across = np.minimum(first, second) < -slack
    across &= np.maximum(first, second) > slack
    part = np.where(across, first / np.where(across, first - second, 1.0), 0.0)
    point = starts + part[:, None] * (ends - starts) - wall.centre
    return across & (np.abs(point @ wall.first) < wall.half[0]) & (np.abs(point @ wall.second) < wall.half[1])


class Piercing:
    """Detects bars across walls in each snapshot. Construction is collective.

    Attributes
    ----------
    walls : indices of the walls that are checked
    first : wall to the time [s] of the first snapshot with a bar across it
    seen : wall to the number of snapshots with bars across it
    looks : number of snapshots checked
    """

    def __init__(self, model: Model) -> None:
        self._model = model
        self.walls = small_walls(model.contact.walls)
        self.first: dict[int, float] = {}
        self.seen = dict.fromkeys(self.walls, 0)
        self.looks = 0
        if not self.walls:
            return
        mesh = model.mesh
        members = np.zeros((mesh.n_local, len(self.walls)))
        members[: mesh.n_owned] = model.contact.members[:, self.walls]
        mesh.update_ghosts(members)
        self._bars = mesh.bars[mesh.counted]
        self._applicable = (members[self._bars[:, 0]] > 0.0) & (members[self._bars[:, 1]] > 0.0)

    def look(self, x: np.ndarray, time: float) -> list[str]:
        """Return new messages about bars at positions (local, 3), ghosts included. Collective."""
        if not self.walls:
            return []
        self.looks += 1
        displacements = self._model.contact.motion.displacements(time)
        found = np.array([self._across(i, k, x, displacements[k]) for i, k in enumerate(self.walls)])
        counts, lowest = found[:, 0].copy(), found[:, 1].copy()
        comm = self._model.comm
        comm.Allreduce(MPI.IN_PLACE, counts, op=MPI.SUM)
        comm.Allreduce(MPI.IN_PLACE, lowest, op=MPI.MIN)
        told = []
        for count, bar, k in zip(counts.tolist(), lowest.tolist(), self.walls, strict=True):
            self.seen[k] += count > 0
            if count and k not in self.first:
                self.first[k] = time = self._model.origin + time
                bars = f"bar {bar} intersects" if count == 1 else f"{count} bars, including bar {bar}, intersect"
                told.append(
                    f"t = {time:.6g} s: {bars} wall {self._model.contact.names[k]!r}: only nodes touch walls; "
                    "use shorter bars or a larger wall"
                )
        return told

    def _across(self, i: int, k: int, x: np.ndarray, shift: np.ndarray) -> tuple[int, int]:
        """Return the number of this rank's bars across wall ``k``, and the lowest of their mesh numbers."""
        mesh, wall = self._model.mesh, self._model.contact.walls[k]
        rows = np.flatnonzero(self._applicable[:, i])
        starts, ends = x[self._bars[rows, 0]] - shift, x[self._bars[rows, 1]] - shift
        if wall.partial:
            across = _crossing(wall, starts, ends, 1e-6 * self._model.length)
        else:
            across = distances(starts, ends, wall.centre, getattr(wall, "axis", None)) < (1.0 - DEEP) * wall.radius
        ids = mesh.bar_ids[mesh.counted][rows[across]]
        return len(ids), int(ids.min()) if len(ids) else int(np.iinfo(np.int64).max)

    def summary(self) -> list[str]:
        """Return messages for the end of the run."""
        names = self._model.contact.names
        return [
            f"bars intersected wall {names[k]!r} in {self.seen[k]} of {self.looks} snapshots, first at t = "
            f"{self.first[k]:.6g} s: only nodes touch walls"
            for k in self.walls
            if k in self.first
        ]

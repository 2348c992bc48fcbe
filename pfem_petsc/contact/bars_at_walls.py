"""Bars at walls between their nodes: springs where the axis of a bar is beyond the surface of a wall, and reports of
bars that intersect walls.

Nodes do not pass walls, but a bar between them may pass through a sphere, a cylinder or over the edge of a surface of
triangles. With the least distance g of its axis from the surface, at the part t of its length, the energy of a bar
there is k/2 min(g, 0)^2. As g is a minimum over t, the force acts at t, and where two faces meet there, along the mean
of their normals that does not change g along the axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import acosh, asin, exp, pi, sqrt, tan
from typing import TYPE_CHECKING, Any

import numpy as np

from .wall_motion import Poses
from .walls.base import deepest

if TYPE_CHECKING:
    from .walls.base import BaseWall

_SHARE = 0.2  # of the lighter node's mass over the square of the step, and of what this leaves, that is the stiffness
_CRITICAL = exp(-2.0)  # restitution of a damper with which nothing swings back; walls with less get it
_BESIDE = 1e-7  # part of the length at which normals beside the place are taken
_BEFORE = "bars_before"  # array of the state: positions one step before the last evaluation
_SKIN = 0.5  # distance from a wall up to which bars are listed, over the mean length of bars


def restitution_of(damping: float) -> float:
    """Return the ratio of velocities after and before an impact on a spring and a damper that never pull.

    Source: Schwager and Pöschel, Granular Matter 9 (2007), 465, in terms of the damping ratio.
    """
    if damping < 1.0:
        angle = asin(damping)
        return exp(-tan(angle) * (pi - 2.0 * angle))
    if damping == 1.0:
        return exp(-2.0)
    return exp(-2.0 * damping / sqrt(damping * damping - 1.0) * acosh(damping))


def damping_of(restitution: float) -> float:
    """Return the damping ratio for :func:`restitution_of`, by bisection."""
    low, high = 0.0, 1e3
    for _ in range(100):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if restitution_of(middle) > restitution else (low, middle)
    return 0.5 * (low + high) if restitution < 1.0 else 0.0


def small_walls(walls: Sequence[BaseWall]) -> list[int]:
    """Return the indices of the walls that a bar can cross while its nodes satisfy them."""
    return [k for k, wall in enumerate(walls) if np.isfinite(wall.width)]


def _applying(model: Any, walls: list[int], bars: np.ndarray | slice) -> np.ndarray:
    """Return (m, walls) bool: walls that stop both nodes of bars (m,). Collective."""
    contact, mesh = model.contact, model.mesh
    members = np.zeros((mesh.n_local, len(walls)))
    members[: mesh.n_owned] = contact.members[:, contact.first[walls]]
    if walls:
        mesh.update_ghosts(members)
    return (members[mesh.bars[bars]] > 0.0).all(axis=1)


class BarsAtWalls:
    """Bars of this rank, those of ``[self_contact]``, and the walls that they can cross between their nodes.

    Attributes
    ----------
    walls : indices of these walls
    energy : stored in the springs of this rank's counted bars [J]
    force : (owned, 3) on nodes at the positions of the last evaluation [N]
    last_step : the step before the last evaluation [s]
    sums : (2, walls, 3) forces of walls on this rank's counted bars [N], and their moments about the origin [N m]
    """

    def __init__(self, model: Any, chosen: np.ndarray) -> None:
        contact, mesh = model.contact, model.mesh
        self._model, self._contact, self._mesh = model, contact, mesh
        self.walls = [k for k in small_walls(contact.walls) if contact.walls[k].closed]
        self._bars = np.flatnonzero(chosen)
        counted = np.zeros(len(mesh.bars), dtype=bool)
        counted[mesh.counted] = True
        self._counted = counted[self._bars]
        self._applies, mass = _applying(model, self.walls, self._bars), np.zeros((mesh.n_local, 1))
        mass[: mesh.n_owned, 0] = model.inertia.mass
        mesh.update_ghosts(mass)
        self._mass = mass[mesh.bars[self._bars], 0]
        lengths = model.bars.mesh_lengths[self._bars]
        self._skin = _SKIN * float(lengths.mean()) if len(lengths) else 0.0
        self._near: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self._before, self.last_step = mesh.points.copy(), 0.0
        self.energy, self.force, self.sums = 0.0, np.zeros((mesh.n_owned, 3)), np.zeros((2, len(contact.walls), 3))

    def _candidates(self, k: int, x: np.ndarray, poses: Poses) -> np.ndarray:
        """Return the bars (m,), of those here, that may cross wall k, with nodes at x (local, 3) [m]."""
        there = poses.rest(k, x)
        if k in self._near:
            bars, before = self._near[k]
            if np.abs(there - before).max(initial=0.0) * sqrt(3.0) < 0.5 * self._skin:
                return bars
        a, b = there[self._mesh.bars[self._bars]].swapaxes(0, 1)
        near = self._contact.walls[k].gaps(0.5 * (a + b)) < 0.5 * np.linalg.norm(b - a, axis=1) + self._skin
        bars = np.flatnonzero(near & self._applies[:, self.walls.index(k)])
        self._near[k] = bars, there.copy()
        return bars

    def evaluate(self, x: np.ndarray, h: float) -> float:
        """Find the forces at positions x (local, 3) [m], a step of ``h`` [s] after the last ones; return the energy
        that this rank's counted bars have lost in it [J]."""
        contact, mesh, before, time = self._contact, self._mesh, self._before, self._contact.state.time
        poses, earlier = contact.motion.poses(time), contact.motion.poses(time - h)
        total, sums = np.zeros((len(x), 3)), np.zeros((2, len(contact.walls), 3))
        self.energy = lost = 0.0
        for k in self.walls:
            bars = self._candidates(k, x, poses)
            ends = mesh.bars[self._bars[bars]]
            t, gaps = deepest(contact.walls[k].gaps, poses.rest(k, x[ends]))
            found = gaps < 0.0
            if not found.any():
                continue
            bars, ends, t, gaps = bars[found], ends[found], t[found], gaps[found]
            weights = np.stack([1.0 - t, t], axis=1)
            normals = poses.turned(k, self._normals(k, poses.rest(k, x[ends]), t))
            point, start = (np.einsum("me,mei->mi", weights, at[ends]) for at in (x, before))
            slip = point - start - earlier.ways(poses, start)[:, k]
            mobility = (weights**2 / self._mass[bars]).sum(axis=1)
            # theirs along the axis, unless the step requires less
            most = _SHARE * self._model.self_contact.room * self._mass[bars].min(axis=1)
            stiffness = np.minimum(most, self._model.bars.stiffness[self._bars[bars]])
            closing = np.einsum("mi,mi->m", normals, slip)
            push = -stiffness * gaps
            normal = self._damped(k, push, closing, stiffness, mobility, h)
            along = slip - closing[:, None] * normals / np.einsum("mi,mi->m", normals, normals)[:, None]
            size = np.linalg.norm(along, axis=1)
            most = 0.5 * size / (mobility * h * h) if h > 0.0 else size * 0.0
            drag = np.minimum(contact.friction[contact.first[k]] * normal, most)
            force = normal[:, None] * normals - (drag / np.maximum(size, 1e-300))[:, None] * along
            mine = self._counted[bars]
            self.energy += 0.5 * float((stiffness * gaps * gaps)[mine].sum())
            half = 0.5 * h * h * mobility  # to the end of the step, by which forces change the way
            lost += float((drag * (size - half * drag) - (normal - push) * (closing + half * normal))[mine].sum())
            np.add.at(total, ends, weights[:, :, None] * force[:, None, :])
            sums[0, k], sums[1, k] = force[mine].sum(axis=0), np.cross(point, force)[mine].sum(axis=0)
        self.force, self.sums, self._before, self.last_step = total[: mesh.n_owned], sums, x.copy(), h
        contact.state.memory[_BEFORE] = before[: mesh.n_owned]
        return lost

    def resume(self, x: np.ndarray, h: float) -> None:
        """Go on at positions (owned, 3) [m] from a checkpoint, written a step of ``h`` [s] after the last evaluation
        but one. Collective."""
        mesh, memory, here = self._mesh, self._contact.state.memory, np.zeros_like(self._before)
        if _BEFORE in memory:
            for array, values in ((here, x), (self._before, memory[_BEFORE])):
                array[: mesh.n_owned] = values
                mesh.update_ghosts(array)
            self.evaluate(here, h)

    def _damped(
        self, k: int, push: np.ndarray, closing: np.ndarray, stiffness: np.ndarray, mobility: np.ndarray, h: float
    ) -> np.ndarray:
        """Return the forces (m,) of springs with a damper, which pull never [N]; the velocity is that at the end of the
        step, half a step later, by the force itself."""
        restitution = float(self._contact.restitution[self._contact.first[k]])
        if restitution >= 1.0 or h <= 0.0:
            return push
        drag = 2.0 * damping_of(max(restitution, _CRITICAL)) * np.sqrt(stiffness / mobility)
        return np.maximum((push - drag * closing / h) / (1.0 + 0.5 * drag * h * mobility), 0.0)

    def _normals(self, k: int, ends: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Return the derivatives (m, 3) of the least distances by the positions of the places ``t`` (m,)."""
        along = ends[:, 1] - ends[:, 0]
        points, wall = ends[:, 0] + t[:, None] * along, self._contact.walls[k]
        behind, ahead = (wall.planes(points + side * _BESIDE * along)[0] for side in (-1.0, 1.0))
        falls, rises = (np.einsum("mi,mi->m", normal, along) for normal in (behind, ahead))
        share = np.where(rises > falls, np.clip(rises / np.where(rises > falls, rises - falls, 1.0), 0.0, 1.0), 0.5)
        mean = share[:, None] * behind + (1.0 - share)[:, None] * ahead
        return mean - (np.einsum("mi,mi->m", mean, along) / np.einsum("mi,mi->m", along, along))[:, None] * along


class Piercing:
    """Detects bars across walls in each snapshot. Construction is collective.

    Attributes
    ----------
    walls : indices of the walls that are checked
    first : wall to the step and time of the first snapshot with a bar across it, as texts
    seen : wall to the number of snapshots with bars across it
    looks : number of snapshots checked
    """

    def __init__(self, model: Any) -> None:
        self._model = model
        self.walls = small_walls(model.contact.walls)
        self.first: dict[int, str] = {}
        self.seen = dict.fromkeys(self.walls, 0)
        self.looks = 0
        if not self.walls:
            return
        self._bars = model.mesh.bars[model.mesh.counted]
        self._applicable = _applying(model, self.walls, model.mesh.counted)

    def look(self, x: np.ndarray, time: float, at: str) -> list[str]:
        """Return new messages about bars at positions (local, 3), ghosts included. Collective.

        ``time`` is that of the stage [s], ``at`` the step and the time for messages.
        """
        if not self.walls:
            return []
        self.looks += 1
        poses = self._model.contact.motion.poses(time)
        here = [self._across(i, k, x, poses) for i, k in enumerate(self.walls)]
        found = np.array(self._model.comm.allgather(here))
        counts, lowest = found[:, :, 0].sum(axis=0), found[:, :, 1].min(axis=0)
        told = []
        for count, bar, k in zip(counts.tolist(), lowest.tolist(), self.walls, strict=True):
            self.seen[k] += count > 0
            if count and k not in self.first:
                self.first[k] = at
                bars = f"bar {bar} intersects" if count == 1 else f"{count} bars, including bar {bar}, intersect"
                told.append(
                    f"{at}: {bars} wall {self._model.contact.names[k]!r}: only nodes touch walls; "
                    "use shorter bars or a larger wall"
                )
        return told

    def _across(self, i: int, k: int, x: np.ndarray, poses: Poses) -> tuple[int, int]:
        """Return the number of this rank's bars across wall ``k``, and the lowest of their mesh numbers."""
        mesh, wall = self._model.mesh, self._model.contact.walls[k]
        rows = np.flatnonzero(self._applicable[:, i])
        starts, ends = (poses.rest(k, x[self._bars[rows, end]]) for end in (0, 1))
        ids = mesh.bar_ids[mesh.counted][rows[wall.crossed(starts, ends)]]
        return len(ids), int(ids.min()) if len(ids) else int(np.iinfo(np.int64).max)

    def summary(self) -> list[str]:
        """Return messages for the end of the run, about walls that bars intersected again after the first message."""
        names = self._model.contact.names
        return [
            f"bars intersected wall {names[k]!r} in {self.seen[k]} of {self.looks} snapshots, first at "
            f"{self.first[k]}: only nodes touch walls"
            for k in self.walls
            if self.seen[k] > 1
        ]

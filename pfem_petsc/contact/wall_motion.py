"""Motion of walls: prescribed displacements and rotations, and where walls with mass are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple, Self

import numpy as np

from ..mechanics.motion import Motion, motion_of, rotation_of
from .free_walls import FreeWalls
from .rotations import turns_about

if TYPE_CHECKING:
    from .walls.base import WallKeys


_LATEST = 8  # times whose poses are kept


class Poses(NamedTuple):
    """Where walls (w,) are at a time [s]: a point X of a wall at rest is at ``turns`` X + ``shifts``; (w, 3, 3) and
    (w, 3) [m]. The former is (0, 3, 3) if no wall turns."""

    shifts: np.ndarray
    turns: np.ndarray
    time: float = 0.0

    def rest(self, k: int, x: np.ndarray) -> np.ndarray:
        """Return where points of wall k at (m, 3) are at rest."""
        x = x - self.shifts[k]
        return x @ self.turns[k] if len(self.turns) else x

    def carried(self, walls: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Return where points of walls (m,) are that are at (m, 3) at rest, each of one wall."""
        return (np.einsum("mij,mj->mi", self.turns[walls], x) if len(self.turns) else x) + self.shifts[walls]

    def turned(self, k: int, vectors: np.ndarray) -> np.ndarray:
        """Return vectors (m, 3) that turn with wall k, given at rest."""
        return vectors @ self.turns[k].T if len(self.turns) else vectors

    def ways(self, later: Self, x: np.ndarray) -> np.ndarray:
        """Return how far the points of all walls at (m, 3) are from there at ``later`` poses, (m, w, 3) [m]."""
        if not len(self.turns):
            return np.broadcast_to(later.shifts - self.shifts, (len(x), *self.shifts.shape))
        moved = np.einsum("wij,mwj->mwi", later.turns @ self.turns.swapaxes(1, 2), x[:, None, :] - self.shifts)
        return moved + later.shifts - x[:, None, :]


class WallMotion:
    """Displacements and rotations of all walls of a case.

    Attributes
    ----------
    moving, turning : (w,) bool, walls that move, and those of them that turn
    bodies : FreeWalls, the walls with mass
    held : Poses at the start of a stage of walls that stay in force and rest there

    Parameters
    ----------
    centres : (w, 3) centres of mass of walls at rest [m]
    holds : whether the walls are those of the stage before
    """

    def __init__(self, walls: Sequence[WallKeys], centres: np.ndarray, holds: bool = False) -> None:
        self._motions = [None if holds or wall.mass is not None else motion_of(wall) for wall in walls]
        self._rotations = [None if holds else rotation_of(wall) for wall in walls]
        n = len(walls)
        rotates = np.array([wall.rotation is not None for wall in walls], dtype=bool)
        self.turning = rotates | np.array([wall.inertia is not None for wall in walls], dtype=bool)
        self.held = Poses(np.zeros((n, 3)), np.tile(np.eye(3), (n if self.turning.any() else 0, 1, 1)))
        self._last: tuple[Poses, dict[tuple[float, int], Poses]] = self.held, {}
        self._axes, self._centres = np.zeros((2, n, 3))
        for k in np.flatnonzero(self.turning & ~rotates):
            self._centres[k] = centres[k] if walls[k].hinge is None else walls[k].hinge.centre
        for k in np.flatnonzero(rotates):
            axis = np.array(walls[k].rotation.axis)
            self._axes[k], self._centres[k] = axis / np.linalg.norm(axis), walls[k].rotation.centre
        self.bodies = FreeWalls([])  # until their scheme is known
        moves = [wall.velocity is not None or wall.motion is not None or wall.mass is not None for wall in walls]
        self.moving = np.array(moves, dtype=bool) | self.turning

    def _prescribed(self, motions: list[Motion | None], quantity: int, time: float, ahead: bool = True) -> np.ndarray:
        """Return the displacements, velocities or accelerations (w, 3) of motions at a time [s], zero for none."""
        values = np.zeros((len(motions), 3))
        for k, motion in enumerate(motions):
            if motion is not None:
                values[k] = motion.at(time, ahead=ahead)[quantity]
        return values

    def displacements(self, time: float) -> np.ndarray:
        """Return displacements (w, 3) [m] at a time [s], those of the centres of rotation of walls that turn."""
        displacements = self._prescribed(self._motions, 0, time)
        displacements[self.bodies.at] = self.bodies.displacements(time)
        return displacements

    def poses(self, time: float) -> Poses:
        """Return where walls are at a time [s], read-only."""
        if self._last[0] is not self.held or len(self._last[1]) > _LATEST:
            self._last = self.held, {}
        known, key = self._last[1], (time, self.bodies.version(time))
        if key not in known:
            known[key] = self._poses(time)
        return known[key]

    def poses_without_contact(self, time: float) -> Poses:
        """Return where walls were at the end of the step being solved, at a time [s], if nodes did not push them."""
        return self._poses(time, *self.bodies.unpushed())

    def _poses(self, time: float, moved: np.ndarray | None = None, turned_by: np.ndarray | None = None) -> Poses:
        """Return where walls are at a time [s], those with mass by displacements and turns, default: theirs."""
        held, bodies = self.held, self.bodies
        shifts, turns = held.shifts + self._prescribed(self._motions, 0, time), held.turns
        shifts[bodies.at] = bodies.displacements(time) if moved is None else moved
        if not len(turns):
            return Poses(shifts, turns, time)
        turned = turns_about(self._axes, self._prescribed(self._rotations, 0, time)[:, 0])
        turns = turned @ turns
        turns[bodies.at[bodies.turners]] = bodies.turned(time) if turned_by is None else turned_by
        about = turned.copy()
        about[bodies.at] = turns[bodies.at]
        return Poses(shifts + self._centres - np.einsum("wij,wj->wi", about, self._centres), turns, time)

    def schedule(self, times: np.ndarray) -> np.ndarray:
        """Return displacements [m] and velocities [m/s] (t, 2, w, 3) of walls with prescribed motion at times (t,) [s];
        at the kinks of a linear table the right limit."""
        values = np.zeros((len(times), 2, len(self._motions), 3))
        values[:, 0] = self.held.shifts
        for k, motion in enumerate(self._motions):
            if motion is not None:
                values[:, :, k] += motion.at(times)[:, :2]
        return values

    def turns(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return angles (t, w) [rad] and :class:`Poses` (t, w, 12), the elements of the turns and shifts, of walls with
        prescribed motion at times (t,) [s]."""
        size, angles = (len(times), len(self._motions)), np.zeros((len(times), len(self._motions)))
        for k, rotation in enumerate(self._rotations):
            if rotation is not None:
                angles[:, k] = rotation.at(times)[:, 0, 0]
        turned = turns_about(np.tile(self._axes, (len(times), 1)), angles.ravel()).reshape(*size, 3, 3)
        shifts = self.schedule(times)[:, 0] + self._centres - np.einsum("twij,wj->twi", turned, self._centres)
        if len(self.held.turns):
            turned = turned @ self.held.turns
        return angles, np.concatenate([turned.reshape(*size, 9), shifts], axis=2)

    @property
    def pivots(self) -> tuple[np.ndarray, np.ndarray]:
        """Unit axes of rotation and points of them at rest (w, 3) [m]; zero for walls that do not turn."""
        return self._axes, self._centres

    def rates(self, time: float, ahead: bool = False) -> np.ndarray:
        """Return velocities (w, 3) [m/s] at a time [s], those of the centres of rotation of walls that turn; at the
        kinks of a linear table the left limit, or the right one if ``ahead``."""
        rates = self._prescribed(self._motions, 1, time, ahead)
        rates[self.bodies.at] = self.bodies.state.v[: len(self.bodies.at)]
        return rates

    def spins(self, time: float, ahead: bool = False) -> np.ndarray:
        """Return angular velocities (w, 3) [rad/s] at a time [s]."""
        spins, bodies = self._axes * self._prescribed(self._rotations, 1, time, ahead)[:, :1], self.bodies
        if len(bodies.turners):
            spins[bodies.at[bodies.turners]] = bodies.motion.spin
        return spins

    def rates_at(self, x: np.ndarray, time: float, ahead: bool = False) -> np.ndarray:
        """Return the velocities (m, w, 3) [m/s] of the walls' points that are at (m, 3) at a time [s]."""
        rates = self.rates(time, ahead)
        if not self.turning.any():
            return np.broadcast_to(rates, (len(x), *rates.shape))
        return rates + np.cross(self.spins(time, ahead), self.arms(x, time))

    def arms(self, x: np.ndarray, time: float) -> np.ndarray:
        """Return positions (m, w, 3) [m] of points (m, 3) relative to the centres of rotation."""
        return x[:, None, :] - (self._centres + self.displacements(time))

    def accelerations_at(self, x: np.ndarray, time: float) -> np.ndarray:
        """Return accelerations (m, w, 3) [m/s2] of the points at (m, 3) of walls with prescribed motion at a time
        [s]; zero for others."""
        accelerations = self._prescribed(self._motions, 2, time)
        if not self.turning.any():
            return np.broadcast_to(accelerations, (len(x), *accelerations.shape))
        arms, spins = self.arms(x, time), self._axes * self._prescribed(self._rotations, 1, time)[:, :1]
        twists = self._axes * self._prescribed(self._rotations, 2, time)[:, :1]
        return accelerations + np.cross(twists, arms) + np.cross(spins, np.cross(spins, arms))

    def torques(self, force: np.ndarray, moment: np.ndarray, time: float) -> np.ndarray:
        """Return the moments (w,) [N m] about the axes of rotation of forces (w, 3) with moments about the origin."""
        return np.einsum("wi,wi->w", self._axes, moment - np.cross(self._centres + self.displacements(time), force))

    def angles(self, time: float) -> np.ndarray:
        """Return the angles (w,) [rad] by which walls have turned at a time [s]."""
        return self._prescribed(self._rotations, 0, time)[:, 0]

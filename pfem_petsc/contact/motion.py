"""Where walls are: their displacement from the place that the case gives them."""

from __future__ import annotations

import numpy as np

from ..mechanics.motion import motion_of

__all__ = ["WallMotion"]


class WallMotion:
    """Displacements of all walls of a case.

    Attributes
    ----------
    moving : (w,) bool, walls that move at all
    free : FreeWalls where some have mass, else None
    """

    def __init__(self, walls) -> None:
        self._motions = [motion_of(wall) for wall in walls]
        self.free = None
        self.moving = np.array(
            [wall.velocity is not None or wall.motion is not None or wall.mass is not None for wall in walls],
            dtype=bool,
        )

    def shifts(self, time: float) -> np.ndarray:
        """Displacements (w, 3) [m] at a time [s]."""
        shifts = np.zeros((len(self._motions), 3))
        for k, motion in enumerate(self._motions):
            if motion is not None:
                shifts[k] = motion.at(time)[0]
        if self.free is not None:
            shifts[self.free.at] = self.free.displacements(time)
        return shifts

    def rates(self, time: float, ahead: bool = False) -> np.ndarray:
        """Velocities (w, 3) [m/s] at a time [s]; in the kinks of a linear table that before, or that ahead."""
        rates = np.zeros((len(self._motions), 3))
        for k, motion in enumerate(self._motions):
            if motion is not None:
                rates[k] = motion.at(time, ahead=ahead)[1]
        if self.free is not None:
            rates[self.free.at] = self.free.state.v
        return rates

    def accelerations(self, time: float) -> np.ndarray:
        """Accelerations (w, 3) [m/s2] at a time [s] of walls whose motion is given; zero for those with mass."""
        nothing = np.zeros((3, 3))
        moved = [nothing if motion is None else motion.at(time) for motion in self._motions]
        return np.array([each[2] for each in moved]).reshape(-1, 3)

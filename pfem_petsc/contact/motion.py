"""Where walls are: their displacement from the place that the case gives them."""

from __future__ import annotations

import numpy as np

from ..mechanics.loads import Table

__all__ = ["WallMotion"]


class WallMotion:
    """Displacements of all walls of a case.

    Attributes
    ----------
    moving : (w,) bool, walls that move at all
    free : FreeWalls where some have mass, else None
    """

    def __init__(self, walls) -> None:
        self._tables = [Table(wall.motion) if wall.motion is not None else None for wall in walls]
        self._velocities = np.array(
            [wall.velocity if wall.velocity is not None else (0.0, 0.0, 0.0) for wall in walls], dtype=np.float64
        ).reshape(-1, 3)
        self.free = None
        self.moving = np.array(
            [wall.velocity is not None or wall.motion is not None or wall.mass is not None for wall in walls],
            dtype=bool,
        )

    def shifts(self, time: float) -> np.ndarray:
        """Displacements (w, 3) [m] at a time [s]."""
        shifts = self._velocities * time
        for k, table in enumerate(self._tables):
            if table is not None:
                shifts[k] = table(time)
        if self.free is not None:
            shifts[self.free.at] = self.free.displacements(time)
        return shifts

    def rates(self, time: float, ahead: bool = False) -> np.ndarray:
        """Velocities (w, 3) [m/s] at a time [s]; in a table's kinks that before, or that ahead."""
        rates = self._velocities.copy()
        for k, table in enumerate(self._tables):
            if table is not None:
                row = np.searchsorted(table.times, time, side="right" if ahead else "left") - 1
                inside = 0 <= row < len(table.times) - 1
                if inside:
                    rates[k] = np.diff(table.values[row : row + 2], axis=0)[0] / np.diff(table.times[row : row + 2])
        if self.free is not None:
            rates[self.free.at] = self.free.state.v
        return rates

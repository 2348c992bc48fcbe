"""Motion of walls: displacements from their initial positions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..mechanics.motion import motion_of
from .free import FreeWalls, NoFreeWalls

if TYPE_CHECKING:
    from ..integrators.base import Scheme
    from .walls.base import WallKeys

__all__ = ["WallMotion"]


class WallMotion:
    """Displacements of all walls of a case.

    Attributes
    ----------
    moving : (w,) bool, walls that move
    bodies : FreeWalls, the walls with mass; NoFreeWalls if there are none
    held : (w, 3) displacements at the start of a stage [m] of walls that stay in force and rest there
    """

    def __init__(self, walls: Sequence[WallKeys], holds: bool = False) -> None:
        self._motions = [None if holds else motion_of(wall) for wall in walls]
        self.held = np.zeros((len(walls), 3))
        self.bodies: FreeWalls | NoFreeWalls = NoFreeWalls()
        self.moving = np.array(
            [wall.velocity is not None or wall.motion is not None or wall.mass is not None for wall in walls],
            dtype=bool,
        )

    @property
    def free(self) -> FreeWalls | None:
        """The walls with mass, None if there are none."""
        return self.bodies if len(self.bodies.at) else None

    @property
    def speeds(self) -> np.ndarray:
        """Velocities (f, 3) [m/s] of walls with mass; (0, 3) if there are none."""
        return self.bodies.state.v

    def set_speeds(self, v: np.ndarray) -> None:
        """Set the velocities (f, 3) [m/s] of walls with mass."""
        self.bodies.state.v = v

    def start(self, h: float) -> None:
        """Initialise the state of walls with mass for steps of ``h`` [s]."""
        self.bodies.start(h)

    def begin(self, time: float, h: float) -> None:
        """Begin a step of ``h`` from ``time`` [s] for walls with mass."""
        self.bodies.begin(time, h)

    def finish(self, h: float, end: float) -> None:
        """Complete the state of walls with mass after a step of ``h`` to the time ``end`` [s]."""
        self.bodies.finish(h, end)

    def step_changed(self, scheme: Scheme) -> None:
        """Notify the scheme of the walls with mass that the step size has changed."""
        self.bodies.step_changed(scheme)

    def kept(self) -> dict[str, Any] | None:
        """Return the state for a checkpoint, None if no wall has mass."""
        return self.bodies.kept()

    def load_state(self, kept: dict[str, Any] | None) -> None:
        """Restore walls with mass from a checkpoint."""
        self.bodies.load_state(kept)

    def displacements(self, time: float) -> np.ndarray:
        """Return displacements (w, 3) [m] at a time [s]."""
        displacements = self.held.copy()
        for k, motion in enumerate(self._motions):
            if motion is not None:
                displacements[k] = motion.at(time)[0]
        displacements[self.bodies.at] = self.bodies.displacements(time)
        return displacements

    def rates(self, time: float, ahead: bool = False) -> np.ndarray:
        """Return velocities (w, 3) [m/s] at a time [s]; at the kinks of a linear table the left limit, or the right one
        if ``ahead``."""
        rates = np.zeros((len(self._motions), 3))
        for k, motion in enumerate(self._motions):
            if motion is not None:
                rates[k] = motion.at(time, ahead=ahead)[1]
        rates[self.bodies.at] = self.bodies.state.v
        return rates

    def accelerations(self, time: float) -> np.ndarray:
        """Return accelerations (w, 3) [m/s2] of walls with prescribed motion at a time [s]; zero for others."""
        nothing = np.zeros((3, 3))
        moved = [nothing if motion is None else motion.at(time) for motion in self._motions]
        return np.array([each[2] for each in moved]).reshape(-1, 3)

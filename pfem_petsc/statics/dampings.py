"""Dampings of dynamic relaxation, which make its pseudo-motion end at an equilibrium.

- ``kinetic``: when the kinetic energy has passed a peak, the nodes return to the positions of the peak, one and a half
  steps back, and start again from rest (Cundall 1976; Topping & Ivanyi 2008, section 2.6; Barnes 1999).
- ``fire``: velocities are turned towards the forces, and stopped when they point uphill; the step adapts (Bitzek et al.
  2006, doi:10.1103/PhysRevLett.97.170201, in the form of Guenole et al. 2020, doi:10.1016/j.commatsci.2020.109584).
  Norms are those of the masses, as if the coordinates were sqrt(m) x.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .relaxation_loops import KINETIC, POWER, WEIGHTED

if TYPE_CHECKING:
    from .pseudo_motion import PseudoMotion

__all__ = ["DAMPINGS", "FireDamping", "KineticDamping"]


class KineticDamping:
    """Restarts nodes from rest at peaks of the kinetic energy."""

    def begin(self, motion: PseudoMotion) -> None:
        """From rest."""
        self._before = np.zeros_like(motion.residual)
        self._rest()

    def _rest(self) -> None:
        self._energy, self._resting = 0.0, True

    def move(self, motion: PseudoMotion) -> None:
        """Make one pseudo-step. Velocities are those half a step before the positions."""
        energy = motion.sums[KINETIC]
        if energy < self._energy:
            # x - 3/2 v + r/(2 m) of the previous step: the peak, by a parabola through three energies
            motion.go_back(1.5 * motion.v - 0.5 * self._before / motion.mass[:, None])
            motion.v[:] = 0.0
            self._rest()
            return
        self._energy = energy
        self._before[:] = motion.residual
        push = 0.5 if self._resting else 1.0
        self._resting = False
        motion.shift(1.0, push, 1.0)


class FireDamping:
    """Turns velocities towards the forces; uphill motion is stopped, half a step back."""

    start, grows, shrinks, fades, delay = 0.02, 1.1, 0.5, 0.99, 5
    first, largest, smallest = 0.5, 0.9, 0.02

    def begin(self, motion: PseudoMotion) -> None:
        """From rest."""
        self._step, self._turn, self._downhill = self.first, self.start, 0

    def move(self, motion: PseudoMotion) -> None:
        """Make one pseudo-step: semi-implicit Euler, then the turn."""
        power, weighted, square = motion.sums[POWER], motion.sums[WEIGHTED], motion.sums[KINETIC]
        if power > 0.0 or square == 0.0:
            self._downhill += 1
            if self._downhill > self.delay:
                self._step = min(self._step * self.grows, self.largest)
                self._turn *= self.fades
        else:
            motion.go_back(0.5 * self._step * motion.v)
            motion.v[:] = 0.0
            power = square = 0.0
            self._downhill, self._turn = 0, self.start
            self._step = max(self._step * self.shrinks, self.smallest)
        h = self._step
        square += 2.0 * h * power + h * h * weighted  # of the velocities once the forces have acted
        keep = 1.0 - self._turn
        push = keep * h + (self._turn * float(np.sqrt(square / weighted)) if weighted > 0.0 else 0.0)
        motion.shift(keep, push, h)


DAMPINGS = {"fire": FireDamping, "kinetic": KineticDamping}
"""By the name in ``static.damping``."""

"""Exact solutions of a rod that hits a rigid wall end on: elastic, and elastoplastic with linear hardening."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Rod:
    """A rod of length L flying at speed v towards a wall at a distance ``gap``; SI units.

    With hardening modulus K the plastic wave runs at c_p = sqrt(E_t/rho), E_t = E K/(E + K); behind it the stress is
    s_Y + rho c_p (v - v_Y), v_Y = s_Y/(rho c), and the contact force constant until the elastic unloading wave has come
    back from the free end, 2 L/c after the impact.
    """

    young_modulus: float
    area: float
    density: float
    length: float
    speed: float
    gap: float
    yield_stress: float = np.inf
    hardening: float = 0.0

    @property
    def wave_speed(self) -> float:
        """Elastic, c [m/s]."""
        return float(np.sqrt(self.young_modulus / self.density))

    @property
    def impact(self) -> float:
        """Time of first contact [s]."""
        return self.gap / self.speed

    @property
    def duration(self) -> float:
        """2 L/c [s]: of the elastic contact, and of the force plateau of the elastoplastic one."""
        return 2.0 * self.length / self.wave_speed

    @property
    def release(self) -> float:
        """End of the elastic contact, or of the plateau [s]."""
        return self.impact + self.duration

    @property
    def force(self) -> float:
        """Contact force [N]."""
        rho, c = self.density, self.wave_speed
        yielding = self.yield_stress / (rho * c)
        if self.speed <= yielding:
            return rho * c * self.speed * self.area
        tangent = self.young_modulus * self.hardening / (self.young_modulus + self.hardening)
        return (self.yield_stress + np.sqrt(tangent * rho) * (self.speed - yielding)) * self.area

    @property
    def yields(self) -> bool:
        """Whether the impact is plastic."""
        return self.speed > self.yield_stress / (self.density * self.wave_speed)

    def tip_velocity(self, end: float) -> tuple[np.ndarray, np.ndarray]:
        """Corners of the curve of the tip's velocity [s], [m/s]; the plastic one is known to the end of the plateau."""
        return self._corners(end, self.speed, 0.0, -self.speed)

    def contact_force(self, end: float) -> tuple[np.ndarray, np.ndarray]:
        """Corners of the curve of the contact force [s], [N]."""
        return self._corners(end, 0.0, self.force, 0.0)

    def _corners(self, end: float, before: float, during: float, after: float) -> tuple[np.ndarray, np.ndarray]:
        times = [0.0, self.impact, self.impact, self.release, self.release, end]
        known = 4 if self.yields else 6
        return np.array(times[:known]), np.array([before, before, during, during, after, after][:known])

    def mean_velocity(self, time: np.ndarray) -> np.ndarray:
        """Velocity of the centre of mass (n,) [m/s] of the elastic rod: linear from v to -v during contact."""
        progress = np.clip((time - self.impact) / self.duration, 0.0, 1.0)
        return self.speed * (1.0 - 2.0 * progress)


ROD = Rod(1.0, 1.0, 1.0, 1.0, speed=0.5, gap=0.05)
BAR = Rod(207e9, 645e-6, 7844.0, 0.254, speed=5.136, gap=2.54e-5)
PLASTIC_BAR = Rod(207e9, 645e-6, 7844.0, 0.254, speed=5.136, gap=2.54e-5, yield_stress=69e6, hardening=6.9e9)

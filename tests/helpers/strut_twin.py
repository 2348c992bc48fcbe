"""Nonaka's strut once more: its equations in the stress, with complex numbers for both signs, solved by bisection."""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass

__all__ = ["Strut", "solid"]


@dataclass(frozen=True)
class Strut:
    """A round bar; the state is (plastic strain, accumulated, hinge angle)."""

    young: float
    yields: float
    slenderness: float
    imperfection: float = 0.0
    radius: float = 1e-2

    @property
    def area(self):
        return math.pi * self.radius**2

    @property
    def inertia(self):
        return 0.25 * math.pi * self.radius**4

    @property
    def length(self):
        return 0.5 * self.slenderness * self.radius

    @property
    def euler(self):
        return math.pi**2 * self.young * self.inertia / (self.area * self.length**2)

    @property
    def full_moment(self):
        return 4.0 / 3.0 * self.radius**3 * self.yields

    def start(self):
        angle = 4.0 * self.imperfection
        return angle * angle / 8.0, 0.0, angle

    def wave(self, stress):
        """Half the length times (P/(E I))^(1/2), imaginary in tension."""
        return 0.5 * self.length * cmath.sqrt(-stress * self.area / (self.young * self.inertia))

    def bowing(self, stress, angle):
        """Shortening over the length: half the mean square of the slope of (angle/2) cos(k x)/cos(k l/2)."""
        if stress == 0.0:
            return angle * angle / 8.0
        z = self.wave(stress)
        return angle * angle / 16.0 * (1.0 / cmath.cos(z) ** 2 + cmath.tan(z) / z)

    def moment(self, stress, angle):
        """Of the force about midspan over the full plastic moment, at a deflection of (angle l/4) tan(z)/z."""
        if stress == 0.0:
            return 0.0
        z = self.wave(stress)
        deflection = 0.25 * angle * self.length * cmath.tan(z) / z
        return -stress * self.area * deflection / self.full_moment

    def angle(self, stress, sign):
        """On the yield condition."""
        return (1.0 + sign * stress / self.yields) / (sign * self.moment(stress, 1.0))

    def step(self, strain, state):
        """Stress, state and tangent at a strain, without snaps."""
        plastic, accumulated, angle = state
        share = self.full_moment / (self.yields * self.area * self.length)  # of the hinge angle

        def elastic(stress):
            return stress / self.young + plastic - self.bowing(stress, angle) - strain

        limit = min(self.euler, self.yields)
        if angle == 0.0:
            stress = self.young * (strain - plastic)
            if stress < -self.euler <= 0.0 and self.euler < self.yields:
                slope = 2.0 * math.sqrt(plastic - strain - self.euler / self.young)
                bent = self.full_moment * (1.0 - self.euler / self.yields)
                # M = P times the deflection s/k
                if self.euler * self.area * slope * self.length / math.pi <= bent:
                    return -self.euler, state, 0.0
                stress = -2.0 * self.yields
            elif abs(stress) <= self.yields:
                return stress, state, self.young
        else:
            stress = self.bisected(elastic, -self.euler * (1.0 - 1e-15), 2.0 * self.yields)
            if abs(self.moment(stress, angle).real) + abs(stress) / self.yields <= 1.0:
                return stress, state, self.tangent(elastic, stress)
        sign = 1.0 if stress < 0.0 else -1.0  # the hinge opens, or closes

        def hinged(stress):
            turned = self.angle(stress, sign)
            change = -sign * share * sign * (turned - angle)
            return stress / self.young + plastic + change - self.bowing(stress, turned) - strain

        if sign > 0.0:
            stress = -self.bisected(lambda s: hinged(-s), 1e-9 * limit, limit * (1.0 - 1e-14))
        elif hinged(self.yields * (1.0 - 1e-15)).real <= 0.0:
            new = strain - self.yields / self.young
            return self.yields, (new, accumulated + new - plastic, 0.0), 0.0
        else:
            stress = self.bisected(hinged, 1e-9 * limit, self.yields * (1.0 - 1e-15))
        turned = self.angle(stress, sign).real
        flow = share * abs(turned - angle)
        return stress, (plastic - sign * flow, accumulated + flow, turned), self.tangent(hinged, stress)

    @staticmethod
    def bisected(function, low, high):
        """Root of an increasing function."""
        for _ in range(200):
            middle = 0.5 * (low + high)
            value = function(middle)
            low, high = (middle, high) if complex(value).real < 0.0 else (low, middle)
        return 0.5 * (low + high)

    @staticmethod
    def tangent(function, stress):
        """d(stress)/d(strain) from the residual, by a complex step in the stress."""
        step = 1e-6 * abs(stress)
        return 2.0 * step / complex(function(stress + step) - function(stress - step)).real


def solid(strut):
    """Keys of its material and its section."""
    material = {"law": "strut", "young_modulus": strut.young, "yield_stress": strut.yields, "density": 7850.0}
    if strut.imperfection:
        material["imperfection"] = strut.imperfection
    return material, {"area": strut.area, "shape": "round"}

"""Elastic bar that is damaged in tension, with linear softening regularised by its fracture energy.

Up to the strength f the bar is elastic. Beyond e_0 = f/E the stress at the largest strain k so far falls on the line to
zero at e_c = 2 G/(f L), so that a bar of any length L dissipates the fracture energy G per area until it is parted
(crack band; Bazant & Oh, Materials and Structures 16, 1983). Unloading is to the origin; in compression the crack is
closed and the modulus is E. The density dissipated up to k is (f k - s(k) e_0)/2.

For e_c <= e_0, L >= 2 E G/f^2, strain would have to decrease while the bar softens (snap-back): refused.
"""

from __future__ import annotations

import numpy as np
from numba.extending import register_jitable

from ...case.base import PositiveFloat
from .base import BarShapes, Law, MaterialKeys, UnsuitableBarError, mean_of_work

__all__ = ["LAW", "Parameters", "response"]


class Parameters(MaterialKeys):
    """Keys of a material that is damaged in tension."""

    tensile_strength: PositiveFloat
    """stress at which damage begins [Pa]"""
    fracture_energy: PositiveFloat
    """energy dissipated per cross-section area until the bar is parted [J/m2]"""

    def pack(self) -> tuple[float, ...]:
        """Return E, f [Pa] and e_0."""
        return float(self.young_modulus), float(self.tensile_strength), self.tensile_strength / self.young_modulus

    def pack_bars(self, bars: BarShapes) -> tuple[np.ndarray, ...]:
        """Return the strain e_c at which each bar is parted; reject bars too long for the fracture energy."""
        parted = 2.0 * self.fracture_energy / (self.tensile_strength * bars.length)
        bad = np.flatnonzero(parted <= self.tensile_strength / self.young_modulus)
        if len(bad):
            longest = 2.0 * self.young_modulus * self.fracture_energy / self.tensile_strength**2
            raise UnsuitableBarError(
                bad[0],
                f"its length of {bars.length[bad[0]]:.6g} m is too much for fracture_energy = "
                f"{self.fracture_energy:g} J/m2: bars of {longest:.6g} m and more store more energy at the strength "
                "than they dissipate (snap-back); divide them, or increase fracture_energy",
            )
        return (parted,)

    def suspicions(self, key: str, hint: str) -> list[str]:
        """Return messages about unrealistic strains at the strength."""
        strain = self.tensile_strength / self.young_modulus
        return [f"{key}.tensile_strength is reached at a strain of {strain:.3g}; {hint}"] if strain > 0.2 else []


@register_jitable
def response(strain, rate, step, temperature, p, q):
    """See :class:`~pfem_petsc.mechanics.materials.base.Law`; q = (damage, largest strain beyond e_0)."""
    young, strength, first, parted = p
    damage, beyond = q
    softening = strength / (parted - first)
    tangent = (1.0 - damage) * young
    if strain - first > beyond:
        beyond = strain - first
        tangent = -softening
        if beyond > parted - first:
            beyond, tangent = parted - first, 0.0
        damage = 1.0 - (strength - softening * beyond) / (young * (first + beyond))
        if beyond == parted - first:
            damage = 1.0
    if strain <= 0.0:
        tangent = young
        stress = young * strain
    else:
        stress = (1.0 - damage) * young * strain
    envelope = (1.0 - damage) * young * (first + beyond)
    lost = 0.5 * (strength * (first + beyond) - envelope * first)
    return stress, tangent, (damage, beyond), (0.5 * stress * strain, lost)


LAW = Law(
    response,
    internal=(("damage", ""), ("strain_beyond_strength", "")),
    energies=("elastic_energy", "damage_dissipation"),
    bar_data=("strain_when_parted",),
    mean_stress=mean_of_work(response),
    mean_of_work=True,
)

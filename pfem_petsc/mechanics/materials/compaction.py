"""Bar that stiffens beyond a compressive strain, like a crushed cell whose walls meet.

An elastic spring of modulus E_c beyond the strain -e_c acts in parallel to an elastoplastic bar: the stress is that of
the elastoplastic law plus E_c min(e + e_c, 0), and the stored energy is larger by E_c min(e + e_c, 0)^2/2.
"""

from __future__ import annotations

from numba.extending import register_jitable

from ...case.base import NonNegativeFloat, PositiveFloat
from .base import Law, MaterialKeys, mean_of_work
from .elastoplastic import response as elastoplastic

__all__ = ["LAW", "Parameters", "response"]

_NEVER = 1e300  # Pa


class Parameters(MaterialKeys):
    """Keys of a material that is compacted."""

    compaction_strain: PositiveFloat
    """compressive strain e_c at which the bar stiffens"""
    compaction_modulus: PositiveFloat
    """modulus E_c that is added beyond it [Pa]"""
    yield_stress: PositiveFloat | None = None
    """yield stress [Pa]; default: the bar does not yield"""
    isotropic_hardening: NonNegativeFloat = 0.0
    """isotropic hardening modulus K [Pa]"""
    kinematic_hardening: NonNegativeFloat = 0.0
    """kinematic hardening modulus H [Pa]"""

    def pack(self) -> tuple[float, ...]:
        """Return the numbers of the elastoplastic law, then e_c and E_c [Pa]."""
        young, isotropic, kinematic = self.young_modulus, self.isotropic_hardening, self.kinematic_hardening
        yields = _NEVER if self.yield_stress is None else float(self.yield_stress)
        plastic = (float(young), yields, float(isotropic), float(kinematic), 1.0 / (young + kinematic + isotropic))
        return (*plastic, float(self.compaction_strain), float(self.compaction_modulus))

    def largest_modulus(self) -> float:
        """Modulus of the compacted bar [Pa]."""
        return float(self.young_modulus + self.compaction_modulus)

    def suspicions(self, key: str, hint: str) -> list[str]:
        """Return a message about a strain that no bar reaches."""
        if self.strain == "engineering" and self.compaction_strain >= 1.0:
            return [f"{key}.compaction_strain = {self.compaction_strain:g}: at -1 a bar has no length left"]
        return []


@register_jitable
def response(strain, rate, step, temperature, p, q):
    """See :class:`~pfem_petsc.mechanics.materials.base.Law`; q = (plastic strain, accumulated plastic strain)."""
    plastic = (p[0], p[1], p[2], p[3], p[4])
    stress, tangent, new, (elastic, heat, hardening) = elastoplastic(strain, rate, step, temperature, plastic, q)
    over = strain + p[5]
    if over < 0.0:
        stress += p[6] * over
        tangent += p[6]
        elastic += 0.5 * p[6] * over * over
    return stress, tangent, new, (elastic, heat, hardening)


LAW = Law(
    response,
    internal=(("plastic_strain", ""), ("accumulated_plastic_strain", "")),
    energies=("elastic_energy", "plastic_heat", "hardening_energy"),
    mean_stress=mean_of_work(response),
    mean_of_work=True,
)

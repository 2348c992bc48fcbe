"""Cable: carries tension only, and may yield in tension.

With the plastic strain e_p, the strain at which it becomes slack, the stress is E (e - e_p) where this is positive, and
zero below. It yields at s_Y + K e_p; a yielded cable is longer, and becomes taut later.
"""

from __future__ import annotations

from typing import ClassVar

from numba.extending import register_jitable

from ...case.base import NonNegativeFloat, PositiveFloat
from .base import Law, MaterialKeys, mean_of_work, yield_texts

__all__ = ["LAW", "Parameters", "response"]

_ROUNDING = 1e-12  # of strains: a cable that is shorter by less is neither slack nor stressed
_NEVER = 1e300  # Pa; not infinite, as its product with a plastic strain of zero is the heat


class Parameters(MaterialKeys):
    """Keys of cables."""

    describes_buckling: ClassVar[bool] = True

    yield_stress: PositiveFloat | None = None
    """yield stress [Pa]; default: the cable does not yield"""
    isotropic_hardening: NonNegativeFloat = 0.0
    """isotropic hardening modulus K [Pa]"""

    def pack(self) -> tuple[float, ...]:
        """Return E, s_Y and K [Pa]."""
        yields = _NEVER if self.yield_stress is None else float(self.yield_stress)
        return float(self.young_modulus), yields, float(self.isotropic_hardening)

    def suspicions(self, key: str, hint: str) -> list[str]:
        """Return messages about a yield strain that no material has, and hardening of a cable that cannot yield."""
        if self.yield_stress is None:
            unused = self.isotropic_hardening > 0.0
            return [f"{key}.isotropic_hardening has no effect without a yield_stress"] if unused else []
        return yield_texts(key, hint, "yield_stress", self.yield_stress, self.young_modulus)


@register_jitable
def response(strain, rate, step, temperature, p, q):
    """See :class:`~pfem_petsc.mechanics.materials.base.Law`; q = (plastic strain, slack)."""
    young, yield_stress, hardening = p
    plastic = q[0]
    stress, tangent, slack = young * (strain - plastic), young, 0.0
    excess = stress - (yield_stress + hardening * plastic)
    if strain - plastic < -_ROUNDING:
        stress, tangent, slack = 0.0, 0.0, 1.0
    elif stress < 0.0:
        stress = 0.0
    elif excess > 0.0:
        flow = excess / (young + hardening)
        plastic += flow
        stress -= young * flow
        tangent = young * hardening / (young + hardening)
    densities = (0.5 * stress * stress / young, yield_stress * plastic, 0.5 * hardening * plastic * plastic)
    return stress, tangent, (plastic, slack), densities


LAW = Law(
    response,
    internal=(("plastic_strain", ""), ("slack", "")),
    energies=("elastic_energy", "plastic_heat", "hardening_energy"),
    mean_stress=mean_of_work(response),
    mean_of_work=True,
)

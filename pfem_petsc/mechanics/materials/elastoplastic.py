"""Elastoplastic bar with mixed linear hardening, isotropic (K) and kinematic (H).

The yield function is f = |s - H e_p| - (s_Y + K a) with the accumulated plastic strain a. The return mapping of a
linear law has a closed form: da = f_trial / (E + H + K). On the yield surface s = sign (s_Y + K a) + H e_p, so the
plastic work is the function of state s_Y a + K a^2/2 + H e_p^2/2; its first term is heat, the rest is stored by
hardening.

The mean stress of a step is the change of the energies over that of the strain, as they are functions of state on the
path of a step: its work is the change of elastic energy plus the plastic dissipation, which is nonnegative. The work of
(s0 + s1)/2 would be less than the dissipation.
"""

from __future__ import annotations

import math

from numba.extending import register_jitable

from ...case.base import NonNegativeFloat, PositiveFloat
from .base import Law, MaterialKeys, Softening, mean_of_work, yield_texts

__all__ = ["LAW", "Parameters", "response"]


class Parameters(MaterialKeys):
    """Keys of an elastoplastic material."""

    yield_stress: PositiveFloat
    """yield stress [Pa]"""
    isotropic_hardening: NonNegativeFloat = 0.0
    """isotropic hardening modulus K [Pa]"""
    kinematic_hardening: NonNegativeFloat = 0.0
    """kinematic hardening modulus H [Pa]"""

    def pack(self) -> tuple[float, ...]:
        """Return (E, s_Y, K, H) [Pa] and 1/(E + H + K) [1/Pa]."""
        young, isotropic, kinematic = self.young_modulus, self.isotropic_hardening, self.kinematic_hardening
        inverse = 1.0 / (young + kinematic + isotropic)
        return float(young), float(self.yield_stress), float(isotropic), float(kinematic), float(inverse)

    def suspicions(self, key: str, hint: str) -> list[str]:
        """Return messages about unrealistic strains at yield, and about yielding without hardening."""
        texts = yield_texts(key, hint, "yield_stress", self.yield_stress, self.young_modulus)
        if self.isotropic_hardening + self.kinematic_hardening == 0.0:
            texts.append(
                f"{key} yields without hardening: plastic strain localises in one bar of a row, "
                "so results depend on the mesh; give isotropic_hardening or kinematic_hardening"
            )
        return texts


@register_jitable
def response(strain, rate, step, temperature, p, q):
    """See :class:`~pfem_petsc.mechanics.materials.base.Law`; q = (plastic strain, accumulated plastic strain)."""
    young, yield_stress, isotropic, kinematic, inverse = p
    plastic, accumulated = q
    stress = young * (strain - plastic)
    tangent = young
    relative = stress - kinematic * plastic
    excess = abs(relative) - (yield_stress + isotropic * accumulated)
    if excess > 0.0:
        tangent = young * (isotropic + kinematic) * inverse
    # in loops over several bars at once a maximum and a sign take less time than conditions
    flow = max(excess, 0.0) * inverse
    accumulated += flow
    flow = math.copysign(flow, relative)
    plastic += flow
    stress -= young * flow
    hardening = 0.5 * (isotropic * accumulated * accumulated + kinematic * plastic * plastic)
    elastic = 0.5 * stress * (strain - plastic)
    return stress, tangent, (plastic, accumulated), (elastic, yield_stress * accumulated, hardening)


@register_jitable
def scale(p, modulus, strength):
    """Return the parameters at a temperature."""
    young, isotropic, kinematic = modulus * p[0], strength * p[2], strength * p[3]
    return young, strength * p[1], isotropic, kinematic, 1.0 / (young + kinematic + isotropic)


@register_jitable
def dissipated(p, q):
    """Return the densities of heat and hardening energy [J/m3]."""
    return p[1] * q[1], 0.5 * (p[2] * q[1] * q[1] + p[3] * q[0] * q[0])


LAW = Law(
    response,
    internal=(("plastic_strain", ""), ("accumulated_plastic_strain", "")),
    energies=("elastic_energy", "plastic_heat", "hardening_energy"),
    mean_stress=mean_of_work(response),
    mean_of_work=True,
    softening=Softening(scale, dissipated),
)

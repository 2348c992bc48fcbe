"""Elastoplastic bar with mixed linear hardening, isotropic (K) and kinematic (H).

The yield function is f = |s - H e_p| - (s_Y + K a) with the accumulated plastic strain a. The return mapping of a
linear law has a closed form: da = f_trial / (E + H + K). On the yield surface s = sign (s_Y + K a) + H e_p, so the
plastic work is the function of state s_Y a + K a^2/2 + H e_p^2/2; its first term is heat, the rest is stored by
hardening.

In a step that yields during the last fraction q of the strain increment, the stress follows the line of modulus E up to
the yield stress and the line of modulus Et from there. With the plastic strain de_p of the step its mean is

    S = (s0 + s1)/2 + E de_p (1 - q)/2,   q = E de_p/((E - Et)(e1 - e0)),   dS/de1 = (Et + (E - Et)(1 - q)^2)/2.

The energies are functions of state on that path, so the work S (e1 - e0) is the change of elastic energy plus the
plastic dissipation, which is nonnegative. The work of (s0 + s1)/2 would be less than the dissipation.
"""

from __future__ import annotations

import math

import numpy as np
from numba.extending import register_jitable

from ...case.base import NonNegativeFloat, PositiveFloat
from .base import Law, MaterialKeys, Softening, yield_texts

__all__ = ["LAW", "Parameters", "mean_correction", "response"]


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
def mean_stress(stress0, strain0, strain, step, temperature, p, q):
    """Return the mean stress of the step and its derivative; see the module."""
    stress, modulus, (flowed, _), _ = response(strain, 0.0, step, temperature, p, q)
    mean = 0.5 * (stress0 + stress)
    if flowed != q[0]:
        young, change = p[0], strain - strain0
        lost = young - modulus
        part = young * (flowed - q[0]) / (lost * change) if change != 0.0 else 1.0
        part = min(max(part, 0.0), 1.0)  # clips rounding only: the start is not outside the yield surface
        mean += 0.5 * young * (flowed - q[0]) * (1.0 - part)
        modulus += lost * (1.0 - part) * (1.0 - part)
    return mean, 0.5 * modulus


def mean_correction(p: tuple[float, ...], stress: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the contribution of yielding to the mean stress of a step beyond (s0 + s1)/2: E de_p (1 - q)/2 [Pa].

    ``stress`` s1 - s0 [Pa], internal variables (2, bars) ``before`` and ``after`` the step.
    """
    young, *_, inverse = p
    flow = after[0] - before[0]
    change = stress / young + flow
    with np.errstate(divide="ignore", invalid="ignore"):
        q = np.where(flow != 0.0, flow / (young * inverse * change), 1.0)
    return 0.5 * young * flow * (1.0 - np.clip(np.nan_to_num(q, nan=1.0, posinf=1.0, neginf=1.0), 0.0, 1.0))


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
    mean_stress=mean_stress,
    mean_correction=mean_correction,
    softening=Softening(scale, dissipated),
)

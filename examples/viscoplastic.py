"""Viscoplastic bar with kinematic hardening (Perzyna), and a stress proportional to the strain rate.

With the back stress b and the excess f = |E (e - e_p) - b| - s_Y, plastic strain flows at the rate f/eta, b at H times
that, and the stress is s = E (e - e_p) + mu de/dt. Backward Euler over a step h is closed:
de_p = f_trial/(E + H + eta/h).
"""

from __future__ import annotations

from numba.extending import register_jitable

from pfem_petsc.case.base import NonNegativeFloat, PositiveFloat
from pfem_petsc.mechanics.materials.base import Law, MaterialKeys, mean_rate

__all__ = ["LAW", "Parameters"]


class Parameters(MaterialKeys):
    """Keys of a viscoplastic material."""

    yield_stress: PositiveFloat
    """Stress above which plastic strain flows [Pa]."""
    hardening: PositiveFloat
    """Kinematic hardening modulus H [Pa]."""
    viscosity: PositiveFloat
    """Viscosity eta of the plastic flow [Pa s]."""
    rate_viscosity: NonNegativeFloat = 0.0
    """Stress mu over strain rate [Pa s]."""

    def pack(self) -> tuple[float, ...]:
        """(E, s_Y, H, eta, mu)."""
        return self.young_modulus, self.yield_stress, self.hardening, self.viscosity, self.rate_viscosity


@register_jitable
def response(strain, rate, step, temperature, p, q):
    """See :class:`~pfem_petsc.mechanics.materials.base.Law`."""
    young, yield_stress, hardening, viscosity, rate_viscosity = p
    plastic, back, heat = q
    tangent = young
    relative = young * (strain - plastic) - back
    excess = abs(relative) - yield_stress
    if excess > 0.0 and step > 0.0:
        stiffness = young + hardening + viscosity / step
        flow = excess / stiffness
        tangent -= young * young / stiffness
        heat += (abs(relative) - (young + hardening) * flow) * flow
        if relative < 0.0:
            flow = -flow
        plastic += flow
        back += hardening * flow
    stress = young * (strain - plastic)
    elastic = 0.5 * stress * (strain - plastic)
    if step > 0.0:
        stress += rate_viscosity * rate
        tangent += rate_viscosity / step
        heat += rate_viscosity * rate * rate * step
    return stress, tangent, (plastic, back, heat), (elastic, heat, 0.5 * back * back / hardening)


@register_jitable
def mean_stress(stress0, strain0, strain, step, temperature, p, q):
    """The mean of both ends; its work differs from the change of energies by the third power of the step."""
    stress, tangent, _, _ = response(strain, mean_rate(strain0, strain, step), step, temperature, p, q)
    return 0.5 * (stress0 + stress), 0.5 * tangent


LAW = Law(
    response,
    internal=(("plastic_strain", ""), ("back_stress", "Pa"), ("dissipated_density", "J/m³")),
    energies=("elastic_energy", "plastic_heat", "hardening_energy"),
    rate=True,
    mean_stress=mean_stress,
)

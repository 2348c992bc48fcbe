"""Plastic bar whose flow stress grows with the plastic strain rate: Y = R(a) (1 + (da/dt/D)^(1/q)) (Cowper, Symonds).

G. R. Cowper and P. S. Symonds, Strain-hardening and strain-rate effects in the impact loading of cantilever beams,
Brown University, Division of Applied Mathematics, Technical Report 28, 1957. Mild steel: D = 40.4 1/s, q = 5. The rate
is that of the plastic strain.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from ...case.base import PositiveFloat
from ..compiled import inlined
from ._plastic import HardeningKeys, curve, scale, stored, viscous_law

__all__ = ["LAW", "Parameters", "flow_stress"]


class Parameters(HardeningKeys):
    """Keys of a material of Cowper and Symonds."""

    rate_reference: PositiveFloat
    """plastic strain rate D at which the flow stress is twice the static one [1/s]"""
    rate_exponent: Annotated[float, Field(ge=1.0, le=1000.0, allow_inf_nan=False)]
    """exponent q, 1 to 1000 [-]"""

    def pack(self) -> tuple[float, ...]:
        """Return (E, H, s_Y, K, Q [Pa], b, 1/D [s], 1/q)."""
        return *self.static(), 1.0 / self.rate_reference, 1.0 / self.rate_exponent


@inlined
def flow_stress(accumulated, rate, temperature, p):
    """See :func:`~pfem_petsc.mechanics.materials._plastic.viscous_law`."""
    strength, slope, _, _ = curve(accumulated, p)
    factor = (rate * p[6]) ** p[7] if rate > 0.0 else 0.0
    return strength * (1.0 + factor), slope * (1.0 + factor), strength * factor * p[7], 0.0


LAW = viscous_law(flow_stress, stored, scale)

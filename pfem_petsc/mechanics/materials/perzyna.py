"""Viscoplastic bar: plastic strain flows at the rate g ((|s - H e_p| - R(a))/s_Y)^n beyond the yield stress (Perzyna).

P. Perzyna, Fundamental problems in viscoplasticity, Advances in Applied Mechanics 9 (1966) 243-377, with the overstress
relative to the initial yield stress. For n = 1 and no hardening, the overstress at constant strain decays as
exp(-E g t/s_Y).
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from ...case.base import PositiveFloat
from ..compiled import inlined
from ._plastic import HardeningKeys, curve, scale, stored, viscous_law

__all__ = ["LAW", "Parameters", "flow_stress"]


class Parameters(HardeningKeys):
    """Keys of a viscoplastic material."""

    fluidity: PositiveFloat
    """plastic strain rate g at an overstress of s_Y [1/s]"""
    overstress_exponent: Annotated[float, Field(ge=1.0, le=1000.0, allow_inf_nan=False)] = 1.0
    """exponent n of the overstress, 1 to 1000 [-]"""

    def pack(self) -> tuple[float, ...]:
        """Return (E, H, s_Y, K, Q [Pa], b, 1/g [s], 1/n)."""
        return *self.static(), 1.0 / self.fluidity, 1.0 / self.overstress_exponent


@inlined
def flow_stress(accumulated, rate, temperature, p):
    """See :func:`~pfem_petsc.mechanics.materials._plastic.viscous_law`."""
    strength, slope, _, _ = curve(accumulated, p)
    over = p[2] * (rate * p[6]) ** p[7] if rate > 0.0 else 0.0
    return strength + over, slope, over * p[7], 0.0


LAW = viscous_law(flow_stress, stored, scale)

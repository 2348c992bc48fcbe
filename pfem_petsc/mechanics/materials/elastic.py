"""Linear elastic bar: s = E e."""

from __future__ import annotations

from numba.extending import register_jitable

from .base import Law, Softening
from .base import MaterialKeys as Parameters

__all__ = ["LAW", "Parameters"]


@register_jitable
def response(strain, rate, step, temperature, p, q):
    """See :class:`~pfem_petsc.mechanics.materials.base.Law`; p = (E,)."""
    stress = p[0] * strain
    return stress, p[0], q, (0.5 * stress * strain,)


@register_jitable
def mean_stress(stress0, strain0, strain, step, temperature, p, q):
    """Return (s0 + s1)/2, whose work is the change of the elastic energy."""
    return 0.5 * (stress0 + p[0] * strain), 0.5 * p[0]


@register_jitable
def scale(p, modulus, strength):
    """Return the parameters at a temperature."""
    return (modulus * p[0],)


LAW = Law(response, smooth=True, mean_stress=mean_stress, softening=Softening(scale))

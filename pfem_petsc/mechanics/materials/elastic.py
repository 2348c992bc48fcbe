"""Linear elastic bar: s = E e."""

from __future__ import annotations

from numba.extending import register_jitable

__all__ = ["REMEMBERS", "pack", "response"]

REMEMBERS = False


def pack(material) -> tuple[float, ...]:
    """Parameters as the response reads them: (E,) [Pa]."""
    return (float(material.young_modulus),)


@register_jitable
def response(strain, p, plastic, accumulated):
    """Stress [Pa], tangent modulus [Pa], the two history variables, and energy densities [J/m3]: elastic, heat,
    hardening."""
    stress = p[0] * strain
    return stress, p[0], plastic, accumulated, 0.5 * stress * strain, 0.0, 0.0

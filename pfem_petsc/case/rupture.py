"""Limits of a material beyond which its bars break, the key ``rupture`` of [material.NAME]."""

from __future__ import annotations

from pydantic import model_validator

from .base import PositiveFloat, PositiveInt, StrictModel

__all__ = ["Rupture"]


class Rupture(StrictModel):
    """A bar breaks at the end of the step in which it first reaches one of the limits."""

    stress: PositiveFloat | None = None
    """tensile stress [Pa]"""
    strain: PositiveFloat | None = None
    """tensile strain, without the thermal strain, in the strain measure of the material"""
    compressive_stress: PositiveFloat | None = None
    """magnitude of the compressive stress [Pa]"""
    compressive_strain: PositiveFloat | None = None
    """magnitude of the compressive strain, without the thermal strain"""
    plastic_strain: PositiveFloat | None = None
    """accumulated plastic strain; the magnitude of the plastic strain for laws that do not accumulate it"""
    damage: PositiveFloat | None = None
    """damage variable of the law"""
    steps: PositiveInt = 1
    """steps over which the force of a broken bar is reduced to zero in equal parts"""

    @model_validator(mode="after")
    def _at_least_one(self) -> Rupture:
        limits = [key for key in type(self).model_fields if key != "steps"]
        if all(getattr(self, key) is None for key in limits):
            raise ValueError(f"expected at least one limit: {', '.join(limits)}")
        return self

"""Equilibria at increasing load factors by Newton's method; walls and pairs are bounds on positions."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from pydantic import model_validator

from ...case.base import NonNegativeFloat, PositiveFloat, StrictModel
from ...errors import InputError

if TYPE_CHECKING:
    from ...solvers.linear import LinearChoice
    from ...stepping.model import Model
    from ..stepper import StaticStepper

__all__ = ["Increments", "Parameters", "make_stepper"]

_SMALLEST = 2.0**-10  # of the first increment


class Increments(StrictModel):
    """Increments of a method with keys ``step`` and, where increments adapt, ``min_step`` and ``max_step``."""

    growth: ClassVar[float] = 1.0
    """Largest increment unless given, over the first."""

    @property
    def smallest(self) -> float:
        """The smallest increment."""
        return _SMALLEST * self.step if self.min_step is None else self.min_step

    @property
    def largest(self) -> float:
        """The largest increment."""
        return self.growth * self.step if self.max_step is None else self.max_step

    @model_validator(mode="after")
    def _ordered(self) -> Increments:
        if self.smallest > self.step:
            raise InputError(f"min_step = {self.min_step!r} is larger than step = {self.step!r}")
        if self.largest < self.step:
            raise InputError(f"max_step = {self.max_step!r} is smaller than step = {self.step!r}")
        return self


class Parameters(Increments):
    """Increments of the load factor."""

    step: PositiveFloat = 0.1
    """first increment of the load factor"""
    end: PositiveFloat = 1.0
    """last load factor"""
    min_step: PositiveFloat | None = None
    """smallest increment; default: ``step`` / 1024"""
    max_step: PositiveFloat | None = None
    """largest increment, up to which increments grow after few Newton iterations; default: ``step``"""

    stabilise: NonNegativeFloat = 0.0
    """largest viscosity of the nodes over their stiffness; 0: none. Carries the truss over limit points"""
    stabilise_share: PositiveFloat = 0.05
    """share of the viscosity in the energy that the truss absorbs, beyond which the run warns"""


def make_stepper(model: Model, parameters: Parameters, choice: LinearChoice) -> StaticStepper:
    """Create the stepper of a case. Collective."""
    from ..stepper import StaticStepper

    return StaticStepper(model, choice, parameters, parameters.stabilise, parameters.stabilise_share)

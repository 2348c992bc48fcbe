"""Equilibria at increasing load factors by Newton's method; walls and pairs are bounds on positions."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...case.base import NonNegativeFloat, PositiveFloat
from . import Increments

if TYPE_CHECKING:
    from ...solvers.linear import LinearChoice
    from ...stepping.model import Model
    from ..stepper import StaticStepper

__all__ = ["Parameters", "make_stepper"]


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

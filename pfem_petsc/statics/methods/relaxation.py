"""Equilibria by dynamic relaxation: form finding, mechanisms, slack nets, tensegrities, cables that start straight."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from ...case.base import PositiveFloat, PositiveInt
from . import Increments

if TYPE_CHECKING:
    from ...solvers.linear import LinearChoice
    from ...stepping.model import Model
    from ..relaxation import RelaxationStepper

__all__ = ["Parameters", "make_stepper"]


class Parameters(Increments):
    """Increments of the load factor, and the end of their relaxation."""

    step: PositiveFloat = 1.0
    """increment of the load factor"""
    end: PositiveFloat = 1.0
    """last load factor"""
    tolerance: Annotated[float, Field(gt=0.0, lt=1.0)] = 1e-9
    """residual relative to the load, in 2-norms, at which relaxation ends"""
    max_iterations: PositiveInt = 200_000
    """maximum number of pseudo-steps in an increment"""
    newton: bool = True
    """whether Newton's method computes the last digits, if it finds the same equilibrium"""

    @property
    def smallest(self) -> float:
        """The smallest increment; increments are not halved, and do not grow."""
        return self.step

    largest = smallest


def make_stepper(model: Model, parameters: Parameters, choice: LinearChoice) -> RelaxationStepper:
    """Create the stepper of a case. Collective."""
    from ..relaxation import RelaxationStepper

    return RelaxationStepper(model, choice, parameters)

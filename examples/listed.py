"""Equilibria at listed load factors by Newton's method; increments that do not converge are halved."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pydantic import model_validator

from pfem_petsc.case.base import PositiveFloat, StrictModel
from pfem_petsc.errors import InputError
from pfem_petsc.statics.stepper import StaticStepper
from pfem_petsc.tolerances import TIME

if TYPE_CHECKING:
    from pfem_petsc.solvers.linear import LinearChoice
    from pfem_petsc.stepping.model import Model

__all__ = ["Parameters", "make_stepper"]


class Parameters(StrictModel):
    """Load factors of the equilibria."""

    load_factors: list[PositiveFloat]
    """increasing load factors"""

    @property
    def step(self) -> float:
        """The first increment."""
        return self.load_factors[0]

    @property
    def smallest(self) -> float:
        """The smallest increment."""
        return self.step / 1024.0

    @property
    def largest(self) -> float:
        """The largest increment."""
        return self.end

    @property
    def end(self) -> float:
        """The last load factor."""
        return self.load_factors[-1]

    @model_validator(mode="after")
    def _increasing(self) -> Parameters:
        given = self.load_factors
        if not given or any(b <= a for a, b in zip(given, given[1:])):
            raise InputError(f"load_factors = {given} do not increase: list each load factor once, in order")
        return self


class ListedStepper(StaticStepper):
    """Attempts the whole way to the next load factor of the list in each step."""

    def step(self) -> None:
        last, now = self.end, self.state.time
        self.end = next(factor for factor in self.limits.load_factors if factor > now * (1.0 + TIME))
        self.increment = self.end - now
        try:
            super().step()
        finally:
            self.end = last


def make_stepper(model: Model, parameters: Parameters, choice: LinearChoice) -> ListedStepper:
    """Create the stepper of a case. Collective."""
    return ListedStepper(model, choice, parameters)

"""Form finding by force densities: the net whose bars have given forces over length, or given forces, by linear solves.

The positions x of the free nodes follow from sum q (x_j - x_i) + F = 0 with the force densities q = N/L of the bars at
node i (H.-J. Schek, The force density method for form finding and computation of general networks, Computer Methods in
Applied Mechanics and Engineering 3 (1974) 115-134). Given forces N are reached by repeated solves with q = N/L.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...case.base import PositiveFloat, PositiveInt
from ..keys import Increments

if TYPE_CHECKING:
    from ...solvers.linear import LinearChoice
    from ...stepping.model import Model
    from ..force_density import ForceDensityStepper

__all__ = ["Parameters", "make_stepper"]


class Parameters(Increments):
    """Repeated solves for given forces."""

    tolerance: PositiveFloat = 1e-9
    """of given forces, relative to the largest"""
    max_iterations: PositiveInt = 500
    """number of linear solves after which a form with given forces is given up"""

    @property
    def step(self) -> float:
        """The form is found in one increment of the load factor."""
        return 1.0

    @property
    def end(self) -> float:
        """The last load factor."""
        return 1.0

    @property
    def smallest(self) -> float:
        """The smallest increment."""
        return 1.0

    @property
    def largest(self) -> float:
        """The largest increment."""
        return 1.0


def make_stepper(model: Model, parameters: Parameters, choice: LinearChoice) -> ForceDensityStepper:
    """Create the stepper of a case. Collective."""
    from ..force_density import ForceDensityStepper

    return ForceDensityStepper(model, choice, parameters)

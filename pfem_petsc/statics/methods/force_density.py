"""Form finding by force densities: the net whose bars have given forces over length, or given forces, by linear solves.

The positions x of the free nodes follow from sum q (x_j - x_i) + F = 0 with the force densities q = N/L of the bars at
node i (H.-J. Schek, The force density method for form finding and computation of general networks, Computer Methods in
Applied Mechanics and Engineering 3 (1974) 115-134). Given forces N are reached by repeated solves with q = N/L.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from . import ForceDensityKeys

if TYPE_CHECKING:
    from ...solvers.linear import LinearChoice
    from ...stepping.model import Model
    from ..force_density import ForceDensityStepper

__all__ = ["Parameters", "make_stepper"]


Parameters = ForceDensityKeys


def make_stepper(model: Model, parameters: ForceDensityKeys, choice: LinearChoice) -> ForceDensityStepper:
    """Create the stepper of a case. Collective."""
    from ..force_density import ForceDensityStepper

    return ForceDensityStepper(model, choice, parameters)

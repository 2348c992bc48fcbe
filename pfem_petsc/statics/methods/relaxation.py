"""Equilibria by dynamic relaxation: form finding, mechanisms, slack nets, tensegrities, cables that start straight."""

from __future__ import annotations

from typing import TYPE_CHECKING

from . import RelaxationKeys

if TYPE_CHECKING:
    from ...solvers.linear import LinearChoice
    from ...stepping.model import Model
    from ..relaxation import RelaxationStepper

__all__ = ["Parameters", "make_stepper"]


Parameters = RelaxationKeys


def make_stepper(model: Model, parameters: RelaxationKeys, choice: LinearChoice) -> RelaxationStepper:
    """Create the stepper of a case. Collective."""
    from ..relaxation import RelaxationStepper

    return RelaxationStepper(model, choice, parameters)

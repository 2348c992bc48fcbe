"""The path of equilibria by lengths of arc: it passes turning points of the load factor and of displacements."""

from __future__ import annotations

from typing import TYPE_CHECKING

from . import PathKeys

if TYPE_CHECKING:
    from ...solvers.linear import LinearChoice
    from ...stepping.model import Model
    from ..path_stepper import PathStepper

__all__ = ["Parameters", "make_stepper"]


Parameters = PathKeys


def make_stepper(model: Model, parameters: PathKeys, choice: LinearChoice) -> PathStepper:
    """The stepper of a case. Collective."""
    from ..path_stepper import PathStepper

    return PathStepper(model, choice, parameters)

"""The path of equilibria by increments of a displacement, which passes turning points of the load factor."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pydantic import model_validator

from ...errors import InputError
from . import PathKeys

if TYPE_CHECKING:
    from ...solvers.linear import LinearChoice
    from ...stepping.model import Model
    from ..path_stepper import PathStepper

__all__ = ["Parameters", "make_stepper"]


class Parameters(PathKeys):
    """Keys of the path; ``node_set`` and ``direction`` are required."""

    @model_validator(mode="after")
    def _has_direction(self) -> Parameters:
        if self.node_set is None:
            raise InputError("node_set and direction are missing: the displacement that is prescribed")
        return self


def make_stepper(model: Model, parameters: Parameters, choice: LinearChoice) -> PathStepper:
    """The stepper of a case. Collective."""
    from ..path_stepper import PathStepper

    return PathStepper(model, choice, parameters, by_displacement=True)

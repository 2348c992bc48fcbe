"""The path of equilibria by lengths of arc: it passes turning points of the load factor and of displacements."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from ..keys import PathKeys

if TYPE_CHECKING:
    from ...solvers.linear import LinearChoice
    from ...stepping.model import Model
    from ..path_stepper import PathStepper

__all__ = ["Parameters", "make_stepper"]


class Parameters(PathKeys):
    """Keys of the path, and of its measure."""

    constraint: Literal["cylindrical", "spherical"] = "cylindrical"
    """whether lengths are of displacements alone, or of displacements and load factor"""

    @property
    def spherical(self) -> bool:
        """Whether the load factor counts in lengths."""
        return self.constraint == "spherical"


def make_stepper(model: Model, parameters: Parameters, choice: LinearChoice) -> PathStepper:
    """The stepper of a case. Collective."""
    from ..path_stepper import PathStepper

    return PathStepper(model, choice, parameters)

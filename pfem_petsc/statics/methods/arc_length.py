"""The path of equilibria by lengths of arc: it passes turning points of the load factor and of displacements."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import numpy as np
from pydantic import model_validator

from ...case.base import NodeSetName, PositiveFloat, PositiveInt, Vector3, listed
from ...errors import InputError
from . import Increments

if TYPE_CHECKING:
    from ...solvers.linear import LinearChoice
    from ...stepping.model import Model
    from ..path_stepper import PathStepper

__all__ = ["Parameters", "make_stepper"]


class Parameters(Increments):
    """Lengths from point to point, limits of the path, and what is looked for on the way.

    Lengths are in units of the load factor: the first response of the truss to a unit of load has length one.
    """

    growth = 4.0
    step: PositiveFloat = 0.1
    """first increment of the load factor, and so the first length from point to point"""
    min_step: PositiveFloat | None = None
    """smallest length; default: a 1024th of ``step``"""
    max_step: PositiveFloat | None = None
    """largest length; default: four times ``step``"""
    iterations: PositiveInt = 4
    """Newton iterations of a point that lengths aim at"""
    end: PositiveFloat | None = None
    """load factor at which the path ends"""
    max_points: PositiveInt = 1000
    """number of points after which it ends"""
    node_set: NodeSetName | None = None
    """nodes whose mean displacement along ``direction`` is followed"""
    direction: Vector3 | None = None
    """direction of that displacement"""
    displacement: PositiveFloat | None = None
    """displacement along ``direction`` at which the path ends [m]"""
    critical_points: bool = True
    """whether limit points and bifurcations are located and recorded"""
    branch_at: Annotated[tuple[int, ...], listed] = ()
    """numbers, from 1, of bifurcations at which the path leaves along the critical mode; negative: against it"""
    branch_mode: PositiveInt = 1
    """which of the critical modes, where a bifurcation has several: 1, 2, ..., n, then sums and differences of pairs"""

    @model_validator(mode="after")
    def _consistent(self) -> Parameters:
        if (self.node_set is None) != (self.direction is None):
            raise InputError("node_set and direction belong together; give both or none")
        if self.direction is not None and not np.any(self.direction):
            raise InputError("direction = [0, 0, 0] has zero length; give a vector")
        if self.displacement is not None and self.node_set is None:
            raise InputError("displacement needs node_set and direction")
        if 0 in self.branch_at:
            raise InputError("branch_at counts bifurcations from 1")
        if self.branch_at and not self.critical_points:
            raise InputError("branch_at needs critical_points = true")
        return self


def make_stepper(model: Model, parameters: Parameters, choice: LinearChoice) -> PathStepper:
    """The stepper of a case. Collective."""
    from ..path_stepper import PathStepper

    return PathStepper(model, choice, parameters)

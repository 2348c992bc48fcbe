"""Methods that find equilibria, one per module, which ``static.method`` names; the keys that they have in common."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field, model_validator

from ...case.base import NodeSetName, PositiveFloat, PositiveInt, StrictModel, Vector3, listed
from ...errors import InputError

_SMALLEST = 2.0**-10  # of the first increment


class Increments(StrictModel):
    """Increments of a method with keys ``step`` and, where increments adapt, ``min_step`` and ``max_step``."""

    growth: ClassVar[float] = 1.0
    """Largest increment unless given, over the first."""

    @property
    def smallest(self) -> float:
        """The smallest increment."""
        return _SMALLEST * self.step if self.min_step is None else self.min_step

    @property
    def largest(self) -> float:
        """The largest increment."""
        return self.growth * self.step if self.max_step is None else self.max_step

    @model_validator(mode="after")
    def _ordered(self) -> Increments:
        if self.smallest > self.step:
            raise InputError(f"min_step = {self.min_step!r} is larger than step = {self.step!r}")
        if self.largest < self.step:
            raise InputError(f"max_step = {self.max_step!r} is smaller than step = {self.step!r}")
        return self


class PathKeys(Increments):
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
    def _consistent(self) -> PathKeys:
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


class RelaxationKeys(Increments):
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


class ForceDensityKeys(Increments):
    """Repeated solves for given forces or lengths; the form is found in one increment."""

    tolerance: PositiveFloat = 1e-9
    """of given forces, relative to the largest, and of given lengths"""
    max_iterations: PositiveInt = 5000
    """number of linear solves after which a form with given forces or lengths is given up"""

    step: ClassVar[float] = 1.0
    end: ClassVar[float] = 1.0
    smallest: ClassVar[float] = 1.0
    largest: ClassVar[float] = 1.0

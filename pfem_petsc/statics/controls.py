"""Definition of the points of a path: by an arc length, or by a displacement along a direction.

Each control has a measure s of points, relative to the last one, in units of the load factor.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from ..errors import NotConverged
from .path_constraints import Arc, Component, Constraint, Direction, Metric

__all__ = ["ByArc", "ByComponent", "Control"]

_LEAST = 1e-9  # displacement along the direction per length of the path, below which it decreases


class Control(Protocol):
    """A measure of points; displacements (owned, 3) [m] and changes of the load factor are those from the last one."""

    scale: float
    """Scale of displacements along the direction [m]; zero before the first point, or if there is no direction."""

    def constraint(self, size: float) -> Constraint:
        """Return the constraint of the point at a measure."""

    def measure(self, u: np.ndarray, change: float) -> float:
        """Return the measure of a point. Collective."""

    def rate(self, u: np.ndarray, change: float, tangent: np.ndarray, slope: float) -> float:
        """Return the derivative of the measure along the tangent at a point. Collective."""

    def advance(self, tangent: np.ndarray, size: float) -> float:
        """Return the length along the tangent at the last point that reaches a measure. Collective."""

    def still(self, tangent: np.ndarray) -> np.ndarray:
        """Return the gradient (owned, 3) [1/m] of the displacement that is held where bars have broken."""


class ByArc:
    """Points at a distance from the last one in a metric: the chord of the arc."""

    scale = 0.0

    def __init__(self, metric: Metric) -> None:
        self._metric = metric

    def constraint(self, size: float) -> Constraint:
        """See :class:`Control`."""
        return Arc(self._metric, size)

    def measure(self, u: np.ndarray, change: float) -> float:
        """See :class:`Control`."""
        return self._metric.length(u, change)

    def rate(self, u: np.ndarray, change: float, tangent: np.ndarray, slope: float) -> float:
        """See :class:`Control`."""
        length = self._metric.length(u, change)
        return self._metric.product(u, change, tangent, slope) / length if length else 1.0

    def advance(self, tangent: np.ndarray, size: float) -> float:
        """See :class:`Control`."""
        return size

    def still(self, tangent: np.ndarray) -> np.ndarray:
        """See :class:`Control`: that along the path."""
        return self._metric.weight * tangent


class ByComponent:
    """Points at a displacement along a direction, relative to that of the first response to a unit of load."""

    def __init__(self, direction: Direction) -> None:
        self._direction = direction
        self.scale = 0.0

    def constraint(self, size: float) -> Constraint:
        """See :class:`Control`."""
        return Component(self._direction, size * self.scale, self.scale)

    def measure(self, u: np.ndarray, change: float) -> float:
        """See :class:`Control`."""
        return self._direction.of(u) / self.scale

    def rate(self, u: np.ndarray, change: float, tangent: np.ndarray, slope: float) -> float:
        """See :class:`Control`."""
        return self._direction.of(tangent) / self.scale

    def advance(self, tangent: np.ndarray, size: float) -> float:
        """See :class:`Control`.

        Raises
        ------
        NotConverged
            On all ranks, if the displacement does not increase along the path.
        """
        along = self._direction.of(tangent) / self.scale
        if not along > _LEAST:
            raise NotConverged("the displacement along static.direction does not increase any more along the path")
        return size / along

    def still(self, tangent: np.ndarray) -> np.ndarray:
        """See :class:`Control`."""
        return self._direction.weights / self.scale

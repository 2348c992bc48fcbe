"""The metric of a path, and the constraint that defines each of its points.

Displacements u and changes of the load factor are relative to the last point. Lengths are in units of the load factor:
the first response of the truss to a unit of load has length one, so the first length is an increment of the load
factor.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

if TYPE_CHECKING:
    from mpi4py import MPI

    from ..stepping.model import Model

__all__ = ["Along", "Arc", "Component", "Constraint", "Direction", "LoadFactor", "Metric", "Still", "Terms", "dot"]


def dot(comm: MPI.Comm, a: np.ndarray, b: np.ndarray) -> float:
    """Return the sum over all ranks of the products of owned numbers. Collective."""
    return comm.allreduce(float((a * b).sum()))


class Terms(NamedTuple):
    """A constraint c(u, change of load factor) = 0: its value, and its derivatives by u (owned, 3) and load factor."""

    value: float
    by_u: np.ndarray
    by_load: float


class Constraint(Protocol):
    """The constraint of a point; its value is small or large compared with the length ``size``."""

    size: float

    def terms(self, u: np.ndarray, change: float) -> Terms:
        """Return value and derivatives. Collective."""


@dataclass
class Metric:
    """Length of (u, change): cylindrical, sqrt(w u.u), or spherical, sqrt((w u.u + change^2)/2).

    Attributes
    ----------
    comm : MPI.Comm
    spherical : whether the load factor counts
    weight : w, one over the square of the first response [1/m2]
    """

    comm: MPI.Comm
    spherical: bool
    weight: float = 1.0

    def product(self, u: np.ndarray, change: float, other: np.ndarray, other_change: float) -> float:
        """Return the inner product of two displacements (owned, 3) with changes of the load factor. Collective."""
        by_u = self.weight * dot(self.comm, u, other)
        return 0.5 * (by_u + change * other_change) if self.spherical else by_u

    def length(self, u: np.ndarray, change: float) -> float:
        """Return the length of a displacement with a change of the load factor. Collective."""
        return float(np.sqrt(self.product(u, change, u, change)))


class Arc:
    """The point at a distance: (|(u, change)|^2 - s^2)/(2 s) = 0."""

    def __init__(self, metric: Metric, size: float) -> None:
        self.metric, self.size = metric, size

    def terms(self, u: np.ndarray, change: float) -> Terms:
        """See :class:`Constraint`."""
        metric, s = self.metric, self.size
        value = (metric.product(u, change, u, change) - s * s) / (2.0 * s)
        share = 0.5 if metric.spherical else 1.0
        return Terms(value, (share * metric.weight / s) * u, share * change / s if metric.spherical else 0.0)


class Direction:
    """Mean displacement of a node set along a direction [m].

    Attributes
    ----------
    weights : (owned, 3) of the components; their sum of products with displacements is the mean
    """

    def __init__(self, model: Model, node_set: str, direction: tuple[float, float, float]) -> None:
        self.comm = model.comm
        self._model = model
        nodes = model.nodes[node_set]
        self.weights = np.zeros((model.mesh.n_owned, 3))
        count = model.comm.allreduce(len(nodes))
        self.weights[nodes] = np.array(direction) / (np.linalg.norm(direction) * count)

    def of(self, u: np.ndarray) -> float:
        """Return the mean of displacements (owned, 3) along the direction. Collective."""
        return dot(self.comm, self.weights, u)

    def at(self, position: np.ndarray) -> float:
        """Return that of positions (owned, 3) relative to the mesh or to the start of the stage. Collective."""
        model = self._model
        # a stage gets its start after its analysis is built
        start = model.mesh.points[: model.mesh.n_owned] if model.start is None else model.start.position
        return self.of(position - start)


class Component:
    """The point with a displacement along a direction: (d.u - target)/scale = 0."""

    def __init__(self, direction: Direction, target: float, scale: float) -> None:
        self.direction, self.target, self.scale = direction, target, scale
        self.size = abs(target) / scale

    def terms(self, u: np.ndarray, change: float) -> Terms:
        """See :class:`Constraint`."""
        value = (self.direction.of(u) - self.target) / self.scale
        return Terms(value, self.direction.weights / self.scale, 0.0)


class LoadFactor:
    """The point at a load factor."""

    def __init__(self, change: float, size: float) -> None:
        self.change, self.size = change, size

    def terms(self, u: np.ndarray, change: float) -> Terms:
        """See :class:`Constraint`."""
        return Terms(change - self.change, np.zeros_like(u), 1.0)


class Along:
    """The point at a distance along a mode (owned, 3) of length one: (mode, u) - s = 0."""

    def __init__(self, metric: Metric, mode: np.ndarray, size: float) -> None:
        self.metric, self.mode, self.size = metric, mode, size

    def terms(self, u: np.ndarray, change: float) -> Terms:
        """See :class:`Constraint`."""
        gradient = self.metric.weight * self.mode
        return Terms(dot(self.metric.comm, gradient, u) - self.size, gradient, 0.0)


class Still:
    """The point at an unchanged displacement: gradient.u = 0 with a gradient (owned, 3) [1/m]."""

    def __init__(self, comm: MPI.Comm, gradient: np.ndarray, size: float) -> None:
        self.comm, self.gradient, self.size = comm, gradient, size

    def terms(self, u: np.ndarray, change: float) -> Terms:
        """See :class:`Constraint`."""
        return Terms(dot(self.comm, self.gradient, u), self.gradient, 0.0)

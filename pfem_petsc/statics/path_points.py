"""Points of a path: Newton's method with a constraint, an arc length or linear, and the spectrum of the stiffness."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from ..errors import NotConverged
from ..solvers.matrix import HessianMatrix
from ..solvers.newton import STAGNATION, Tolerance
from .stability import Stability

if TYPE_CHECKING:
    from mpi4py import MPI

    from ..integrators.base import State
    from ..stepping.model import Model
    from .bordered import BorderedSystem


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

    def constraint(self, target: float, scale: float) -> Linear:
        """Return the constraint of the point at a displacement [m] along the direction, over a scale [m]."""
        return Linear(self.comm, self.weights, target, abs(target) / scale, scale)

    def at(self, position: np.ndarray) -> float:
        """Return that of positions (owned, 3) relative to the mesh or to the start of the stage. Collective."""
        model = self._model
        # a stage gets its start after its analysis is built
        start = model.mesh.points[: model.mesh.n_owned] if model.start is None else model.start.position
        return self.of(position - start)


@dataclass
class Linear:
    """The point at which (weights.u + by_load change - target)/scale = 0.

    Attributes
    ----------
    comm : MPI.Comm
    weights : (owned, 3) of displacements, zero where the load factor alone counts
    target, scale : in the unit of weights.u
    size : length with which the value is compared
    by_load : 1 where the load factor is prescribed
    """

    comm: MPI.Comm
    weights: np.ndarray
    target: float
    size: float
    scale: float = 1.0
    by_load: float = 0.0

    def terms(self, u: np.ndarray, change: float) -> Terms:
        """See :class:`Constraint`."""
        value = (dot(self.comm, self.weights, u) + self.by_load * change - self.target) / self.scale
        return Terms(value, self.weights / self.scale, self.by_load)


_MOST = 20  # Newton iterations of a point: more are no sign of a path
_CLOSE = 1e-10  # value of the constraint, over the length of the step
_NEAR = 1e-6  # the same, where it no longer falls


@dataclass
class Point:
    """A point of the path.

    Attributes
    ----------
    u : (owned, 3) displacement from the last point [m]
    load_factor : at the point
    tangent, slope : unit tangent of the path: displacement part (owned, 3) [m] and change of the load factor
    negatives : number of negative eigenvalues of the stiffness, -1 if not computed
    nearest : magnitude of the eigenvalue nearest to zero [N/m]
    newton : number of iterations
    """

    u: np.ndarray
    load_factor: float
    tangent: np.ndarray
    slope: float
    negatives: int
    nearest: float
    newton: int


class PointSolver:
    """Solves for points beyond the present state. Methods are collective.

    Parameters
    ----------
    model : Model
    state : State
    system : BorderedSystem, begun at the state
    metric : Metric
    looks : whether critical points are looked for

    Attributes
    ----------
    stability : Stability, None where critical points are not looked for
    """

    def __init__(self, model: Model, state: State, system: BorderedSystem, metric: Metric, looks: bool) -> None:
        self.model, self.state, self.system, self.metric = model, state, system, metric
        self.stability: Stability | None = None
        self._own: HessianMatrix | None = None
        if looks:
            if not isinstance(system.hessian, HessianMatrix):
                self._own = HessianMatrix(model.mesh, model.supports)
            self.stability = Stability(model, self._own or system.hessian)

    @property
    def place(self) -> str:
        """The point that is solved for, for messages."""
        return f"point {self.state.step + 1}, beyond load factor {self.state.time:.6g}"

    def destroy(self) -> None:
        """Free the PETSc objects."""
        for thing in (self.stability, self._own):
            if thing is not None:
                thing.destroy()

    def find(self, constraint: Constraint, u: np.ndarray, load_factor: float) -> Point:
        """Return the point that satisfies a constraint, with its tangent, from a guess. Collective.

        Raises
        ------
        NotConverged
            On all ranks.
        """
        start = self.state.time
        u, load_factor, newton = self.newton(constraint, u.copy(), load_factor)
        tangent, slope = self.tangent(u, load_factor)
        if self.metric.product(u, load_factor - start, tangent, slope) < 0.0:
            tangent, slope = -tangent, -slope
        negatives, nearest = self.spectrum(u)
        return Point(u, load_factor, tangent, slope, negatives, nearest, newton)

    def newton(self, constraint: Constraint, u: np.ndarray, load_factor: float) -> tuple[np.ndarray, float, int]:
        system, start = self.system, self.state.time
        most = min(self.model.case.solver.max_newton, _MOST)
        comm = self.model.comm
        system.prescribe(u, load_factor)
        g, previous, before = np.empty_like(u), np.inf, np.inf
        tolerance = self.tolerance(u, load_factor, constraint.size)
        for iteration in range(most + 1):
            system.residual(u, load_factor, g)
            norm = float(np.sqrt(dot(comm, g, g)))
            terms = constraint.terms(u, load_factor - start)
            if not np.isfinite(norm + terms.value):
                raise NotConverged(f"{self.place}: Newton's method diverged: the residual is not finite")
            stagnant = iteration >= 1 and norm > 0.5 * previous and tolerance.rounded(norm, g, STAGNATION, comm)
            off = abs(terms.value) / constraint.size
            # beside a bifurcation rounding moves iterates along its modes, and no iteration brings them closer
            near = off <= _CLOSE or (iteration >= 2 and off <= _NEAR and off > 0.5 * before)
            balanced = norm <= tolerance.residual or tolerance.rounded(norm, g, 1.0, comm)
            if (balanced or stagnant) and near:
                return u, load_factor, iteration
            previous, before = norm, off
            if iteration == most:
                break
            system.linearise(u)
            r, v = system.solve(-g), system.response(u, load_factor)
            along = comm.allreduce(np.array([(terms.by_u * r).sum(), (terms.by_u * v).sum()]))
            rate = float(along[1]) + terms.by_load
            if rate == 0.0:
                raise NotConverged(f"{self.place}: the load does not move the truss in the direction of the path")
            change = -(terms.value + along[0]) / rate
            u += r + change * v
            load_factor += float(change)
            system.prescribe(u, load_factor)
        raise NotConverged(
            f"{self.place}: no convergence after {most} Newton iterations: residual {norm:.3g} N, required "
            f"{tolerance.residual:.3g} N"
        )

    def tolerance(self, u: np.ndarray, load_factor: float, size: float) -> Tolerance:
        """Return when a point is balanced: to ``solver.rtol`` of external and internal forces."""
        model, solver, state = self.model, self.model.case.solver, self.state
        external, internal = self.system.external(load_factor), state.f[: len(u)]
        change = self.system.external(load_factor + size) - external
        sums = np.array([(array**2).sum() for array in (external, internal, change)])
        scale = float(np.sqrt(self.model.comm.allreduce(sums).max()))
        required = max(solver.rtol * scale, solver.atol or 0.0)
        return Tolerance(required, required, model.node_rounding, model.rounding)

    def tangent(self, u: np.ndarray, load_factor: float) -> tuple[np.ndarray, float]:
        """Return the unit tangent at an equilibrium along which the load factor increases."""
        self.system.linearise(u)
        v = self.system.response(u, load_factor)
        length = self.metric.length(v, 1.0)
        return v / length, 1.0 / length

    def spectrum(self, u: np.ndarray) -> tuple[int, float]:
        """Return the number of negative eigenvalues of the last stiffness, or -1, and the one nearest to zero."""
        if self.stability is None or self.stability.refusal is not None:
            return -1, np.inf
        if self._own is not None:
            self._own.update(self.system.problem, u)
        return self.stability.look()

    def modes(self, point: Point, count: int) -> list[np.ndarray]:
        """Return critical modes (owned, 3) of unit length at a point, then sums and differences of pairs. Collective.

        They are orthogonal to the path. Paths of symmetric trusses branch off along either.
        """
        (self._own or self.system.hessian).update(self.system.problem, point.u)
        found = []
        for mode in self.stability.modes(count):
            along = self.metric.product(mode, 0.0, point.tangent, 0.0)
            mode = (
                mode - along / max(self.metric.product(point.tangent, 0.0, point.tangent, 0.0), 1e-300) * point.tangent
            )
            found.append(mode / self.metric.length(mode, 0.0))
        pairs = [
            (found[i] + sign * found[j]) for i in range(count) for j in range(i + 1, count) for sign in (1.0, -1.0)
        ]
        return found + [pair / self.metric.length(pair, 0.0) for pair in pairs]

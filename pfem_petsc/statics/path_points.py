"""Points of a path: Newton's method with a constraint, an arc length or linear, and the spectrum of the stiffness."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from ..contact.transform import Transform
from ..errors import NotConverged, SimulationFailure
from ..solvers.lagged import Preconditioning
from ..solvers.linear import LinearChoice, configure, is_failed_factorisation, linear_reason
from ..solvers.matrix import HessianMatrix, StepProblem
from ..solvers.matrix_free import outlive_at_exit
from ..solvers.newton import STAGNATION, Tolerance
from .stability import Stability

if TYPE_CHECKING:
    from ..integrators.base import State
    from ..solvers.lagged import LaggedPreconditioner
    from ..solvers.matrix_free import MatrixFreeHessian
    from ..stepping.model import Model
    from .equilibrium import Equilibrium


def dot(comm: MPI.Comm, a: np.ndarray, b: np.ndarray) -> float:
    """Return the sum over all ranks of the products of owned numbers. Collective."""
    return comm.allreduce(float((a * b).sum()))


_PREFIX = "pfem_path_"
_RTOL = 1e-8  # of iterative solves: tangents locate limit points and are not corrected afterwards
_USABLE = 1e-4  # relative residual at which an iterative solve that has not converged is accepted
_SHARE = 1e-5  # step of differences by the load factor, relative to it; exact for loads that are linear in it


class BorderedSystem:
    """Residual, response to the load, and solves with the tangent stiffness. Created once for a run.

    Options: prefix ``pfem_path_``.

    Parameters
    ----------
    model : Model
    hessian : of the stepper, assembled or matrix-free
    choice : of the linear solver
    lagged : preconditioner that is reused over steps, None if PETSc builds one from the matrix
    scheme : defines the balance
    unit : lower bound of the load factor in the step of differences

    Attributes
    ----------
    problem : StepProblem at the start of the present step
    linear : number of iterations of the linear solver
    """

    def __init__(
        self,
        model: Model,
        hessian: HessianMatrix | MatrixFreeHessian,
        choice: LinearChoice,
        lagged: LaggedPreconditioner | None,
        scheme: Equilibrium,
        unit: float,
    ) -> None:
        self.model, self.hessian, self.lagged, self.scheme = model, hessian, lagged, scheme
        self._unit = unit
        self._transform = Transform(model.mesh)
        self.direct = choice.krylov == "preonly"
        self.linear = 0
        mesh = model.mesh
        self._b = PETSc.Vec().createMPI((3 * mesh.n_owned, 3 * mesh.n_nodes), bsize=3, comm=mesh.comm)
        self._x = self._b.duplicate()
        # beyond a critical point the stiffness is indefinite
        self._choice = choice if self.direct else LinearChoice("gmres", choice.preconditioner, "indefinite")
        self.problem: StepProblem | None = None
        self._ksp = self._solver()

    def _solver(self) -> PETSc.KSP:
        ksp = PETSc.KSP().create(self.model.mesh.comm)
        ksp.setOptionsPrefix(_PREFIX)
        configure(ksp, self._choice, False, None if self.lagged is None else Preconditioning(self.lagged, self))
        if not self.direct:
            ksp.setTolerances(rtol=_RTOL, max_it=2000)
        ksp.setOperators(self.hessian.mat, self.hessian.mat)
        ksp.setFromOptions()
        outlive_at_exit(ksp)
        return ksp

    def begin(self, state: State) -> None:
        """Start a step: displacements are relative to the positions of a state. Collective."""
        balance = self.scheme.balance(state, 0.0)
        self.problem = StepProblem(self.model, state, balance, state.external, self._transform)

    def external(self, load_factor: float) -> np.ndarray:
        """Return the external forces (owned, 3) [N]."""
        out = np.zeros_like(self.problem.u)
        return self.model.external.at(load_factor, out) if self.model.external.active else out

    def prescribe(self, u: np.ndarray, load_factor: float) -> None:
        """Set the prescribed components of displacements (owned, 3)."""
        values = self.model.supports.lacking(self.problem.balance.predictor, load_factor)
        self.model.supports.put(u, values)
        if self.problem.target is not None:
            self.problem.target = values

    def imbalance(self, u: np.ndarray, load_factor: float, g: np.ndarray) -> None:
        """Compute g = f_int - f_ext (owned, 3) [N], including reactions of supports. Collective."""
        self.model.change_bars(load_factor)
        self.problem.known = -self.external(load_factor)
        self.problem.imbalance(u, g)

    def residual(self, u: np.ndarray, load_factor: float, g: np.ndarray) -> None:
        """Compute :meth:`imbalance` with zeros at prescribed components. Collective."""
        self.imbalance(u, load_factor, g)
        self.model.supports.clear(g)

    def rate(self, u: np.ndarray, load_factor: float) -> np.ndarray:
        """Return -dg/d(load factor) (owned, 3) [N] at free components, by central differences. Collective."""
        h = _SHARE * max(abs(load_factor), self._unit)
        model = self.model
        if not (model.bars_vary or model.supports.moves):
            q = (self.external(load_factor + h) - self.external(load_factor - h)) / (2.0 * h)
            model.supports.clear(q)
            return q
        ends = []
        for end in (load_factor + h, load_factor - h):
            there, g = u.copy(), np.empty_like(u)
            self.prescribe(there, end)
            self.residual(there, end, g)
            ends.append(g)
        self.prescribe(u.copy(), load_factor)
        model.change_bars(load_factor)
        return (ends[1] - ends[0]) / (2.0 * h)

    def linearise(self, u: np.ndarray) -> None:
        """Evaluate the tangent stiffness at a displacement (owned, 3). Collective."""
        self.hessian.update(self.problem, u)
        self._ksp.setOperators(self.hessian.mat, self.hessian.mat)

    def linearise_unloading(self) -> None:
        """Evaluate the stiffness with which the state resists small displacements: of bars that yield, that of
        unloading. Collective."""
        self.hessian.put(self.problem, self.model.bars.state_stiffness(self.problem.state.x))
        self._ksp.setOperators(self.hessian.mat, self.hessian.mat)

    def solve(self, b: np.ndarray) -> np.ndarray:
        """Return K^-1 b (owned, 3), zero at prescribed components. Collective.

        Raises
        ------
        NotConverged
            On all ranks, if K is singular or the linear solver does not converge.
        """
        self._b.array[:] = b.ravel()
        self.model.supports.clear(self._b.array.reshape(-1, 3))
        reason = self._attempt()
        if reason < 0 and self.lagged is not None and self.lagged.carried:
            self.lagged.drop()
            self._ksp.setOperators(self.hessian.mat, self.hessian.mat)
            reason = self._attempt()
        x = self._x.array.reshape(b.shape).copy()
        finite = self.model.comm.allreduce(int(np.isfinite(x).all()), op=MPI.MIN)
        if reason < 0 or not finite:
            why = linear_reason(reason) if reason < 0 else "the solution is not finite"
            raise NotConverged(f"the linear system of the tangent stiffness cannot be solved ({why})")
        return x

    def response(self, u: np.ndarray, load_factor: float) -> np.ndarray:
        """Return du/d(load factor) (owned, 3) with the last stiffness, including moving supports. Collective."""
        v = self.solve(self.rate(u, load_factor))
        supports = self.model.supports
        if supports.moves:
            h = _SHARE * max(abs(load_factor), self._unit)
            supports.put(v, (supports.positions(load_factor + h) - supports.positions(load_factor - h)) / (2.0 * h))
        return v

    def _attempt(self) -> int:
        try:
            self._ksp.solve(self._b, self._x)
        except PETSc.Error as error:
            if not is_failed_factorisation(error):
                raise
            self._ksp.destroy()
            self._ksp = self._solver()
            return PETSc.KSP.ConvergedReason.DIVERGED_PCSETUP_FAILED
        self.linear += self._ksp.getIterationNumber()
        reason = self._ksp.getConvergedReason()
        if reason < 0 and not self.direct and self._ksp.getResidualNorm() <= _USABLE * self._b.norm():
            return 1  # close to a critical point the residual stagnates; Newton's method corrects the error
        return reason

    def destroy(self) -> None:
        """Free the PETSc objects."""
        for thing in (self._ksp, self._b, self._x):
            thing.destroy()


@dataclass
class Metric:
    """Length sqrt(w u.u) of displacements u, in units of the load factor.

    Attributes
    ----------
    comm : MPI.Comm
    weight : w, one over the square of the first response [1/m2]
    """

    comm: MPI.Comm
    weight: float = 1.0

    def product(self, u: np.ndarray, other: np.ndarray) -> float:
        """Return the inner product of two displacements (owned, 3). Collective."""
        return self.weight * dot(self.comm, u, other)

    def length(self, u: np.ndarray) -> float:
        """Return the length of a displacement (owned, 3). Collective."""
        return float(np.sqrt(self.product(u, u)))


class Arc:
    """The point of a path at a distance, by the constraint (|u|^2 - s^2)/(2 s) = 0."""

    def __init__(self, metric: Metric, size: float) -> None:
        self.metric, self.size = metric, size

    def terms(self, u: np.ndarray, change: float) -> tuple[float, np.ndarray, float]:
        """Return the value, and its derivatives by u (owned, 3) and by the load factor. Collective."""
        s = self.size
        return (self.metric.product(u, u) - s * s) / (2.0 * s), (self.metric.weight / s) * u, 0.0


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

    def terms(self, u: np.ndarray, change: float) -> tuple[float, np.ndarray, float]:
        """Return the value, and its derivatives by u (owned, 3) and by the load factor. Collective."""
        value = (dot(self.comm, self.weights, u) + self.by_load * change - self.target) / self.scale
        return value, self.weights / self.scale, self.by_load


_ITERATIONS = 20  # Newton iterations of a point: more are no sign of a path
_CAREFUL = 3  # times as many where steps are shortened
_SEARCHES = 12  # for the share of a step
_DECREASE = 0.5  # of the residual along a step
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


_LEAST = 1e-9  # displacement along the direction per length of the path, below which it decreases


class ArcControl:
    """Points at a distance from the last one in a metric, the chord of the arc.

    Attributes
    ----------
    scale : of a prescribed displacement [m]; zero with arc lengths, and before the first point
    """

    def __init__(self, metric: Metric) -> None:
        self.metric, self.scale = metric, 0.0

    def constraint(self, size: float) -> Arc | Linear:
        """Return the constraint of the point at a measure."""
        return Arc(self.metric, size)

    def measure(self, point: Point) -> float:
        """Return the measure of a point. Collective."""
        return self.metric.length(point.u)

    def rate(self, point: Point) -> float:
        """Return the derivative of the measure along the tangent at a point. Collective."""
        length = self.metric.length(point.u)
        return self.metric.product(point.u, point.tangent) / length if length else 1.0

    def length(self, size: float, tangent: np.ndarray) -> float:
        """Return the length along the tangent at the state that reaches a measure. Collective."""
        return size

    def gradient(self, tangent: np.ndarray) -> np.ndarray:
        """Return the gradient (owned, 3) [1/m] of the displacement that is held where bars have broken."""
        return self.metric.weight * tangent

    def orient(self, response: np.ndarray, size: float) -> float:
        """Return the sign of load factors that increase the measure, from the first response (owned, 3) [m] and its
        2-norm. Collective."""
        return 1.0


class DisplacementControl(ArcControl):
    """Points at displacements along a direction, relative to that of the first response to a unit of load."""

    def __init__(self, metric: Metric, direction: Direction) -> None:
        super().__init__(metric)
        self.direction = direction

    def constraint(self, size: float) -> Arc | Linear:
        return self.direction.constraint(size * self.scale, self.scale)

    def measure(self, point: Point) -> float:
        return self.direction.of(point.u) / self.scale

    def rate(self, point: Point) -> float:
        return self.direction.of(point.tangent) / self.scale

    def length(self, size: float, tangent: np.ndarray) -> float:
        along = self.direction.of(tangent) / self.scale
        if not along > _LEAST:
            raise NotConverged("the displacement along static.direction does not increase any more along the path")
        return size / along

    def gradient(self, tangent: np.ndarray) -> np.ndarray:
        return self.direction.weights / self.scale

    def orient(self, response: np.ndarray, size: float) -> float:
        along = self.direction.of(response)
        if not abs(along) > 1e-12 * size:
            raise SimulationFailure(
                "static.direction: the load does not move the nodes of static.node_set along it at the start of "
                'the path; use another direction, or static.method = "arc_length"'
            )
        self.scale = abs(along)
        return float(np.sign(along))


class PointSolver:
    """Solves for points beyond the present state. Methods are collective.

    Parameters
    ----------
    state : State
    system : BorderedSystem, begun at the state; destroyed with this
    metric : Metric
    looks : whether critical points are looked for

    Attributes
    ----------
    stability : Stability, None where critical points are not looked for
    """

    def __init__(self, state: State, system: BorderedSystem, metric: Metric, looks: bool) -> None:
        self.model, self.state, self.system, self.metric = system.model, state, system, metric
        self.stability: Stability | None = None
        if looks:
            assembled = isinstance(system.hessian, HessianMatrix)
            self.stability = Stability(self.model, system.hessian if assembled else None)

    @property
    def place(self) -> str:
        """The point that is solved for, for messages."""
        return f"point {self.state.step + 1}, beyond load factor {self.state.time:.6g}"

    def destroy(self) -> None:
        """Free the PETSc objects."""
        self.system.destroy()
        if self.stability is not None:
            self.stability.destroy()

    def find(self, constraint: Arc | Linear, u: np.ndarray, load_factor: float) -> Point:
        """Return the point that satisfies a constraint, with its tangent, from a guess. Collective.

        Raises
        ------
        NotConverged
            On all ranks.
        """
        guess = u, load_factor
        try:
            u, load_factor, newton = self.newton(constraint, u.copy(), load_factor)
        except NotConverged:
            if not self.model.bars.kept_names:
                raise
            # where bars begin to yield and others to unload, full steps may alternate between two sets of moduli
            if isinstance(constraint, Arc):
                constraint = self._work(guess[0])
            u, load_factor, newton = self.newton(constraint, *self._unloading(constraint, *guess), careful=True)
        tangent, slope = self.tangent(u, load_factor)
        if self.metric.product(u, tangent) < 0.0:
            tangent, slope = -tangent, -slope
        return Point(u, load_factor, tangent, slope, *self.spectrum(u), newton)

    def newton(
        self, constraint: Arc | Linear, u: np.ndarray, load_factor: float, careful: bool = False
    ) -> tuple[np.ndarray, float, int]:
        """Return displacement, load factor and number of iterations of the point, from a guess, in place. Collective.

        ``careful`` : whether steps are along a falling potential, and shortened where the residual along them rises

        Raises
        ------
        NotConverged
            On all ranks.
        """
        system, start = self.system, self.state.time
        most = min(self.model.case.solver.max_newton, (_CAREFUL if careful else 1) * _ITERATIONS)
        comm = self.model.comm
        system.prescribe(u, load_factor)
        g, previous, before = np.empty_like(u), np.inf, np.inf
        tolerance = self.tolerance(u, load_factor, constraint.size)
        for iteration in range(most + 1):
            system.residual(u, load_factor, g)
            norm = float(np.sqrt(dot(comm, g, g)))
            value, by_u, by_load = constraint.terms(u, load_factor - start)
            if not np.isfinite(norm + value):
                raise NotConverged(f"{self.place}: Newton's method diverged: the residual is not finite")
            stagnant = iteration >= 1 and norm > 0.5 * previous and tolerance.rounded(norm, g, STAGNATION, comm)
            off = abs(value) / constraint.size
            # beside a bifurcation rounding moves iterates along its modes, and no iteration brings them closer
            near = off <= _CLOSE or (iteration >= 2 and off <= _NEAR and off > 0.5 * before)
            balanced = norm <= tolerance.residual or tolerance.rounded(norm, g, 1.0, comm)
            if (balanced or stagnant) and near:
                return u, load_factor, iteration
            previous, before = norm, off
            if iteration == most:
                break
            step, change = self._step(constraint, u, load_factor, g)
            share = 1.0
            if careful:
                slope = dot(comm, g, step)
                if slope > 0.0:  # of a saddle
                    step, change = -step, -change
                share = self._share(u, load_factor, step, change, -abs(slope))
            u += share * step
            load_factor += share * change
            system.prescribe(u, load_factor)
        raise NotConverged(
            f"{self.place}: no convergence after {most} Newton iterations: residual {norm:.3g} N, required "
            f"{tolerance.residual:.3g} N"
        )

    def _work(self, u: np.ndarray) -> Linear:
        """Return the constraint of the point at which the load has done the work of a displacement (owned, 3), under
        which equilibria without a change of sign are minima of the potential. Collective."""
        load = self.system.rate(np.zeros_like(u), self.state.time)
        target = dot(self.model.comm, load, u)
        return Linear(self.model.comm, load, target, 1.0, abs(target) or 1.0)

    def _unloading(self, constraint: Arc | Linear, u: np.ndarray, load_factor: float) -> tuple[np.ndarray, float]:
        """Return the point on the tangent of a state whose bars unload, as far as a guess. Collective."""
        system, start, g = self.system, self.state.time, np.empty_like(u)
        value, by_u, by_load = constraint.terms(u, load_factor - start)
        system.residual(np.zeros_like(u), start, g)
        system.linearise_unloading()
        r, v = system.solve(-g), system.response(np.zeros_like(u), start)
        sums = self.model.comm.allreduce(np.array([(by_u * (u - r)).sum(), (by_u * v).sum()]))
        change = float((sums[0] + by_load * (load_factor - start) - value) / (sums[1] + by_load))
        return r + change * v, start + change

    def _step(
        self, constraint: Arc | Linear, u: np.ndarray, load_factor: float, g: np.ndarray
    ) -> tuple[np.ndarray, float]:
        """Return a Newton step (owned, 3) and its change of the load factor, at residuals (owned, 3). Collective."""
        system = self.system
        system.linearise(u)
        value, by_u, by_load = constraint.terms(u, load_factor - self.state.time)
        r, v = system.solve(-g), system.response(u, load_factor)
        along = self.model.comm.allreduce(np.array([(by_u * r).sum(), (by_u * v).sum()]))
        rate = float(along[1]) + by_load
        if rate == 0.0:
            raise NotConverged(f"{self.place}: the load does not move the truss in the direction of the path")
        change = float(-(value + along[0]) / rate)
        return r + change * v, change

    def _share(self, u: np.ndarray, load_factor: float, step: np.ndarray, change: float, slope: float) -> float:
        """Return the share of a step at whose end the residual along it is smaller than at its start, where it is
        ``slope`` [J]. Collective."""
        low, high, share, g = 0.0, 1.0, 1.0, np.empty_like(u)
        for _ in range(_SEARCHES):
            there, factor = u + share * step, load_factor + share * change
            self.system.prescribe(there, factor)
            self.system.residual(there, factor, g)
            along = dot(self.model.comm, g, step)
            if abs(along) <= _DECREASE * abs(slope):
                break
            low, high = (share, high) if along < 0.0 else (low, share)
            if high == 1.0 == share:
                break
            share = 0.5 * (low + high)
        return share

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
        length = self.metric.length(v)
        return v / length, 1.0 / length

    def spectrum(self, u: np.ndarray) -> tuple[int, float]:
        """Return the number of negative eigenvalues of the last stiffness, or -1, and the one nearest to zero."""
        if self.stability is None or self.stability.refusal is not None:
            return -1, np.inf
        if self.stability.matrix is not self.system.hessian:
            self.stability.matrix.update(self.system.problem, u)
        return self.stability.look()

    def modes(self, point: Point, count: int) -> list[np.ndarray]:
        """Return critical modes (owned, 3) of unit length at a point, then sums and differences of pairs. Collective.

        They are orthogonal to the path. Paths of symmetric trusses branch off along either.
        """
        self.stability.matrix.update(self.system.problem, point.u)
        found = []
        for mode in self.stability.modes(count):
            along = self.metric.product(mode, point.tangent) / max(self.metric.length(point.tangent) ** 2, 1e-300)
            mode = mode - along * point.tangent
            found.append(mode / self.metric.length(mode))
        pairs = [
            (found[i] + sign * found[j]) for i in range(count) for j in range(i + 1, count) for sign in (1.0, -1.0)
        ]
        return found + [pair / self.metric.length(pair) for pair in pairs]

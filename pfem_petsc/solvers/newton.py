"""Newton's method by PETSc's SNES, unconstrained or as a variational inequality with bounds."""

from __future__ import annotations

import re
import weakref
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from ..errors import InputError
from ..tolerances import ROUNDING
from .lagged import LaggedPreconditioner, Preconditioning
from .linear import USUAL_REDUCTION, LinearChoice, configure, is_failed_factorisation, linear_reason, newton_reason
from .matrix import HessianMatrix
from .matrix_free import MatrixFreeHessian, outlive_at_exit, pass_less_often

if TYPE_CHECKING:
    from ..mechanics.elements import BlockPattern
    from ..mesh.distribution import DistributedMesh
    from .matrix import StepProblem

STAGNATION = 100.0
"""A residual within this many rounding errors that no longer falls has converged."""
_CAREFUL = "bt"  # PETSc's line search where full steps fail
_SAMPLES = np.linspace(0.0, 1.0, 9)  # of a step
_PREFIXES = "pfem_", "pfem_contact_"  # of steps without bounds, and with bounds


def zero_tolerance(length: float) -> float:
    """Return the distance from a bound [m] that counts as zero for a model of ``length`` [m]: rounding of positions."""
    return ROUNDING * length


def largest_at_node(mesh: DistributedMesh, vectors: np.ndarray) -> tuple[float, int]:
    """Return the 2-norm of the largest of vectors (owned, 3), and the mesh number of its node. Collective."""
    size = np.linalg.norm(np.nan_to_num(vectors, nan=np.inf), axis=1)
    at = int(np.argmax(size)) if len(size) else 0
    return max(mesh.comm.allgather((float(size[at]), int(mesh.node_ids[at])) if len(size) else (0.0, -1)))


class Tolerance(NamedTuple):
    """When a solve ends.

    The 2-norm of the residual is required to be ``residual``. What rounding of positions leaves beyond that is accepted
    after an iteration, node by node: a stiff bar must not hide that the load on a soft one is not balanced.

    Attributes
    ----------
    residual : required 2-norm of the residual [N]
    guess : the same of the guess, below which no iteration is made [N]
    nodes : (owned,) residual of each node due to rounding [N]
    rounding : 2-norm of these over all nodes [N]
    """

    residual: float
    guess: float
    nodes: np.ndarray
    rounding: float

    def rounded(self, norm: float, g: np.ndarray, factor: float, comm: MPI.Comm) -> bool:
        """Return whether residuals (owned, 3) of a 2-norm [N] are due to rounding, up to a factor, and to the required
        one beyond that. Collective."""
        if not norm <= factor * self.rounding:
            return False
        beyond = np.maximum(np.linalg.norm(g, axis=1) - factor * self.nodes, 0.0)
        return comm.allreduce(float((beyond**2).sum())) <= self.residual**2


@dataclass(frozen=True)
class NewtonReport:
    """Statistics of a solve; ``why`` is empty if it converged."""

    converged: bool
    newton: int
    linear: int
    norm: float
    why: str

    def then(self, later: NewtonReport) -> NewtonReport:
        """Return the report of a later attempt, with the iterations of both."""
        return NewtonReport(
            later.converged, self.newton + later.newton, self.linear + later.linear, later.norm, later.why
        )


_WELL = 0.1  # of the required residual: what the last linear solve of a step leaves of it
_FEW = 0.5  # of the residual that linearisation leaves: what linear solves before the last leave beside it
_LEAST, _MOST = 1e-7, 1e-2  # reductions by a linear solve before the last


class Forcing:
    """How accurately linear systems are solved and when they are made again (inexact Newton methods).

    After an iteration the residual consists of that of its linear system, which is known, and of that of linearisation.
    The latter grows with the square of the residual before. More accurate solutions than it allows are wasted, and less
    accurate ones make another iteration necessary. In the first iteration it is expected from the last solve.

    Attributes
    ----------
    curvature : residual of linearisation over the square of the residual before, in the first iteration of the last
        solve [1/N]; negative if there was none
    renews : whether the Hessian changes noticeably
    """

    def __init__(self) -> None:
        self.curvature = -1.0
        self.renews = True
        self._rest = 0.0  # residual of linearisation in the next iteration [N], as expected

    def begin(self, norm: float) -> None:
        """Begin a solve with a residual of a 2-norm [N]."""
        self._rest = self.curvature * norm**2
        self.renews = True

    def note(self, before: float, linear: float, norm: float, required: float, first: bool) -> None:
        """Take account of an iteration: 2-norms [N] of the residuals before it, of its linear system, and after it, and
        that of the solution."""
        rest, share = float(np.sqrt(max(norm**2 - linear**2, 0.0))), norm / max(before, 1e-300)
        if first and before > 0.0:
            self.curvature = rest / before**2
        self._rest = rest * share**2
        self.renews = not 2.0 * rest * share < _WELL * required

    def reduction(self, norm: float, tolerance: Tolerance) -> float:
        """Return the factor by which the next linear solve reduces a residual of a 2-norm [N]."""
        if self._rest < 0.0 or norm == 0.0:
            return USUAL_REDUCTION
        left = max(_WELL * tolerance.residual, min(_FEW * self._rest, _MOST * norm))
        left = max(left, min(_WELL * tolerance.rounding, USUAL_REDUCTION * norm))
        return min(max(left / norm, _LEAST), 0.5)


class NewtonSolver:
    """Solves for the position increment of a step; created once per run.

    Newton's method makes full steps. The residual of a stiff bar that turns rises by orders of magnitude in the first,
    and a line search that demands a decrease would make steps that are far too short. Full steps have failed if the
    residual rises and the truss gives way along the step, if a later step is not shorter than that of the rise (natural
    monotonicity, Deuflhard 2004), or if the residual rises again in a step longer than half of that: full steps of bars
    that yield or touch may alternate between two states for ever. The solve is then repeated with a line search. If
    the user's options select a method or a line search, no other is used.

    Options: prefix ``pfem_`` for free steps, ``pfem_contact_`` for steps with bounds, which have their own linear
    solver, ``bounded``.

    Attributes
    ----------
    problem : the current problem
    forcing : of its linear solves
    lagged : preconditioner of all solvers, None if PETSc builds one from the operator
    limits : whether steps are shortened so that no bar passes through another
    """

    limits = False

    def __init__(
        self,
        mesh: DistributedMesh,
        hessian: HessianMatrix | MatrixFreeHessian,
        choice: LinearChoice,
        bounded: LinearChoice,
        max_newton: int,
        length: float,
        lagged: LaggedPreconditioner | None = None,
    ) -> None:
        self.mesh = mesh
        self.lagged = lagged
        self.hessian = hessian
        self._pattern: BlockPattern | None = None  # that the linear solvers have seen, where bars touch
        self.choice, self.bounded = choice, bounded
        self.max_newton = max_newton
        self.length = length
        self._u = PETSc.Vec().createMPI((3 * mesh.n_owned, 3 * mesh.n_nodes), bsize=3, comm=mesh.comm)
        self._g = self._u.duplicate()
        self._lower = self._u.duplicate()
        self._upper = self._u.duplicate()
        self._solvers: dict[tuple[bool, bool], PETSc.SNES] = {}
        self.problem: StepProblem | None = None
        self._ours: dict[tuple[bool, bool], Preconditioning] = {}
        self.forcing = Forcing()
        self._previous = self._longest = np.inf
        self._full = self._forces = self._limited = False
        self._place = np.zeros((mesh.n_owned, 3))  # the last iterate of full steps

    def solve(
        self,
        problem: StepProblem,
        u: np.ndarray,
        tolerance: Tolerance,
        bounds: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> NewtonReport:
        """Solve in place. Collective.

        Parameters
        ----------
        problem : StepProblem
        u : (owned, 3) float64
            Guess on entry, solution on exit [m].
        tolerance : Tolerance
        bounds : pair of (owned, 3) arrays, optional
            Lower and upper bounds on u [m]; infinite where there is no bound.
        """
        contact = bounds is not None
        self.problem = problem
        self._tolerance, self._bounds, self._suffices = tolerance, bounds, False
        if contact:
            lower, upper = bounds
            self._lower.array[:] = np.maximum(lower, PETSc.NINFINITY).ravel()
            self._upper.array[:] = np.minimum(upper, PETSc.INFINITY).ravel()
        start, options = u.copy(), PETSc.Options(_PREFIXES[contact])
        self._full = not (options.hasName("snes_linesearch_type") or options.hasName("snes_type"))
        self._forces = (self.bounded if contact else self.choice).krylov != "preonly" and not options.hasName(
            "ksp_rtol"
        )
        report = self._search(start, contact)
        if not report.converged and self._suffices:
            # the iteration that was to improve a sufficient guess failed, as where the stiffness is singular
            return NewtonReport(True, report.newton, report.linear, self._first, "")
        # after steps that converge, but slowly, or if the first cannot be made, a line search does not help
        if self._full and not report.converged and 0 < report.newton < self.max_newton:
            self._full = False
            report = report.then(self._search(start, contact, careful=True))
        u[:] = self._u.array.reshape(u.shape)
        return report

    def failure_message(self, w: np.ndarray, report: NewtonReport, remedy: str) -> str:
        """Return the message about a solve that did not converge, with the last iterate (owned, 3) in the coordinates
        of the problem: iterations, reason, worst node, and what the user can do. Collective."""
        g = np.empty_like(w)
        self.problem.residual(w, g)
        if self._bounds is not None:  # forces on active bounds are not part of the error
            lower, upper = self._bounds
            g[((w <= lower) & (g > 0.0)) | ((w >= upper) & (g < 0.0))] = 0.0
        residual, node = largest_at_node(self.mesh, g)
        return (
            f"no convergence after {report.newton} Newton iterations: {report.why}; residual {report.norm:.3g} N, "
            f"required {self._tolerance.residual:.3g} N; worst at node {node} ({residual:.3g} N). "
            f"{remedy[0].upper()}{remedy[1:]}"
        )

    def prepare(self, contact: bool) -> None:
        """Create the solvers of free steps and, if ``contact``, of steps with bounds in advance. Collective.

        Raises
        ------
        InputError
            On all ranks, if PETSc rejects an option.
        """
        try:
            for bounded in (False, True) if contact else (False,):
                self._solver(bounded)
        except PETSc.Error as error:
            words = re.split(r"\[\d+\]", str(error))[-1].strip()
            raise InputError(f"options after --: PETSc rejects an option of the solvers: {words}") from error

    def forget_bounded(self) -> None:
        """Free the solvers of steps with bounds, whose matrix has changed; the next step creates others. Collective."""
        for key in [key for key in self._solvers if key[0]]:
            self._solvers.pop(key).destroy()
            self._ours.pop(key, None)

    def destroy(self) -> None:
        """Free the PETSc objects."""
        for snes in self._solvers.values():
            snes.destroy()
        self._solvers.clear()
        self._ours.clear()
        self.problem = None
        for vector in (self._u, self._g, self._lower, self._upper):
            vector.destroy()

    def _search(self, start: np.ndarray, contact: bool, careful: bool = False) -> NewtonReport:
        """Solve from a guess, with full steps or with a line search, and with another linear solver if necessary."""
        report = self._attempt(start, contact, careful)
        if not report.converged and self.lagged is not None and self.lagged.carried:
            self.lagged.drop()
            report = report.then(self._attempt(start, contact, careful))
        if "INDEFINITE" in report.why or "BREAKDOWN" in report.why:
            report = report.then(self._without_definiteness(start, contact, careful))
        if (careful or not report.converged) and (contact, careful) in self._solvers:
            self._solvers[contact, careful].getKSP().reset()  # only one keeps a factorisation
        return report

    def _attempt(self, start: np.ndarray, contact: bool, careful: bool) -> NewtonReport:
        snes = self._solver(contact, careful)
        if contact:
            snes.setVariableBounds(self._lower, self._upper)
        self._u.array[:] = start.ravel()
        self._previous = self._longest = np.inf
        try:
            snes.solve(None, self._u)
        except PETSc.Error as error:
            if not is_failed_factorisation(error):
                raise
            why = "a linear solve failed; linear solver: MUMPS could not factorise the matrix (a singular matrix)"
            report = NewtonReport(False, snes.getIterationNumber(), 0, self._g.norm(), why)
            # the error has left the solver in the middle of a solve; the next solve makes another
            del self._solvers[contact, careful]
            self._ours.pop((contact, careful), None)
            snes.destroy()
            return report
        reason = snes.getConvergedReason()
        norm = snes.getFunctionNorm()
        converged = reason > 0 or self._rounded(norm, STAGNATION)
        why = ""
        if not converged:
            why = newton_reason(reason)
            linear = snes.getKSP().getConvergedReason()
            if linear < 0:
                why += f"; linear solver: {linear_reason(linear)}"
        return NewtonReport(converged, snes.getIterationNumber(), snes.getLinearSolveIterations(), norm, why)

    def _without_definiteness(self, start: np.ndarray, contact: bool, careful: bool) -> NewtonReport:
        """Solve with a method for indefinite tangents after conjugate gradients has failed."""
        ksp = self._solver(contact, careful).getKSP()
        choice, ours = self.bounded if contact else self.choice, self._ours.get((contact, careful))
        configure(ksp, LinearChoice("gmres", choice.preconditioner, "indefinite"), True, ours)
        report = self._attempt(start, contact, careful)
        configure(ksp, choice, contact, ours)
        pass_less_often(ksp, self.hessian)
        return report

    def _solver(self, contact: bool, careful: bool = False) -> PETSc.SNES:
        key = contact, careful
        if key in self._solvers:
            return self._solvers[key]
        snes = PETSc.SNES().create(self.mesh.comm)
        snes.setOptionsPrefix(_PREFIXES[contact])
        snes.setType("vinewtonrsls" if contact else "newtonls")
        # Methods are looked up at each call, because log events may be wrapped around them later. PETSc's solver must
        # not keep this object alive, which owns it: Python's garbage collector cannot see such a cycle.
        this = weakref.ref(self)
        snes.setFunction(lambda *arguments: this()._residual(*arguments), self._g)
        matrix = self.hessian.bounded if contact else self.hessian.mat
        snes.setJacobian(lambda *arguments: this()._hessian(*arguments), matrix, matrix)
        snes.setTolerances(rtol=0.0, atol=0.0, stol=0.0, max_it=self.max_newton)
        snes.setConvergenceTest(lambda *arguments: this()._converged(*arguments))
        if self.limits:
            snes.setLineSearchPreCheck(lambda *arguments: this()._limit(*arguments))
        defaults: dict[str, str | float] = {"snes_linesearch_type": _CAREFUL if careful else "basic"}
        if contact:
            # PETSc's default of 1e-8 is absolute: a node that close to its bound would be fixed there, off the bound
            defaults["snes_vi_zero_tolerance"] = zero_tolerance(self.length)
        if self.lagged is not None:
            solver, first = weakref.ref(snes), 3 * self.mesh.first_node
            inactive = (lambda: solver().getVIInactiveSet().getIndices() - first) if contact else None
            self._ours[key] = Preconditioning(self.lagged, self, inactive)
        configure(snes.getKSP(), self.bounded if contact else self.choice, contact, self._ours.get(key))
        # options are global to the process, but the next solver has other defaults
        options = PETSc.Options(_PREFIXES[contact])
        defaults = {name: value for name, value in defaults.items() if not options.hasName(name)}
        for name, value in defaults.items():
            options[name] = value
        try:
            snes.setFromOptions()
        finally:
            for name in defaults:
                options.delValue(name)
        pass_less_often(snes.getKSP(), self.hessian)
        self._solvers[key] = snes
        outlive_at_exit(snes)
        return snes

    def _residual(self, snes: PETSc.SNES, u: PETSc.Vec, g: PETSc.Vec) -> None:
        shape = (self.mesh.n_owned, 3)
        with g as out:
            self.problem.residual(u.getArray(readonly=True).reshape(shape), out.reshape(shape))

    def _hessian(self, snes: PETSc.SNES, u: PETSc.Vec, matrix: PETSc.Mat, preconditioner: PETSc.Mat) -> None:
        if self._forces:
            reduction = self.forcing.reduction(self._previous, self._tolerance)
            snes.getKSP().setTolerances(rtol=reduction)
            if self.lagged is not None:
                self.lagged.expect(reduction)
            if not self.forcing.renews and self.lagged is None:
                return
        array = u.getArray(readonly=True).reshape(self.mesh.n_owned, 3)
        self.hessian.update(self.problem, array)
        if self.limits and self.hessian.pattern is not self._pattern:
            self._pattern = self.hessian.pattern
            for solver in self._solvers.values():  # PETSc would go on with the factorisation of another pattern
                solver.getKSP().reset()

    def _limit(self, u: PETSc.Vec, step: PETSc.Vec) -> bool:
        """Shorten a step in which bars would pass through each other; return whether it was."""
        start, way = (each.getArray(readonly=True).reshape(self._place.shape) for each in (u, step))
        end = start - way
        if self._bounds is not None:
            end = np.clip(end, *self._bounds)
        part = self.problem.free_part(start, end)
        self._limited = part < 1.0
        if self._limited:
            step.scale(part)
        return self._limited

    def _converged(self, snes: PETSc.SNES, iteration: int, norms: tuple[float, float, float]) -> int:
        _, step, norm = norms
        previous, self._previous = self._previous, norm
        if not np.isfinite(norm):
            return PETSc.SNES.ConvergedReason.DIVERGED_FNORM_NAN
        tolerance = self._tolerance
        if iteration == 0:
            self._first, self._suffices = norm, norm <= tolerance.residual
            self.forcing.begin(norm)
        elif self._forces:
            linear = snes.getKSP().getResidualNorm()
            self.forcing.note(previous, linear, norm, tolerance.residual, iteration == 1)
        if norm <= (tolerance.residual if iteration else tolerance.guess):
            return PETSc.SNES.ConvergedReason.CONVERGED_FNORM_ABS
        if iteration and (self._rounded(norm, 1.0) or (norm > 0.5 * previous and self._rounded(norm, STAGNATION))):
            return PETSc.SNES.ConvergedReason.CONVERGED_SNORM_RELATIVE
        if self._limited:
            self._longest, self._limited = np.inf, False
            self._place[:] = snes.getSolution().getArray(readonly=True).reshape(self._place.shape)
        elif self._full:
            if not step < self._longest:
                return PETSc.SNES.ConvergedReason.DIVERGED_DTOL
            place = snes.getSolution().getArray(readonly=True).reshape(self._place.shape)
            if not norm < previous:
                again, self._longest = step > 0.5 * self._longest, step
                if again or not self._stiffens(self._place, place):
                    return PETSc.SNES.ConvergedReason.DIVERGED_DTOL
            self._place[:] = place
        return PETSc.SNES.ConvergedReason.ITERATING

    def _rounded(self, norm: float, factor: float) -> bool:
        """Return whether the last residual, of the given 2-norm [N], is due to rounding up to a factor. Collective."""
        if not norm <= factor * self._tolerance.rounding:
            return False
        g = self._g.array.reshape(self.mesh.n_owned, 3)
        if self._bounds is not None:  # forces on active bounds are not part of the residual
            w, near = self._u.array.reshape(g.shape), zero_tolerance(self.length)
            lower, upper = self._bounds
            g = np.where(((w <= lower + near) & (g > 0.0)) | ((w >= upper - near) & (g < 0.0)), 0.0, g)
        return self._tolerance.rounded(norm, g, factor, self.mesh.comm)

    def _stiffens(self, start: np.ndarray, end: np.ndarray) -> bool:
        """Return whether the force along a step grows from its start to its end. Collective.

        It does where bars turn. Where it falls in between, the truss gives way, and the solution at which full steps
        arrive may be that of a truss that has snapped.
        """
        step = end - start
        g, along = np.empty_like(step), np.empty(len(_SAMPLES))
        for k, part in enumerate(_SAMPLES):
            self.problem.residual(start + part * step, g)
            along[k] = (g * step).sum()
        self.mesh.comm.Allreduce(MPI.IN_PLACE, along)
        return bool((np.diff(along) > 0.0).all())

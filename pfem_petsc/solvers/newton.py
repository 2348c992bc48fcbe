"""Newton's method by PETSc's SNES, unconstrained or as a variational inequality with bounds."""

from __future__ import annotations

import re
import weakref
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from ..errors import InputError
from ..tolerances import ROUNDING
from .lagged import LaggedPreconditioner, Preconditioning
from .linear import LinearChoice, configure
from .matrix import HessianMatrix
from .matrix_free import MatrixFreeHessian
from .outlive import at_exit, outlive
from .reasons import is_failed_factorisation, linear_reason, newton_reason

if TYPE_CHECKING:
    from ..mesh.distribution import DistributedMesh

__all__ = ["STAGNATION", "NewtonReport", "NewtonSolver", "Problem", "Tolerance", "zero_tolerance"]

STAGNATION = 100.0
"""A residual within this many rounding errors that no longer falls has converged."""


def zero_tolerance(length: float) -> float:
    """Return the distance from a bound [m] that counts as zero for a model of ``length`` [m]: rounding of positions."""
    return ROUNDING * length


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


class Problem(Protocol):
    """The problem g(u) = 0, or g(u) complementary to bounds on u."""

    def residual(self, u: np.ndarray, g: np.ndarray) -> None:
        """Write g(u) (owned, 3) [N]."""


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


class NewtonSolver:
    """Solves for the position increment of a step; created once per run.

    Options: prefix ``pfem_`` for free steps, ``pfem_contact_`` for steps with bounds, and ``pfem_contact_full_`` for
    steps with bounds that are repeated without a line search. Steps with bounds have their own linear solver,
    ``bounded``.

    Attributes
    ----------
    problem : the current problem
    lagged : preconditioner of all solvers, None if PETSc builds one from the operator
    """

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
        self.choice, self.bounded = choice, bounded
        self.max_newton = max_newton
        self.length = length
        self._u = PETSc.Vec().createMPI((3 * mesh.n_owned, 3 * mesh.n_nodes), bsize=3, comm=mesh.comm)
        self._g = self._u.duplicate()
        self._lower = self._u.duplicate()
        self._upper = self._u.duplicate()
        self._solvers: dict[tuple[bool, bool], PETSc.SNES] = {}
        self.problem: Problem | None = None
        self._ours: dict[tuple[bool, bool], Preconditioning] = {}
        self._previous = np.inf

    def solve(
        self,
        problem: Problem,
        u: np.ndarray,
        tolerance: Tolerance,
        bounds: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> NewtonReport:
        """Solve in place. Collective.

        Parameters
        ----------
        problem : Problem
        u : (owned, 3) float64
            Guess on entry, solution on exit [m].
        tolerance : Tolerance
        bounds : pair of (owned, 3) arrays, optional
            Lower and upper bounds on u [m]; infinite where there is no bound.
        """
        snes = self._solver(bounds is not None)
        self.problem = problem
        self._tolerance, self._bounds, self._suffices = tolerance, bounds, False
        if bounds is not None:
            lower, upper = bounds
            self._lower.array[:] = np.maximum(lower, PETSc.NINFINITY).ravel()
            self._upper.array[:] = np.minimum(upper, PETSc.INFINITY).ravel()
            snes.setVariableBounds(self._lower, self._upper)
        start = u.copy()
        report = self._attempt(snes, start)
        if not report.converged and self._suffices:
            # the iteration that was to improve a sufficient guess failed, as where the stiffness is singular
            return NewtonReport(True, report.newton, report.linear, self._first, "")
        if not report.converged and self.lagged is not None and self.lagged.carried:
            self.lagged.drop()
            snes = self._solver(bounds is not None)
            if bounds is not None:
                snes.setVariableBounds(self._lower, self._upper)
            report = report.then(self._attempt(snes, start))
        if not report.converged and "INDEFINITE" in report.why or "BREAKDOWN" in report.why:
            report = self._without_definiteness(snes, start, report)
        if not report.converged and bounds is not None and "LINE_SEARCH" in report.why:
            report = self._with_full_steps(start, report)
        u[:] = self._u.array.reshape(u.shape)
        return report

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

    def destroy(self) -> None:
        """Free the PETSc objects."""
        for snes in self._solvers.values():
            snes.destroy()
        self._solvers.clear()
        self._ours.clear()
        self.problem = None
        for vector in (self._u, self._g, self._lower, self._upper):
            vector.destroy()

    def _attempt(self, snes: PETSc.SNES, start: np.ndarray) -> NewtonReport:
        self._u.array[:] = start.ravel()
        self._previous = np.inf
        try:
            snes.solve(None, self._u)
        except PETSc.Error as error:
            if not is_failed_factorisation(error):
                raise
            why = "a linear solve failed; linear solver: MUMPS could not factorise the matrix (a singular matrix)"
            report = NewtonReport(False, snes.getIterationNumber(), 0, self._g.norm(), why)
            self._drop(snes)
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

    def _drop(self, snes: PETSc.SNES) -> None:
        """Destroy a solver that an error has left in the middle of a solve; the next makes another. Collective."""
        key = next(key for key, solver in self._solvers.items() if solver is snes)
        del self._solvers[key]
        self._ours.pop(key, None)
        snes.destroy()

    def _without_definiteness(self, snes: PETSc.SNES, start: np.ndarray, first: NewtonReport) -> NewtonReport:
        """Repeat the solve with a method for indefinite tangents after conjugate gradients has failed."""
        ksp = snes.getKSP()
        bounds = snes.getType() == "vinewtonrsls"
        choice = self.bounded if bounds else self.choice
        ours = self._ours.get((bounds, False))
        configure(ksp, LinearChoice("gmres", choice.preconditioner, "indefinite"), True, ours)
        second = self._attempt(snes, start)
        configure(ksp, choice, bounds, ours)
        return NewtonReport(
            second.converged, first.newton + second.newton, first.linear + second.linear, second.norm, second.why
        )

    def _with_full_steps(self, start: np.ndarray, first: NewtonReport) -> NewtonReport:
        """Repeat the solve with full steps: in oblique coordinates the residual may grow before it decreases."""
        snes = self._solver(True, full_steps=True)
        snes.setVariableBounds(self._lower, self._upper)
        return first.then(self._attempt(snes, start))

    def _solver(self, contact: bool, full_steps: bool = False) -> PETSc.SNES:
        key = contact, full_steps
        if key in self._solvers:
            return self._solvers[key]
        snes = PETSc.SNES().create(self.mesh.comm)
        prefix = "pfem_contact_full_" if full_steps else "pfem_contact_" if contact else "pfem_"
        snes.setOptionsPrefix(prefix)
        if full_steps:
            PETSc.Options(prefix)["snes_linesearch_type"] = "basic"
        snes.setType("vinewtonrsls" if contact else "newtonls")
        # Methods are looked up at each call, because log events may be wrapped around them later. PETSc's solver must
        # not keep this object alive, which owns it: Python's garbage collector cannot see such a cycle.
        this = weakref.ref(self)
        snes.setFunction(lambda *arguments: this()._residual(*arguments), self._g)
        matrix = self.hessian.bounded if contact else self.hessian.mat
        snes.setJacobian(lambda *arguments: this()._hessian(*arguments), matrix, matrix)
        snes.setTolerances(rtol=0.0, atol=0.0, stol=0.0, max_it=self.max_newton)
        snes.setConvergenceTest(lambda *arguments: this()._converged(*arguments))
        if contact:
            # PETSc's default of 1e-8 is absolute: a node that close to its bound would be fixed there, off the bound
            options = PETSc.Options(snes.getOptionsPrefix())
            ours = not options.hasName("snes_vi_zero_tolerance")
            if ours:
                options["snes_vi_zero_tolerance"] = zero_tolerance(self.length)
        if self.lagged is not None:
            self._ours[key] = Preconditioning(self.lagged, self, snes, bounded=contact)
        configure(snes.getKSP(), self.bounded if contact else self.choice, contact, self._ours.get(key))
        snes.setFromOptions()
        if contact and ours:
            # options are global to the process, but the next model has another length
            options.delValue("snes_vi_zero_tolerance")
        self._solvers[key] = snes
        at_exit(outlive, snes)
        return snes

    def _residual(self, snes: PETSc.SNES, u: PETSc.Vec, g: PETSc.Vec) -> None:
        shape = (self.mesh.n_owned, 3)
        with g as out:
            self.problem.residual(u.getArray(readonly=True).reshape(shape), out.reshape(shape))

    def _hessian(self, snes: PETSc.SNES, u: PETSc.Vec, matrix: PETSc.Mat, preconditioner: PETSc.Mat) -> None:
        array = u.getArray(readonly=True).reshape(self.mesh.n_owned, 3)
        self.hessian.update(self.problem, array)

    def _converged(self, snes: PETSc.SNES, iteration: int, norms: tuple[float, float, float]) -> int:
        norm = norms[2]
        previous, self._previous = self._previous, norm
        if not np.isfinite(norm):
            return PETSc.SNES.ConvergedReason.DIVERGED_FNORM_NAN
        tolerance = self._tolerance
        if iteration == 0:
            self._first, self._suffices = norm, norm <= tolerance.residual
        if norm <= (tolerance.residual if iteration else tolerance.guess):
            return PETSc.SNES.ConvergedReason.CONVERGED_FNORM_ABS
        if iteration and (self._rounded(norm, 1.0) or (norm > 0.5 * previous and self._rounded(norm, STAGNATION))):
            return PETSc.SNES.ConvergedReason.CONVERGED_SNORM_RELATIVE
        return PETSc.SNES.ConvergedReason.ITERATING

    def _rounded(self, norm: float, factor: float) -> bool:
        """Return whether the last residual, of the given 2-norm [N], is due to rounding up to a factor. Collective."""
        g = self._g.array.reshape(self.mesh.n_owned, 3)
        if self._bounds is not None:  # forces on active bounds are not part of the residual
            w, near = self._u.array.reshape(g.shape), zero_tolerance(self.length)
            lower, upper = self._bounds
            g = np.where(((w <= lower + near) & (g > 0.0)) | ((w >= upper - near) & (g < 0.0)), 0.0, g)
        return self._tolerance.rounded(norm, g, factor, self.mesh.comm)

"""Equilibrium and its derivatives as functions of displacements and load factor, and the linear solves of a path.

The unknowns of a point are the displacement u and the load factor. The equations are f_int(u) - f_ext(load factor) = 0
and a constraint. An iteration of Newton's method makes two solves with the tangent stiffness K, K r = -g for the
residual g and K v = -dg/d(load factor) for the response to the load; the constraint gives the change of the load factor
(Batoz and Dhatt 1979; Riks 1979). Only K is factorised, which is singular at critical points only, so that any linear
solver can be used.
"""

from __future__ import annotations

import weakref
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from ..contact.transform import Transform
from ..errors import NotConverged
from ..solvers.lagged import LaggedPreconditioner
from ..solvers.linear import LinearChoice, configure
from ..solvers.outlive import at_exit
from ..solvers.reasons import is_failed_factorisation, linear_reason
from ..stepping.problem import StepProblem

if TYPE_CHECKING:
    from ..integrators.base import State
    from ..solvers.matrix import HessianMatrix
    from ..solvers.matrix_free import MatrixFreeHessian
    from ..stepping.model import Model
    from .path_scheme import PathEquilibrium

__all__ = ["BorderedSystem"]

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
        scheme: PathEquilibrium,
        unit: float,
    ) -> None:
        self.model, self.hessian, self.lagged, self.scheme = model, hessian, lagged, scheme
        self._unit = unit
        self._transform = Transform(model)
        self.direct = choice.krylov == "preonly"
        self.linear = 0
        mesh = model.mesh
        self._b = PETSc.Vec().createMPI((3 * mesh.n_owned, 3 * mesh.n_nodes), bsize=3, comm=mesh.comm)
        self._x = self._b.duplicate()
        # beyond a critical point the stiffness is indefinite
        self._choice = choice if self.direct else LinearChoice("gmres", choice.preconditioner, "indefinite")
        self._ksp = self._solver()
        self.problem: StepProblem | None = None

    def _solver(self) -> PETSc.KSP:
        ksp = PETSc.KSP().create(self.model.mesh.comm)
        ksp.setOptionsPrefix(_PREFIX)
        configure(ksp, self._choice, False, None if self.lagged is None else _Preconditioning(self))
        if not self.direct:
            ksp.setTolerances(rtol=_RTOL, max_it=2000)
        ksp.setOperators(self.hessian.mat, self.hessian.mat)
        ksp.setFromOptions()
        at_exit(_let_go, ksp)
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
        supports = self.model.supports
        if supports.any:
            values = supports.lacking(self.problem.balance.predictor, load_factor)
            supports.put(u, values)
            if self.problem.target is not None:
                self.problem.target = values

    def imbalance(self, u: np.ndarray, load_factor: float, g: np.ndarray) -> None:
        """Compute g = f_int - f_ext (owned, 3) [N], including reactions of supports. Collective."""
        if self.model.bars_vary:
            self.model.change_bars(load_factor)
        self.problem.known = -self.external(load_factor)
        self.problem.imbalance(u, g)

    def residual(self, u: np.ndarray, load_factor: float, g: np.ndarray) -> None:
        """Compute :meth:`imbalance` with zeros at prescribed components. Collective."""
        self.imbalance(u, load_factor, g)
        if self.model.supports.any:
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
        if model.bars_vary:
            model.change_bars(load_factor)
        return (ends[1] - ends[0]) / (2.0 * h)

    def linearise(self, u: np.ndarray) -> None:
        """Evaluate the tangent stiffness at a displacement (owned, 3). Collective."""
        self.hessian.update(self.problem, u)
        self._ksp.setOperators(self.hessian.mat, self.hessian.mat)

    def solve(self, b: np.ndarray) -> np.ndarray:
        """Return K^-1 b (owned, 3), zero at prescribed components. Collective.

        Raises
        ------
        NotConverged
            On all ranks, if K is singular or the linear solver does not converge.
        """
        self._b.array[:] = b.ravel()
        if self.model.supports.any:
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


def _let_go(reference: weakref.ref) -> None:
    """Detach Python objects from a solver that outlives the interpreter, because PETSc would call them."""
    ksp = reference()
    if ksp:
        ksp.getPC().setType("none")
        for matrix in ksp.getOperators():
            if matrix and matrix.getType() == "python":
                matrix.incRef()


class _Preconditioning:
    """Callbacks of PETSc for the preconditioner that is reused over steps."""

    def __init__(self, system: BorderedSystem) -> None:
        self._system = weakref.ref(system)

    def setUp(self, pc: PETSc.PC) -> None:  # noqa: N802 - PETSc's name
        """Update the preconditioner after a change of the stiffness; called by PETSc."""
        system = self._system()
        if system.problem is not None:
            system.lagged.renew(system.problem, None)

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Compute y = P x; called by PETSc."""
        self._system().lagged.apply(x, y)

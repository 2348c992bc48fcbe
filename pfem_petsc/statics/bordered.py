"""Equilibrium and its derivatives as functions of displacements and load factor, and motions that the stiffness does
not resist.
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
from ..solvers.linear import DIRECT, LinearChoice, configure, is_failed_factorisation, linear_reason
from ..solvers.matrix import HessianMatrix
from ..solvers.matrix_free import at_exit
from ..stepping.problem import StepProblem
from .scheme import Equilibrium
from .stability import LARGEST, Stability

if TYPE_CHECKING:
    from ..integrators.base import State
    from ..solvers.matrix_free import MatrixFreeHessian
    from ..stepping.model import Model
    from .scheme import PathEquilibrium


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
        self._transform = Transform(model.mesh)
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


_ZERO = 1e-11  # of the largest stiffness of a node; limit points that steps come close to have 1e-6 and more
_MOST = 8  # motions that are looked at
_TOLD = 3
_NAMED = 4  # nodes besides the one that moves most
_AHEAD = 2.0, 0.5, 0.1, 0.02  # of an increment: near a limit point the response to a whole one is too large
_MOVES = 0.3  # of the largest displacement of a motion, above which a node is named


def names_motions(model: Model) -> bool:
    """Whether motions are looked at: in models without walls and links, of at most 30,000 unknowns."""
    return not model.can_touch and 3 * model.mesh.n_nodes <= LARGEST


def free_motions(model: Model, state: State) -> str:
    """What to add to a message about a stiffness that may be singular; empty where no motion is free. Collective.

    Models for which :func:`names_motions` is False get no answer.
    """
    if not names_motions(model):
        return ""
    matrix = HessianMatrix(model.mesh, model.supports)
    problem = StepProblem(model, state, Equilibrium().balance(state, 0.0), state.external, Transform(model.mesh))
    matrix.update(problem, np.zeros_like(state.position))
    scale = model.comm.allreduce(float(model.nodal_stiffness.max(initial=0.0)), op=MPI.MAX)
    stability = Stability(model, matrix)
    try:
        values, motions = ([], []) if stability.refusal else stability.nearest(_MOST, 0.1 * _ZERO * scale)
        count = int((np.abs(values) < _ZERO * scale).sum())
        free = stability.combined(motions[:count]) if count else []
    except (NotConverged, np.linalg.LinAlgError):
        free = []
    finally:
        stability.destroy()
        matrix.destroy()
    return _text(model, state, free)


def next_equilibrium(model: Model, state: State, size: float) -> str:
    """What the tangent stiffness shows about the load factors up to ``size`` beyond an equilibrium. Collective.

    The response to the load becomes infinite at a limit point. If one is nearer than an increment, twice this increment
    times the response is a displacement to states beyond it, where eigenvalues are negative, or zero in plastic
    mechanisms.
    """
    unknowns = 3 * model.mesh.n_nodes
    if model.can_touch:
        return "it may be a limit point, which is not examined where contact is possible"
    if unknowns > LARGEST:
        return f"it may be a limit point, which is not examined for {unknowns:,} unknowns, more than {LARGEST:,}"
    matrix = HessianMatrix(model.mesh, model.supports)
    stability = Stability(model, matrix)
    choice = LinearChoice("preonly", DIRECT[not stability.dense], "of the response")
    system = BorderedSystem(model, matrix, choice, None, Equilibrium(), size)
    try:
        if stability.refusal is not None:
            return f"it may be a limit point, which is not examined: {stability.refusal}"
        system.begin(state)
        rest = np.zeros_like(state.position)
        system.linearise(rest)
        here = stability.look().negatives
        if here:
            return (
                f"the equilibrium is unstable there, with {here} negative eigenvalue{'s' * (here > 1)} of the stiffness"
            )
        move = size * system.response(rest, state.time)
        scale = model.comm.allreduce(float(model.nodal_stiffness.max(initial=0.0)), op=MPI.MAX)
        for part in _AHEAD:
            matrix.update(system.problem, part * move)
            there = stability.look()
            if there.negatives or there.nearest < _ZERO * scale:
                return "it is a limit point: the stiffness becomes singular there"
    except (NotConverged, np.linalg.LinAlgError, PETSc.Error):
        return "it may be a limit point: the stiffness cannot be factorised there"
    finally:
        for thing in (system, stability, matrix):
            thing.destroy()
    return "the stiffness shows no limit point: a smaller static.min_step or a larger solver.max_newton may help"


def _text(model: Model, state: State, free: list[np.ndarray]) -> str:
    """Rigid-body motions first, then mechanisms."""
    if not free:
        return ""
    rigid = _rigid(model, state, free)
    many = f"{len(free)}{' or more' * (len(free) == _MOST)}"
    text = f". The stiffness leaves {many} motion{'s' * (len(free) > 1)} free"
    if rigid == len(free):
        text += ", of the truss as a rigid body"
    elif rigid:
        text += f", {rigid} of them of the truss as a rigid body"
    told = "; ".join(_nodes(model, motion) for motion in free[:_TOLD])
    return f"{text}: {told}. Add supports or bars that prevent them"


def _rigid(model: Model, state: State, free: list[np.ndarray]) -> int:
    """How many rigid-body motions are combinations of free ones. Collective."""
    x = state.position
    centre = model.comm.allreduce(x.sum(axis=0)) / model.mesh.n_nodes
    arms = (x - centre) / model.length
    motions = [np.broadcast_to(axis, x.shape) for axis in np.eye(3)] + [np.cross(axis, arms) for axis in np.eye(3)]
    rigid = np.stack(motions)
    gram = model.comm.allreduce(np.einsum("inc,jnc->ij", rigid, rigid))
    values, vectors = np.linalg.eigh(gram)
    # a straight rod has five
    keep = values > 1e-12 * values[-1]
    basis = np.einsum("ij,inc->jnc", vectors[:, keep] / np.sqrt(values[keep]), rigid)
    shares = model.comm.allreduce(np.einsum("inc,jnc->ij", basis, np.stack(free)))
    return int((np.linalg.svd(shares, compute_uv=False) > 1.0 - 1e-6).sum())


def _nodes(model: Model, motion: np.ndarray) -> str:
    """The nodes that a motion moves most, and where to. Collective."""
    size = np.linalg.norm(motion, axis=1)
    largest = max(model.comm.allgather(float(size.max(initial=0.0))))
    at = np.flatnonzero(size > _MOVES * largest)
    ids = model.mesh.node_ids[at]
    # the node that moves most, and the lowest ones of those that are named; a motion may move all nodes
    most = at[np.lexsort((ids, -size[at].round(9)))][:1]
    mine = [(-float(size[k].round(9)), int(model.mesh.node_ids[k]), motion[k] / size[k]) for k in most]
    moved = sorted((entry[:2], entry[2]) for part in model.comm.allgather(mine) for entry in part)
    (_, first), direction = moved[0]
    lowest = sorted(node for part in model.comm.allgather(np.sort(ids)[: _NAMED + 1].tolist()) for node in part)
    others = [node for node in lowest if node != first][:_NAMED]
    more = model.comm.allreduce(len(at)) - 1 - len(others)
    way = "(" + ", ".join(f"{part:.2g}" for part in direction.round(3) + 0.0) + ")"
    text = f"node {first} along {way}"
    if others:
        text += f", with node{'s' * (len(others) > 1)} " + ", ".join(map(str, others))
    return text + (f" and {more} more" if more else "")

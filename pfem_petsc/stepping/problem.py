"""The balance of one step as a function of the position increment: residual, Hessian, and the tolerance of its
residual.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..contact.transform import Transform
from ..integrators.base import Balance, State
from ..solvers.matrix import HessianMatrix

if TYPE_CHECKING:
    from ..solvers.newton import NewtonReport
    from .model import Model


class StepProblem:
    """Residual g(w) of one step, where w is the increment u from the predictor in transformed coordinates, u = T w.

    Friction is part of g (see :mod:`pfem_petsc.contact.frames`) and makes its derivative unsymmetric. Prescribed
    components have a zero residual and a unit row; the guess contains their values.

    Attributes
    ----------
    target : (k,) prescribed components of u where some are along no axis: these are mixed into unknowns that linear
        solvers change, and components of w along them are ignored
    """

    def __init__(
        self,
        model: Model,
        state: State,
        balance: Balance,
        external: np.ndarray,
        transform: Transform,
    ) -> None:
        self.transform = transform
        self.model = model
        self.state = state
        self.balance = balance
        self.external = external
        mesh, inertia = model.mesh, model.inertia
        self.x = np.zeros((mesh.n_local, 3))
        self.f = np.zeros((mesh.n_local, 3))
        self.u = np.zeros((mesh.n_owned, 3))
        self._work = np.zeros((mesh.n_owned, 3))
        self.nodal = balance.alpha * inertia.mass + balance.eta * inertia.damping
        self.scale = float((self.nodal if balance.alpha else model.nodal_stiffness).max(initial=0.0))
        # the part independent of u: M a_hat + C v_hat + (1 - w) f_n - f_ext
        known = -external
        if balance.a_hat is not None:
            known = known + inertia.mass_times(balance.a_hat, np.zeros_like(known))
        if inertia.damped and balance.v_hat is not None:
            known = known + inertia.damping_times(balance.v_hat, np.zeros_like(known))
        if balance.weight < 1.0:
            known = known + (1.0 - balance.weight) * state.f[: mesh.n_owned]
        self.known = known
        supports = model.supports
        self.target = None if supports.inclined is None else supports.lacking(balance.predictor, balance.time)

    def increment(self, w: np.ndarray) -> np.ndarray:
        """Return u (owned, 3) for w. Collective."""
        self.u[:] = w
        self.transform.forward(self.u)
        if self.target is not None:
            self.model.supports.put(self.u, self.target)
        return self.u

    def coordinates(self, u: np.ndarray) -> np.ndarray:
        """Return w (owned, 3) for u. Collective."""
        w = u.copy()
        self.transform.inverse(w)
        return w

    def imbalance(self, u: np.ndarray, g: np.ndarray) -> None:
        """Write g = M a + C v + f_int - f_ext at u, in x, without supports and walls [N]. Collective."""
        mesh, inertia, balance = self.model.mesh, self.model.inertia, self.balance
        owned = mesh.n_owned
        if inertia.consistent:
            g[:] = inertia.mass_times(balance.alpha * u, self._work)
            if inertia.damped and balance.eta:
                g += inertia.damping_times(balance.eta * u, self._work)
        else:
            np.multiply(self.nodal[:, None], u, out=g)
            if inertia.redistribution is not None:
                moved = inertia.redistribution
                g[moved.touched] += balance.alpha * np.einsum("kij,kj->ki", moved.tensors, u[moved.touched])
        g += self.known
        if balance.weight:
            self.place(u)
            if balance.discrete_gradient:
                self.model.bars.step_forces(self.state.x, self.x, self.f)
            else:
                self.model.bars.forces(self.x, self.f, commit=False)
            g += balance.weight * self.f[:owned]

    def residual(self, w: np.ndarray, g: np.ndarray) -> None:
        """See :class:`~pfem_petsc.solvers.newton.Problem`."""
        self.imbalance(self.increment(w), g)
        self.transform.residual(self.balance.predictor, self.u, g)
        if self.model.supports.any:
            self.model.supports.clear(g)

    def hessian(self, w: np.ndarray, matrix: HessianMatrix, values: np.ndarray) -> None:
        """Add dg/dw, without the coordinates of links, to the values of an assembled matrix. Collective."""
        self.place(self.increment(w))
        self.hessian_here(matrix, values)

    def hessian_here(self, matrix: HessianMatrix, values: np.ndarray, stored: np.ndarray | None = None) -> None:
        """As :meth:`hessian`, at the positions :attr:`x`, ghosts included. Collective.

        With ``stored`` (5, b) the stiffness of the bars is computed from these data, see ``Bars.linearise``.
        """
        inertia, balance = self.model.inertia, self.balance
        if not inertia.consistent:
            matrix.add_lumped(self.nodal, values)
            if inertia.redistribution is not None:
                moved = inertia.redistribution
                matrix.pattern.add_blocks(moved.touched, balance.alpha * moved.tensors, values)
        elif inertia.points.any:
            matrix.add_lumped(inertia.points.nodal(balance.alpha, balance.eta), values)
        coefficients = inertia.coefficients(balance.alpha, balance.eta)
        if balance.weight or inertia.consistent:
            bars, arguments = self.model.bars, (balance.weight, coefficients, matrix.pattern, values)
            if balance.discrete_gradient:
                bars.tangents(self.x, *arguments, start=self.state.x)
            elif stored is not None:
                bars.tangents(self.x, 0.0, *arguments[1:])
                matrix.add_bars(stored, values)
                if bars.springs is not None:
                    bars.springs.add_tangents(balance.weight, matrix.pattern, values)
            else:
                bars.tangents(self.x, *arguments)
        matrix.turn(self.transform, values)
        matrix.constrain(self.scale, values)

    def place(self, u: np.ndarray) -> None:
        """Set the positions of all local nodes to the predictor plus u. Collective."""
        np.add(self.balance.predictor, u, out=self.x[: self.model.mesh.n_owned])
        self.model.mesh.update_ghosts(self.x)


_MASS_RTOL = 1e-3  # factor on solver.rtol for systems with the mass matrix only
_DOUBTFUL = 1e-3  # share of the forces in a residual due to rounding, from which on users are told


def residual_tolerance(model: Model, balance: Balance, scale: float) -> float:
    """Return the tolerance of the residual's 2-norm [N]: ``solver.rtol`` times the scale of forces [N], but not below
    ``solver.atol``."""
    solver = model.case.solver
    # an explicit scheme's balance is a well-conditioned linear system, and its residual would act as an impulse
    rtol = solver.rtol if balance.weight else _MASS_RTOL * solver.rtol
    return max(rtol * scale, solver.atol or 0.0)


def force_scale(model: Model, state: State, step: float) -> float:
    """Return the largest 2-norm [N] of momentum per step of a size [s], loads and internal forces. Collective."""
    owned = model.mesh.n_owned
    sums = np.array(
        [
            ((model.inertia.mass[:, None] * state.v) ** 2).sum() / step**2 if state.v.any() else 0.0,
            (state.external**2).sum(),
            (state.f[:owned] ** 2).sum(),
        ]
    )
    model.comm.Allreduce(MPI.IN_PLACE, sums)
    return float(np.sqrt(sums.max()))


class Resolution:
    """Whether the forces of a run are larger than what rounding of positions leaves of them out of balance.

    Attributes
    ----------
    numbers : largest 2-norms [N] so far, of forces and of residuals that rounding has left
    """

    def __init__(self) -> None:
        self.numbers = [0.0, 0.0]

    def note(self, model: Model, x: np.ndarray, scale: float, residual: float, tolerance: float) -> None:
        """Take account of a balance at local positions (nodes, 3), with a scale of its forces, the 2-norm of its
        residual, and the tolerance of that [N]. Collective."""
        forces, left = self.numbers
        lacking = residual if residual > tolerance else 0.0
        if lacking > _DOUBTFUL * max(scale, forces):  # the forces of bars may balance each other
            bars = model.bars.state_stiffness(x)[4] * model.bars.lengths(x)
            scale = max(scale, float(np.sqrt(model.comm.allreduce(float((bars[model.mesh.counted] ** 2).sum())))))
        self.numbers = [max(forces, scale), max(left, lacking)]

    def doubts(self, model: Model) -> list[str]:
        """Return a text if the residuals are a noticeable share of the forces."""
        forces, residual = self.numbers
        if not residual > _DOUBTFUL * forces:
            return []
        share = f"{100.0 * residual / forces:.2g} % of" if forces else "all"
        return [
            f"forces of {forces:.3g} N are balanced to {residual:.2g} N only, {share} the forces: coordinates of "
            f"{model.reach:.3g} m are rounded to {np.finfo(float).eps * model.reach:.1g} m, which strains the stiffest "
            "bars as much as the forces do, and smaller displacements are not resolved. Scale the forces up, make very "
            "stiff bars less stiff, or move the truss to the origin"
        ]


def failure_message(
    problem: StepProblem,
    w: np.ndarray,
    bounds: tuple[np.ndarray, np.ndarray] | None,
    report: NewtonReport,
    tolerance: float,
    remedy: str,
) -> str:
    """Return the message about a solve that did not converge: iterations, reason, worst node, remedy. Collective.

    Parameters
    ----------
    problem : StepProblem
    w : (owned, 3) last iterate, in the coordinates of the problem
    bounds : (lower, upper) of w, None if there are none
    report : NewtonReport
    tolerance : of the residual's 2-norm [N]
    remedy : what the user can do
    """
    model = problem.model
    g = np.empty_like(w)
    problem.residual(w, g)
    if bounds is not None:  # forces on active bounds are not part of the error
        g[((w <= bounds[0]) & (g > 0.0)) | ((w >= bounds[1]) & (g < 0.0))] = 0.0
    size = np.linalg.norm(np.nan_to_num(g, nan=np.inf), axis=1)
    worst = (0.0, -1)
    if len(size):
        at = int(np.argmax(size))
        worst = (float(size[at]), int(model.mesh.node_ids[at]))
    residual, node = max(model.comm.allgather(worst))
    return (
        f"no convergence after {report.newton} Newton iterations: {report.why}; residual {report.norm:.3g} N, "
        f"required {tolerance:.3g} N; worst at node {node} ({residual:.3g} N). "
        f"{remedy[0].upper()}{remedy[1:]}"
    )

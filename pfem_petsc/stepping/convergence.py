"""Tolerance of the residual of an implicit step, and the message about a step that does not converge."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..integrators.base import Balance, State
from .problem import StepProblem

if TYPE_CHECKING:
    from ..solvers.newton import NewtonReport
    from .model import Model

__all__ = ["Resolution", "failure_message", "force_scale", "residual_tolerance"]

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

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

__all__ = ["failure_message", "residual_tolerance"]

_MASS_RTOL = 1e-3  # factor on solver.rtol for systems with the mass matrix only


def residual_tolerance(model: Model, state: State, balance: Balance, step: float) -> float:
    """Return the tolerance of the residual's 2-norm [N] in a step of the given size [s]. Collective.

    It is ``solver.rtol`` times the largest of momentum per step, loads and internal forces, but not below
    ``solver.atol``.
    """
    solver, owned = model.case.solver, model.mesh.n_owned
    sums = np.array(
        [
            ((model.inertia.mass[:, None] * state.v) ** 2).sum() / step**2 if state.v.any() else 0.0,
            (state.external**2).sum(),
            (state.f[:owned] ** 2).sum(),
        ]
    )
    model.comm.Allreduce(MPI.IN_PLACE, sums)
    # an explicit scheme's balance is a well-conditioned linear system, and its residual would act as an impulse
    rtol = solver.rtol if balance.weight else _MASS_RTOL * solver.rtol
    return max(rtol * float(np.sqrt(sums.max())), solver.atol or 0.0)


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

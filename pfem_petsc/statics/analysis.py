"""The static analysis of a case with a table ``[static]``: its plan, checks and steps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..analysis import Analysis, PlanAtRest, refuse_motion
from ..errors import InputError
from ..mechanics.materials.base import law_name, law_of
from ..output.units import LOAD_FACTOR, POINT
from ..registry import lookup
from ..solvers.background_grid import fills_block
from ..solvers.linear import Demand, LinearChoice, choose_linear

if TYPE_CHECKING:
    from ..stepping.model import Model

__all__ = ["METHODS", "StaticAnalysis"]

METHODS = "pfem_petsc.statics.methods"
NEVER = 2**62

_DIRECT_UP_TO = 30_000  # unknowns; beyond, multigrid takes less time and memory than a factorisation
# 101,376 octet bars that yield: up to 300 conjugate gradient iterations a Newton step, and none that converges at 2 %
_DIRECT_YIELDING_UP_TO = 200_000


class StaticAnalysis(Analysis):
    """Advances a state from equilibrium to equilibrium. Construction is collective.

    Parameters
    ----------
    model : Model
    recorded : ``PlanAtRest.record`` of the run that is continued

    Raises
    ------
    InputError
        On all ranks, if the case has features that a static analysis does not support.
    """

    def __init__(self, model: Model, recorded: Mapping[str, Any] | None = None) -> None:
        case = model.case
        _check(model)
        self.model = model
        parameters = case.static.parameters
        choice = _linear(model)
        self.step_size = parameters.step
        self.stepper = lookup(METHODS, case.static.method, "static.method").make_stepper(model, parameters, choice)
        points = getattr(parameters, "max_points", None)
        words = ", ".join(f"{key} = {value}" for key, value in parameters.model_dump(exclude_none=True).items())
        self.plan = PlanAtRest(
            self.stepper.scheme,
            LOAD_FACTOR if points is None else POINT,
            {"static analysis": f"{case.static.method} ({words})"},
            parameters.step,
            self.stepper.end,
            choice,
            points,
        )

    @property
    def last_step(self) -> int:
        """Number of the last step once it is reached, before that a number larger than any step."""
        return self.stepper.state.step if self.stepper.done else NEVER

    def obstacle(self) -> str:
        """See :class:`~pfem_petsc.analysis.Analysis`: motions without stiffness."""
        return self.stepper.obstacle()


def _linear(model: Model) -> LinearChoice:
    """Choose the linear solver: a factorisation, which needs no definiteness, if affordable, else multigrid.

    Collective.
    """
    solver, unknowns = model.case.solver, 3 * model.mesh.n_nodes
    request = solver.linear
    if request == "auto":
        smooth = all(law_of(material).smooth for material in model.case.material.values())
        most = _DIRECT_UP_TO if smooth else _DIRECT_YIELDING_UP_TO
        multigrid = "multigrid" if solver.operator != "assembled" and fills_block(model.mesh) else "gamg"
        request = "mumps" if unknowns <= most and solver.operator != "matrix_free" else multigrid
    choice = choose_linear(request, solver.operator, Demand(unknowns, np.inf))
    if solver.linear == "auto":
        choice = replace(choice, why=choice.why.removesuffix(" (asked for)"))
    return choice


def _check(model: Model) -> None:
    """Refuse features that need time."""
    case = model.case
    source = case.source
    refuse_motion(case, "a static analysis")
    if model.bars.springs is not None and case.static.method != "newton":
        raise InputError(
            f'{source}: spring: static.method = "{case.static.method}" does not support springs to the ground; '
            'use "newton", or bars to supported nodes as springs'
        )
    if model.external.wind is not None and model.external.wind.fastest():
        raise InputError(
            f"{source}: wind: drag turns with the bars, which a static analysis does not follow; use [time] with "
            "damping, or the forces as [[load]]; a stage may have [stage.wind]"
        )
    for wall in case.wall:
        if wall.mass is not None:
            raise InputError(
                f"{source}: wall {wall.name!r}: mass: a wall with mass moves over time; remove mass, or give the wall "
                "a motion"
            )
    for name, material in case.material.items():
        law = law_of(material)
        if law.rate and not law.static_limit:
            raise InputError(
                f'{source}: material.{name}.law = "{law_name(dict(material))}" depends on the rate of strain, and a '
                "static analysis has no time; use another law"
            )
    if not model.supports.any and not model.can_touch and model.bars.springs is None:
        raise InputError(
            f"{source}: static: nothing holds the truss: its rigid-body motions are free; give a [[support]] or "
            "[[spring]]"
        )

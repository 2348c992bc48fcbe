"""The static analysis of a case with a table ``[static]``: its checks, plan and stepper."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from ..mechanics.materials.base import law_name, law_of
from ..output.units import LOAD_FACTOR, POINT
from ..registry import lookup
from ..solvers.background_grid import fills_block
from ..solvers.linear import Demand, LinearChoice, choose_linear
from ..stepping.plan import Plan, refuse_motion

if TYPE_CHECKING:
    from ..stepping.model import Model
    from .stepper import StaticStepper

__all__ = ["METHODS", "make_stepper"]

METHODS = "pfem_petsc.statics.methods"

_DIRECT_UP_TO = 30_000  # unknowns; beyond, multigrid takes less time and memory than a factorisation
# 101,376 octet bars that yield: up to 300 conjugate gradient iterations a Newton step, and none that converges at 2 %
_DIRECT_YIELDING_UP_TO = 200_000


def make_stepper(model: Model) -> StaticStepper:
    """Create the stepper of a case, which goes from equilibrium to equilibrium, with its plan. Collective.

    Raises
    ------
    InputError
        On all ranks, if the case has features that a static analysis does not support.
    """
    _check(model)
    case = model.case
    parameters, choice = case.static.parameters, _linear(model)
    stepper = lookup(METHODS, case.static.method, "static.method").make_stepper(model, parameters, choice)
    points = getattr(parameters, "max_points", None)
    words = ", ".join(f"{key} = {value}" for key, value in parameters.model_dump(exclude_none=True).items())
    stepper.plan = Plan(
        stepper.scheme,
        LOAD_FACTOR if points is None else POINT,
        {"static analysis": f"{case.static.method} ({words})"},
        parameters.step,
        stepper.end,
        choice,
        points,
    )
    return stepper


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

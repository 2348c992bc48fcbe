"""Time stepping: the analysis of a case with a table ``[time]``, and the stepper of its plan."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..analysis import Analysis
from ..contact.impact_gains import warn_of_gain
from ..contact.treatments.base import Restitution, Treatment
from ..contact.wall_motion import FreeWalls
from ..errors import InputError
from ..registry import choices, lookup
from .explicit import ExplicitStepper, RedistributedStepper
from .implicit import ImplicitStepper
from .plan import Plan, dashpot_rate
from .stepper import Stepper

if TYPE_CHECKING:
    from .model import Model


_DAMPED = 0.2  # largest damping rate times step for an accurate ledger; at the rate 1/s a velocity decays to 1/e in 1 s

TREATMENTS = "pfem_petsc.contact.treatments"


def make_stepper(model: Model, plan: Plan) -> Stepper:
    """Create the stepper of a plan, with the case's treatment of impact. Collective.

    Raises
    ------
    InputError
        On all ranks, if the scheme is not compatible with the treatment.
    """
    treatment = _treatment(model, plan)
    _check_walls(model, plan, treatment)
    _warn_of_damping(model, plan)
    _warn_of_drag(model, plan)
    if treatment is not None:
        treatment.prepare(model)
    stepper = _stepper(model, plan)
    if treatment is not None:
        stepper.treatment = treatment(stepper)
    elif model.contact.restitution.any() and not model.contact.rebounds:
        stepper.treatment = Restitution(stepper)
    if model.can_touch:
        _warn_of_gain(model, plan)
    return stepper


def _treatment(model: Model, plan: Plan) -> type[Treatment] | None:
    """Return the treatment of the case; None for the formulas of the scheme, and if nothing can touch."""
    name = model.case.contact.treatment
    if name == "scheme" or not model.can_touch:
        return None
    treatment = lookup(TREATMENTS, name, "contact.treatment").Treatment
    key = f'{model.case.source}: contact.treatment = "{name}"'
    if model.inertia.consistent:
        raise InputError(f'{key}: needs time.mass = "lumped"')
    reason = treatment.refuses(plan.scheme)
    if reason is not None:
        raise InputError(f"{key}: {reason}")
    return treatment


def _warn_of_gain(model: Model, plan: Plan) -> None:
    """Warn if contact gains energy with this scheme, treatment, mass and step."""
    fastest = plan.frequency.upper / (np.sqrt(3.0) if model.inertia.consistent else 1.0)
    across = 0.5 * fastest * model.length / model.wave_speed
    warning = warn_of_gain(model.case, 0.5 * fastest * plan.step, across)
    if warning:
        model.warnings.append(warning)


def _warn_of_damping(model: Model, plan: Plan) -> None:
    """Warn if damping stops nodes within a few steps, when no rule over steps gives its dissipation accurately."""
    rate = max(material.damping / material.density for material in model.case.material.values())
    rate = max(model.inertia.largest_factor * rate, dashpot_rate(model))
    if rate * plan.step > _DAMPED:
        model.warnings.append(
            f"time.step = {plan.step:.4g} s: damping stops nodes within a few steps (material.damping / density, or "
            f"dashpot.coefficient / mass, * step = {rate * plan.step:.2g}), so the recorded damping dissipation has "
            f"an error of this order; use "
            f"a time.step of at most {_DAMPED / rate:.2g} s, or less damping"
        )


def _warn_of_drag(model: Model, plan: Plan) -> None:
    """Warn if drag stops bars within a few steps: by predicted velocities it is stable up to a rate of 2/3 a step."""
    wind = model.external.wind
    if wind is None:
        return
    rate = wind.rate(wind.fastest())
    if rate * plan.step > _DAMPED:
        model.warnings.append(
            f"time.step = {plan.step:.4g} s: the drag of [wind] stops bars within a few steps (rho C_d d U / (density "
            f"area) * step = {rate * plan.step:.2g}), which its explicit evaluation does not follow; use a time.step "
            f"of at most {_DAMPED / rate:.2g} s"
        )


def _check_walls(model: Model, plan: Plan, treatment: type[Treatment] | None) -> None:
    """Refuse features of walls that the scheme does not support."""
    walls = model.case.wall
    if any(wall.mass is not None for wall in walls):
        if treatment is not None:
            raise InputError(
                f'{model.case.source}: wall.mass needs contact.treatment = "scheme": other '
                "treatments change velocities by jumps"
            )
        if model.external.gravity_varies and any(wall.gravity for wall in walls):
            raise InputError(
                f"{model.case.source}: gravity.acceleration: walls with gravity = true need a constant gravity, "
                "not rows over time"
            )
        model.contact.motion.bodies = FreeWalls(walls, plan.scheme, model.comm, tuple(model.external.gravity))
    model.links.check(model.case.contact.treatment, model.size)
    for k, name in enumerate(model.contact.names):
        key = f"{model.case.source}: wall {name!r}"
        if model.contact.restitution[k]:
            _check_restitution(model, plan, treatment, k, key)
        if model.contact.ties.tying[k]:
            _check_serves(treatment, "tied", key)
        if model.contact.static_friction[k]:
            _check_serves(treatment, "friction", key)


def _check_serves(treatment: type[Treatment] | None, what: str, key: str) -> None:
    """Refuse a key of walls that the treatment does not support."""
    if treatment is None or what in treatment.serves:
        return
    known = {name: lookup(TREATMENTS, name, "").Treatment for name in choices(TREATMENTS)}
    served = ['"scheme"', *(f'"{name}"' for name, other in known.items() if what in other.serves)]
    raise InputError(f"{key}: {what} needs contact.treatment = {' or '.join(served)}")


def _check_restitution(model: Model, plan: Plan, treatment: type[Treatment] | None, k: int, key: str) -> None:
    if model.inertia.consistent:
        raise InputError(f'{key}: restitution needs time.mass = "lumped": one node\'s velocity jumps')
    if plan.scheme.solves_next_position:
        model.contact.rebounds = True
        if treatment is not None:
            raise InputError(f'{key}: with {model.case.time.integrator} restitution needs contact.treatment = "scheme"')
        return
    _check_serves(treatment, "restitution", key)
    # the impulse of a velocity jump causes no friction and does not move walls with mass
    if model.contact.static_friction[k]:
        raise InputError(f"{key}: restitution together with friction needs central_differences")
    if model.case.wall[k].mass is not None:
        raise InputError(f"{key}: restitution of a wall with mass needs central_differences")


def _stepper(model: Model, plan: Plan) -> Stepper:
    if plan.linear is not None:
        return ImplicitStepper(model, plan.scheme, plan.step, plan.linear)
    explicit = ExplicitStepper if model.inertia.redistribution is None else RedistributedStepper
    return explicit(model, plan.scheme, plan.step)


class TimeStepping(Analysis):
    """Advances the state of a model by the integrator of a plan. Construction is collective.

    Parameters
    ----------
    model : Model
    plan : Plan

    Attributes
    ----------
    stepper : Stepper
    """

    def __init__(self, model: Model, plan: Plan) -> None:
        self.model, self.plan = model, plan
        self.last_step, self.step_size = plan.steps, plan.step
        self.stepper = make_stepper(model, plan)

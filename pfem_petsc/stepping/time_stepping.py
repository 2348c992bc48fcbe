"""Time stepping: the analysis of a case with a table ``[time]``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..analysis import Analysis
from .plan import Plan
from .prepare import make_stepper

if TYPE_CHECKING:
    from .model import Model

__all__ = ["TimeStepping"]


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

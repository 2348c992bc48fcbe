"""Selection of the analysis of a case."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from ..analysis import Analysis
from ..modes.choice import describe_modes
from ..modes.initial_state import InitialState
from ..statics.analysis import StaticAnalysis
from ..stepping.plan import make_plan
from ..stepping.time_stepping import TimeStepping

if TYPE_CHECKING:
    from ..stepping.model import Model

__all__ = ["make_analysis"]


def make_analysis(model: Model, recorded: Mapping[str, Any] | None) -> Analysis:
    """Create the analysis of a model's case. Collective.

    ``recorded``: record of the plan of the continued run, None for a new run
    """
    describe_modes(model)  # refuses at the start modes that cannot be computed at the end
    if model.case.static is not None:
        return StaticAnalysis(model, recorded)
    if model.case.time is None:
        return InitialState(model)
    return TimeStepping(model, make_plan(model, recorded))

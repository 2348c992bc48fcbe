"""The stages of a case and their analyses: planned before the first step, begun one after the other."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from ..analysis import Analysis
from ..columns import declared
from ..contact.contact import check_start
from ..errors import InputError, SimulationFailure
from ..fields import Fields
from ..modes.find import describe_modes
from ..modes.initial_state import InitialState
from ..output.units import TIME as AXIS
from ..preflight.checks import warnings_before
from ..statics.analysis import StaticAnalysis
from ..stepping.model import Model
from ..stepping.plan import make_plan
from ..stepping.stage import end_of_stage, hand_over
from ..stepping.time_stepping import TimeStepping
from ..tolerances import TIME
from .recorder import Recorder

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..stepping.stepper import Stepper


def _make_analysis(model: Model, recorded: Mapping[str, Any] | None) -> Analysis:
    """Create the analysis of a model's case. Collective.

    ``recorded``: record of the plan of the continued run, None for a new run
    """
    describe_modes(model)  # refuses at the start modes that cannot be computed at the end
    if model.case.static is not None:
        return StaticAnalysis(model, recorded)
    if model.case.time is None:
        return InitialState(model)
    return TimeStepping(model, make_plan(model, recorded))


class StagedPlan:
    """The plans of all stages on one axis; see :class:`~pfem_petsc.stepping.plan.Plan`.

    Attributes
    ----------
    plans, names : of the stages
    scheme, linear, step : of the first stage
    steps, end : of all stages together; None where that of one is not known before
    axis : time [s]; a static stage takes as much of it as its load factor or points count
    """

    def __init__(self, plans: tuple[Any, ...], names: tuple[str, ...]) -> None:
        self.plans, self.names = plans, names
        self.scheme, self.linear, self.step = plans[0].scheme, plans[0].linear, plans[0].step
        counts, ends = [plan.steps for plan in plans], [plan.end for plan in plans]
        self.steps: int | None = None if None in counts else sum(counts)
        self.end: float | None = None if None in ends else sum(ends)
        self.axis = AXIS._replace(key=f"stage[{len(plans) - 1}].{plans[-1].axis.key}")

    def beyond(self, steps: np.ndarray, times: np.ndarray) -> np.ndarray:
        """Return which of the recorded steps and times are beyond the end."""
        return times > (np.inf if self.end is None else self.end * (1.0 + TIME))

    def entries(self, case: Case) -> dict[str, str]:
        """Label and text of what a user checks before a run."""
        texts = [plan.entries(stage) for plan, stage in zip(self.plans, case.stages, strict=True)]
        lines = ["; ".join(f"{label}: {text}" for label, text in each.items()) for each in texts]
        return {f"stage {name}": line for name, line in zip(self.names, lines, strict=True)}

    def record(self) -> dict[str, Any]:
        """Choices that a restart must keep."""
        return {"stages": [plan.record() for plan in self.plans]}


class Stages:
    """The stages of a case, one of which is being computed. Construction is collective.

    A case without stages is its own only stage, and is built as ever. Otherwise the model of every stage is built once
    before the first step, so that what is wrong with a later one is found then.

    Parameters
    ----------
    case : Case
    comm : MPI.Comm
    recorded : record of the plan of the run that is continued, None for a new run
    number : of the stage to begin with

    Attributes
    ----------
    analysis : of the present stage
    plan : of the whole run
    functions : that give forces in the present stage and in those after it, see :meth:`call`
    columns : of the history, name to type with the shape of a value, None for a case without stages
    fields : names of the fields to write, None for a case without stages
    events : columns of events and their types

    Raises
    ------
    InputError
        On all ranks.
    """

    def __init__(self, case: Case, comm: MPI.Comm, recorded: Mapping[str, Any] | None, number: int = 0) -> None:
        self.case, self.comm = case, comm
        self._cases = case.stages
        self.functions: list[Callable[..., Any]] = []
        self.analysis: Analysis
        self.columns: dict[str, np.dtype] | None = None
        self.fields: list[str] | None = None
        self.events: dict[str, Any] = {}
        first = Model(self._cases[0], comm, later=self._cases[1:])
        if not case.stage:
            self.analysis = _make_analysis(first, recorded)
            self.plan = self.analysis.plan
            self.events |= self.analysis.stepper.event_columns
            return
        records = [None] * len(case.stage) if recorded is None else recorded["stages"]
        self.columns = {name: declared(name).dtype for name in ("time", "step", "stage")}
        plans, warnings, told = [], [], []
        points, cells = {}, {}
        for k, (stage, record) in enumerate(zip(self._cases, records, strict=True)):
            model = first if k == 0 else Model(stage, comm, first.mesh)
            analysis = _make_analysis(model, record)
            plans.append(analysis.plan)
            self.columns |= Recorder(analysis.stepper).columns
            self.events |= analysis.stepper.event_columns
            fields = Fields(model)
            points |= dict.fromkeys(fields.points)
            cells |= dict.fromkeys(fields.cells)
            warnings += [f"stage {stage.name!r}: {text}" for text in model.warnings]
            if k >= number:
                found = warnings_before(stage, model, analysis.plan, first=False)
                new = [text for text in found if text not in told]
                warnings += [f"stage {stage.name!r}: {text}" for text in new if k > number]
                told += new
            if k == number:
                self.analysis = analysis
            else:
                analysis.close()
        self.plan = StagedPlan(tuple(plans), tuple(stage.name for stage in self._cases))
        self.fields = [*points, *cells]
        self.model.warnings = warnings

    @property
    def model(self) -> Model:
        """Of the present stage."""
        return self.analysis.model

    @property
    def number(self) -> int:
        """Of the present stage, from 0."""
        return self.model.case.number

    @property
    def at_last(self) -> bool:
        """Whether no stage comes after the present one."""
        return self.number == len(self._cases) - 1

    def call(self, function: Callable[..., Any]) -> None:
        """Add the forces that a function returns in stages that compute motion.

        Raises
        ------
        InputError
            If there is no such stage.
        """
        if not any(stage.time is not None for stage in self._cases):
            raise InputError(
                f"{self.case.source}: external_force: a function acts in dynamic analyses only, and this case has "
                "no [time]; use [[load]]"
            )
        if any(stage.contact.treatment == "mass_redistribution" for stage in self._cases if stage.time is not None):
            raise InputError(
                f'{self.case.source}: external_force: contact.treatment = "mass_redistribution" leaves nodes without '
                "mass, which cannot follow forces that depend on their velocity; use another contact.treatment"
            )
        self.functions.append(function)
        if self.model.case.time is not None:
            self.model.external.call(function)

    def advance(self) -> tuple[float, np.ndarray]:
        """Begin the next stage where the present one has ended. Collective.

        Returns
        -------
        Work [J] and momentum (3,) [N s] of the velocities that the stage adds, on all ranks.

        Raises
        ------
        SimulationFailure
            On all ranks, where the stage cannot begin there.
        """
        old, number = self.analysis, self.number + 1
        stage = self._cases[number]
        where = f"stage {stage.name!r}, begun after step {old.stepper.number}, t = {old.stepper.place:.6g} s"
        old.stepper.settle()
        try:
            model = Model(stage, self.comm, old.model.mesh)
            model.begin_stage(end_of_stage(old.stepper))
            for function in self.functions if stage.time is not None else ():
                model.external.call(function)
            check_start(model.contact, old.state.position, model.size)
            analysis = _make_analysis(model, self.plan.plans[number].record())
        except InputError as error:
            raise SimulationFailure(f"{where}: {error}") from error
        hand_over(old.stepper, analysis.stepper)
        old.close()
        self.analysis = analysis
        kick = _kick(analysis.stepper)
        analysis.start()
        return kick


def _kick(stepper: Stepper) -> tuple[float, np.ndarray]:
    """Work [J] and momentum (3,) [N s] of the velocities that a stage adds to those it is handed. Collective."""
    model = stepper.model
    added = model.initial_velocity()
    momentum = model.inertia.mass_times(added, np.empty_like(added))
    mean = stepper.state.v + 0.5 * added
    sums = model.comm.allreduce(np.append(momentum.sum(axis=0), (momentum * mean).sum()))
    return float(sums[3]), sums[:3]

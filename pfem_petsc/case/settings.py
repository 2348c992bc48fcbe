"""The tables of a case file for solution and output, each with its keys (SI units)."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, InstanceOf, field_validator

from ..registry import choices, nearest
from .base import (
    Name,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    StrictModel,
    WithParameters,
    is_finite_number,
    listed,
)
from .rows import Table2

__all__ = [
    "ContactSettings",
    "Output",
    "OutputKeys",
    "Probe",
    "Modes",
    "Solver",
    "Static",
    "StaticKeys",
    "Time",
    "TimeKeys",
]

TREATMENTS = "pfem_petsc.contact.treatments"


class TimeKeys(StrictModel):
    """The keys of [time] other than those of an integrator."""

    integrator: str
    """name of a time integration scheme"""
    step: Any
    """time step [s], or "auto" with an explicit scheme"""
    end: PositiveFloat
    """end time [s]"""
    mass: Literal["lumped", "consistent"] = "lumped"
    """mass matrix"""
    safety: Annotated[float, Field(gt=0.0, le=1.0)] = 0.9
    """factor on the critical step if step = "auto\""""
    damping_table: Table2 | None = None
    """rows [t, factor] [s, -] of the damping of all materials over time, constant outside; default: factor 1"""

    @field_validator("damping_table")
    @classmethod
    def _factors(cls, table: tuple[Any, ...] | None) -> tuple[Any, ...] | None:
        if any(row[1] < 0.0 for row in table or ()):
            raise ValueError("expected factors >= 0")
        return table

    @field_validator("step")
    @classmethod
    def _step(cls, step: Any) -> float | str:
        if step == "auto":
            return "auto"
        if isinstance(step, bool) or not isinstance(step, int | float):
            raise ValueError('expected a number of seconds in SI units without quotes and unit, or "auto"')
        if not (step > 0 and is_finite_number(step)):
            raise ValueError('expected a finite number of seconds > 0, or "auto"')
        return _computable(float(step))

    @field_validator("end")
    @classmethod
    def _end(cls, end: float) -> float:
        return _computable(end)


def _computable(seconds: float) -> float:
    """Refuse times whose powers in the formulas of the schemes overflow double precision."""
    if not 1e-50 <= seconds <= 1e50:
        raise ValueError("overflows double precision in the formulas of the schemes; give seconds from 1e-50 to 1e50")
    return seconds


class Time(TimeKeys, WithParameters):
    """The time integration: scheme, its parameters, step and end."""

    scheme: InstanceOf[StrictModel]


class StaticKeys(StrictModel):
    """The keys of [static] that are not a method's own."""

    method: str = "newton"
    """name of a method that finds equilibria"""


class Static(StaticKeys, WithParameters):
    """The static analysis: method and its parameters."""

    parameters: InstanceOf[StrictModel]


class Modes(StrictModel):
    """Modes of the state at the end of the analysis, or of the initial state where the case has none."""

    count: PositiveInt = 10
    """number of modes"""
    kind: Literal["vibration", "buckling"] = "vibration"
    """natural frequencies, or linear buckling factors of the load"""
    mass: Literal["lumped", "consistent"] | None = None
    """mass matrix; default: that of [time], lumped without it"""
    solver: Literal["auto", "dense", "scipy", "slepc"] = "auto"
    """library that solves the eigenvalue problem"""


class Probe(StrictModel):
    """A node set whose motion and reaction are recorded in the history."""

    name: Name
    """name of the probe in the results"""
    node_set: str
    """name of a node set"""


class OutputKeys(StrictModel):
    """The keys of [output] without probes."""

    fields_every: NonNegativeInt = 10
    """steps between field snapshots; 0: only first and last"""
    history_every: PositiveInt = 1
    """steps between rows of the history"""
    checkpoint_every: NonNegativeInt = 0
    """steps between checkpoints; 0: none"""
    checkpoint_minutes: NonNegativeFloat = 0.0
    """wall-clock time between checkpoints [min]; 0: none"""
    fields: Annotated[tuple[str, ...], listed] | None = None
    """names of the fields to write; default: all"""
    precision: Literal["float64", "float32"] = "float64"
    """precision of the fields in the result file"""
    compression: Literal["none", "gzip"] = "none"
    """lossless, of positions and fields in the result file; "gzip" takes ten times as long to write"""


class Output(OutputKeys):
    """Outputs and their intervals."""

    probe: tuple[Probe, ...] = ()


class ContactSettings(StrictModel):
    """Treatment of contact."""

    treatment: str = "scheme"
    """treatment of impact: velocity and acceleration of nodes in contact"""

    @field_validator("treatment")
    @classmethod
    def _exists(cls, treatment: str) -> str:
        known = ["scheme", *choices(TREATMENTS)]
        if treatment not in known:
            raise ValueError(f"unknown value{nearest(treatment, known)}")
        return treatment


class Solver(StrictModel):
    """Solution of the nonlinear and linear systems."""

    linear: Literal["auto", "cg", "multigrid", "gamg", "mumps"] = "auto"
    """linear solver"""
    operator: Literal["auto", "assembled", "matrix_free"] = "auto"
    """form of the Hessian"""
    rtol: Annotated[float, Field(gt=0.0, lt=1.0)] = 1e-9
    """relative tolerance of the residual"""
    atol: PositiveFloat | None = None
    """absolute tolerance of the residual [N]; default: from the model's force scale"""
    max_newton: PositiveInt = 50
    """maximum number of Newton iterations in a step"""
    guard: bool = True
    """whether converged implicit steps that are unrelated to the previous state are rejected and bisected"""

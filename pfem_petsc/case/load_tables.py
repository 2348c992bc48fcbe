"""The tables of a case file with loads, gravity and temperatures, each with its keys (SI units)."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from .base import FileName, Finite, NonNegativeFloat, PositiveFloat, StrictModel, Vector3
from .rows import Table2, Table4

__all__ = ["Gravity", "Load", "LoadFile", "Temperature", "VaryingGravity", "VaryingWind", "Wind"]


class Load(StrictModel):
    """Force on each node of a node set."""

    node_set: str
    """name of a node set"""
    force: Vector3
    """force on each node of the set [N]"""
    table: Table2 | None = None
    """rows [t, factor] [s, -], constant outside; default: factor 1"""
    table_file: FileName | None = None
    """the rows of ``table`` from the columns of a CSV or NPZ file: its name, or a table of :class:`TableFile`"""
    interpolation: Literal["linear", "smooth"] = "linear"
    """interpolation of ``table`` between its rows: straight lines, or a cubic spline"""

    @model_validator(mode="after")
    def _interpolates(self) -> Load:
        if self.interpolation == "smooth" and self.table is None:
            raise ValueError('interpolation = "smooth" requires table')
        return self


class LoadFile(StrictModel):
    """Forces over time on many nodes or node sets, from one file (:mod:`~pfem_petsc.case.load_files`)."""

    node_set: ClassVar[None] = None

    file: FileName
    """CSV or NPZ file with forces over time of nodes or node sets, relative to the case file"""
    scale: Finite = 1.0
    """factor of the forces"""
    time_scale: PositiveFloat = 1.0
    """factor of the times"""
    interpolation: Literal["linear", "smooth"] = "linear"
    """interpolation between the rows: straight lines, or a cubic spline"""
    digest: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")] | None = None
    """SHA-256 of the content of the file, which results and checkpoints keep; default: that of the file"""


class Gravity(StrictModel):
    """Uniform acceleration of every mass."""

    acceleration: Vector3
    """acceleration [m/s2]; or rows [t, ax, ay, az] [s, m/s2], constant outside"""
    acceleration_file: FileName | None = None
    """such rows from the columns of a CSV or NPZ file, added to a constant acceleration"""

    @property
    def mean(self) -> tuple[float, ...]:
        """Mean acceleration (3,) [m/s2]."""
        return self.acceleration


class VaryingGravity(Gravity):
    """Uniform acceleration of every mass that varies over time."""

    acceleration: Table4
    """rows [t, ax, ay, az] [s, m/s2], constant outside"""
    interpolation: Literal["linear", "smooth"] = "linear"
    """interpolation between the rows: straight lines, or a cubic spline"""

    @property
    def mean(self) -> tuple[float, ...]:
        """Mean of the rows (3,) [m/s2]."""
        return tuple(np.mean(np.array(self.acceleration)[:, 1:], axis=0).tolist())


class Wind(StrictModel):
    """Wind that drags the bars, the same everywhere."""

    velocity: Vector3
    """velocity [m/s]; or rows [t, vx, vy, vz] [s, m/s], constant outside"""
    velocity_file: FileName | None = None
    """such rows from the columns of a CSV or NPZ file, added to a constant velocity"""
    density: PositiveFloat = 1.225
    """density of the fluid [kg/m3]; default: air at 15 degrees Celsius"""
    drag_coefficient: NonNegativeFloat = 1.2
    """drag coefficient C_d of bars whose section has none"""


class VaryingWind(Wind):
    """Wind over time."""

    velocity: Table4
    """rows [t, vx, vy, vz] [s, m/s], constant outside"""
    interpolation: Literal["linear", "smooth"] = "linear"
    """interpolation between the rows: straight lines, or a cubic spline"""


class Temperature(StrictModel):
    """Temperature above reference of bars."""

    bars: str | None = None
    """bar group of the mesh; default: all bars"""
    value: Finite | None = None
    """temperature above reference [K]"""
    table: Table2 | None = None
    """rows [t, temperature above reference] [s, K], constant outside"""
    table_file: FileName | None = None
    """the rows of ``table`` from the columns of a CSV or NPZ file: its name, or a table of :class:`TableFile`"""
    interpolation: Literal["linear", "smooth"] = "linear"
    """interpolation of ``table`` between its rows: straight lines, or a cubic spline"""

    @model_validator(mode="after")
    def _exactly_one(self) -> Temperature:
        if (self.value is None) == (self.table is None):
            raise ValueError("expected exactly one of the keys value, table, table_file")
        if self.interpolation == "smooth" and self.table is None:
            raise ValueError('interpolation = "smooth" requires table')
        return self

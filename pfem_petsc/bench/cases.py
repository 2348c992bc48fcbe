"""The lattices that are timed: a block of cubic, octet or body-centred cells that hits a floor."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ..case.schema import Case

__all__ = ["KINDS", "PITCH", "WAVE_SPEED", "Job", "bars_of", "cells_for", "make_case"]

YOUNG_MODULUS = 110e9  # [Pa] titanium
DENSITY = 4500.0  # [kg/m3]
AREA = 1e-6  # [m2]
PITCH = 0.01  # [m]
YIELD_STRESS = 200e6  # [Pa]
HARDENING = 1e9  # [Pa]
WAVE_SPEED = math.sqrt(YOUNG_MODULUS / DENSITY)  # [m/s]

KINDS = {
    "cubic": lambda n: 3 * n * (n + 1) * (3 * n + 1),
    "octet": lambda n: 12 * n * n * (n + 1) + 12 * n**3,
    "bcc": lambda n: 3 * n * (n + 1) ** 2 + 8 * n**3,
}
"""Bars of n x n x n cells."""


@dataclass(frozen=True)
class Job:
    """A measurement.

    Attributes
    ----------
    name : in the tables
    integrator : name of a time integration scheme
    operator : of an implicit scheme: ``matrix_free`` or ``assembled``
    linear : linear solver of an implicit scheme
    contact : the foot of the lattice presses on a floor in every step; else the lattice flies and spins
    plastic : bars can yield
    mass : ``lumped`` or ``consistent``
    step : time step [s]
    speed : of the impact [m/s]
    history_every : steps between rows of the history
    """

    name: str
    integrator: str
    operator: str = "auto"
    linear: str = "auto"
    contact: bool = False
    plastic: bool = False
    mass: str = "lumped"
    step: float = 0.1 * PITCH / WAVE_SPEED
    speed: float = 20.0
    history_every: int = 1


def bars_of(kind: str, cells: int) -> int:
    """Return the number of bars of ``cells`` x ``cells`` x ``cells`` cells."""
    return KINDS[kind](cells)


def cells_for(kind: str, bars: int) -> int:
    """Return the cells along an edge, at least one, of the lattice whose number of bars is nearest to ``bars``."""
    n = 1
    while bars_of(kind, n + 1) <= bars:
        n += 1
    return n if bars - bars_of(kind, n) <= bars_of(kind, n + 1) - bars else n + 1


def make_case(job: Job, kind: str, cells: int, steps: int, **time: Any) -> Case:
    """Return the case of a job on a lattice, with ``steps`` steps and a history but no fields.

    ``time`` contains further keys of ``[time]``.
    """
    from ..case.schema import Case

    edge = cells * PITCH
    material: dict[str, Any] = {"young_modulus": YOUNG_MODULUS, "density": DENSITY}
    if job.plastic:
        material |= {"yield_stress": YIELD_STRESS, "isotropic_hardening": HARDENING}
    table: dict[str, Any] = {
        "title": f"{job.name}: {kind} lattice of {bars_of(kind, cells):,} bars",
        "mesh": {"generator": "lattice", "kind": kind, "cells": [cells, cells, cells], "pitch": PITCH},
        "material": {"strut": material},
        "section": {"strut": {"area": AREA, "material": "strut"}},
        "initial": {"velocity": [0.0, 0.0, -job.speed]},
        "time": {"integrator": job.integrator, "step": job.step, "end": steps * job.step, "mass": job.mass, **time},
        "output": {"fields_every": 0, "fields": [], "history_every": job.history_every},
        "solver": {"operator": job.operator, "linear": job.linear},
    }
    if job.contact:
        table["wall"] = [{"name": "floor", "type": "plane", "point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}]
    else:
        # a spin with the same speed at the corners, which strains and rotates bars
        table["initial"] = {"angular_velocity": [2.0 * job.speed / edge, 0.0, 0.0]}
    return Case.from_dict(table, source="bench", folder=Path.cwd())

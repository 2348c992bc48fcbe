"""The energies of the history, one line each: name, side of the energy balance, and source."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

__all__ = ["BAR_ENERGIES", "ENERGIES", "LOST", "STORED", "SUPPLIED", "Energy"]


class Energy(NamedTuple):
    """One column [J].

    Attributes
    ----------
    side : ``stored``, ``lost`` or ``supplied``: stored + lost - supplied is constant; ``part`` of another column
    source : ``bars``, sums of the material laws; ``state``, at the time of the row; ``ledger``, sums accumulated over
        the steps; ``derived``, the sum of other columns
    parts : columns that a derived one sums
    value : this rank's share of a term of the source ``state`` [J], from a
        :class:`~pfem_petsc.stepping.stepper.Stepper`; None if the ledger computes it
    """

    name: str
    side: str
    source: str
    parts: tuple[str, ...] = ()
    value: Callable[[Any], float] | None = None


# to add an energy, add one line here
ENERGIES = (
    Energy("kinetic_energy", "stored", "state"),
    Energy("elastic_energy", "stored", "bars"),
    Energy("wall_kinetic_energy", "stored", "state"),
    Energy("plastic_dissipation", "lost", "derived", parts=("plastic_heat", "hardening_energy")),
    Energy("plastic_heat", "part", "bars"),
    Energy("hardening_energy", "part", "bars"),
    Energy("damage_dissipation", "lost", "bars"),
    Energy("rupture_dissipation", "lost", "bars"),
    Energy("viscous_dissipation", "lost", "bars"),
    Energy("damping_dissipation", "lost", "ledger"),
    Energy("friction_dissipation", "lost", "ledger"),
    Energy("impact_dissipation", "lost", "ledger"),
    Energy("external_work", "supplied", "ledger"),
    Energy("contact_work", "supplied", "ledger"),
    Energy("thermal_work", "supplied", "ledger"),
    Energy("prestress_work", "supplied", "ledger"),
    Energy("numerical_dissipation", "lost", "ledger"),
    Energy("spring_energy", "stored", "bars"),  # of springs to the ground, whose forces are added to those of the bars
)

STORED, LOST, SUPPLIED = (tuple(e.name for e in ENERGIES if e.side == side) for side in ("stored", "lost", "supplied"))

BAR_ENERGIES = tuple(energy.name for energy in ENERGIES if energy.source == "bars")
"""Energies whose densities material laws return, in the order of their sums."""

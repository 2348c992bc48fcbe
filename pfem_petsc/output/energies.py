"""The energies of the history, one line each: name, side of the balance, and source."""

from __future__ import annotations

from typing import NamedTuple

__all__ = ["ENERGIES", "LOST", "STORED", "SUPPLIED", "Energy"]


class Energy(NamedTuple):
    """One column [J].

    Attributes
    ----------
    side : ``stored``, ``lost`` or ``supplied``: stored + lost - supplied is constant; ``part`` of another column
    source : ``state`` at the moment of the row, sums that the ``ledger`` accumulates, or ``derived`` from other columns
    """

    name: str
    side: str
    source: str


# one more energy is one more line here, and what computes it
ENERGIES = (
    Energy("kinetic_energy", "stored", "state"),
    Energy("elastic_energy", "stored", "state"),
    Energy("wall_kinetic_energy", "stored", "state"),
    Energy("plastic_dissipation", "lost", "derived"),  # plastic_heat + hardening_energy
    Energy("plastic_heat", "part", "state"),
    Energy("hardening_energy", "part", "state"),
    Energy("damping_dissipation", "lost", "ledger"),
    Energy("friction_dissipation", "lost", "ledger"),
    Energy("impact_dissipation", "lost", "ledger"),
    Energy("external_work", "supplied", "ledger"),
    Energy("contact_work", "supplied", "ledger"),
    Energy("thermal_work", "supplied", "ledger"),
    Energy("numerical_dissipation", "lost", "ledger"),
)

STORED, LOST, SUPPLIED = (tuple(e.name for e in ENERGIES if e.side == side) for side in ("stored", "lost", "supplied"))

"""Energy produced by contact or an implicit scheme: monitored during the run, and reported once."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from ..energies import STORED, SUPPLIED

if TYPE_CHECKING:
    from ..stepping.model import Model
    from ..stepping.plan import Plan

__all__ = ["CAUSES", "ContactWatch", "NoContactWatch"]

_SHARE = 0.02  # of the initial and supplied energy; more than the oscillation of the schemes' own energies
_ROWS = 4  # consecutive rows with a gain without contact; a short peak is not reported
_AT_END = 2  # the same, where the run ends with them

CAUSES = {
    "plastic_dissipation": "bars yield",
    "damage_dissipation": "bars are damaged",
    "rupture_dissipation": "bars break",
    "viscous_dissipation": "bars or dashpots are damped",
    "damping_dissipation": "damping stops nodes",
}
"""What dissipates besides friction and impact, and how messages tell it."""


class ContactWatch:
    """Compares the energy with the energy input, after contact of nodes and for implicit steps.

    The stored energy plus the energy dissipated by bars and damping, minus the energy supplied, cannot exceed its
    initial value: friction, impact and integration only reduce it. In large steps, within which bars yield or damping
    stops nodes, the work of the forces of the balance is less than the dissipation, and where supports move, their work
    within a step is not that of the reactions at its ends. The energy of an explicit scheme
    oscillates near its stability limit even without dissipation: by h^2/8 a.Ma with central differences, which is at
    most (h w/2)^2 of the elastic energy with the highest frequency w (h times the acceleration by a load is small). A
    gain up to this amount is accepted, and any gain if nothing dissipates. The rows are the same on all ranks, so all
    ranks report, or none.

    Parameters
    ----------
    model : Model
    tell : takes the warning
    plan : Plan
    """

    def __init__(self, model: Model, tell: Callable[[str], None], plan: Plan) -> None:
        self.tell = tell
        self.told = False
        self.explicit = plan.scheme.explicit
        self.swing = min((0.5 * plan.step * plan.frequency.upper) ** 2, 1.0)  # of the elastic energy
        self.rounding = model.rounding * model.length  # of energies [J]: what is at rest has no other
        self.rows = 0
        contact, time = model.case.contact, model.case.time
        self.key = "time.safety" if time.step == "auto" else "time.step"
        self.what = f'{time.integrator} with contact.treatment = "{contact.treatment}" and time.mass = "{time.mass}"'
        self.last, self.moves = plan.steps, model.supports.moves
        self.start: float | None = None
        self.scale = 0.0
        self.touched = False

    def check(self, row: dict[str, Any]) -> None:
        """Check a row of the history."""
        if self.told:
            return
        given = sum(row[name] for name in SUPPLIED)
        net = sum(row[name] for name in STORED) + sum(row[name] for name in CAUSES) - given
        if self.start is None:
            self.start = net
        self.scale = max(self.scale, self.rounding, abs(self.start), *(abs(row[name]) for name in SUPPLIED))
        self.touched = self.touched or row["active_contacts"] > 0
        gain = net - self.start
        if self.explicit and not self.touched:
            gain -= self._swing(row)
        self.rows = self.rows + 1 if gain > _SHARE * self.scale + self.rounding else 0
        if not self.rows:
            return
        made = f"{gain:.3g} J, {100.0 * gain / self.scale:.2g} % of the energy that the run had or was given"
        at = f"step {row['step']}, t = {row['time']:.6g} s"
        if self.touched:
            self.told = True
            self.tell(
                f"{at}: contact has produced {made}: {self.what} gains "
                "energy in impacts; use another contact.treatment or time.integrator, or a smaller time.step "
                "(docs/contact.md, phases of an impact)"
            )
        elif self.rows >= (_AT_END if row["step"] >= self.last else _ROWS):
            self.told = True
            self.tell(
                f"{at}: the total energy, including dissipated energy, has grown by {made}, without contact: the "
                f"steps are too large for the motion{self._causes(row)}; reduce {self.key}"
            )

    def _swing(self, row: dict[str, Any]) -> float:
        """What an explicit scheme's own energy may have gained for a while [J]: all of it where nothing dissipates."""
        if not any(row[name] > 0.0 for name in CAUSES):
            return float("inf")
        return self.swing * (row["elastic_energy"] + row["spring_energy"])

    def _causes(self, row: dict[str, Any]) -> str:
        """Return what large steps get wrong as part of a sentence."""
        found = [text for name, text in CAUSES.items() if row[name] > 0.0]
        found += ["supports move"] if self.moves else []
        *most, last = found or [""]
        return f" ({', '.join(most)}{' and ' if most else ''}{last})" if found else ""


class NoContactWatch:
    """For equilibria: works over their increments are quadratures, whose error is no energy that something has made."""

    start: float | None = None

    def check(self, row: dict[str, Any]) -> None:
        """Nothing to see."""

"""Energy that contact makes: watched while a run goes on, and told once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ..output.energies import STORED, SUPPLIED

__all__ = ["ContactWatch"]

_SHARE = 0.02  # of the energy that the run started with or was given: more than schemes' own energies swing by


class ContactWatch:
    """Compares energy with what was put in, once nodes have touched walls or each other.

    What is stored, and dissipated by plasticity and damping, less what was supplied, cannot grow beyond what it was at
    the start: friction, impact and integration only take from it. Its rows are the same on all ranks, so that all tell
    it, or none.

    Parameters
    ----------
    model : Model
    tell : takes the warning
    """

    def __init__(self, model, tell: Callable[[str], None]) -> None:
        self.tell = tell
        self.told = not model.can_touch
        contact, time = model.case.contact, model.case.time
        self.what = f'{time.integrator} with contact.treatment = "{contact.treatment}" and time.mass = "{time.mass}"'
        self.start: float | None = None
        self.scale = 0.0
        self.touched = False

    def check(self, row: dict[str, Any]) -> None:
        """Look at a row of the history."""
        if self.told:
            return
        given = sum(row[name] for name in SUPPLIED)
        net = sum(row[name] for name in STORED) + row["plastic_dissipation"] + row["damping_dissipation"] - given
        if self.start is None:
            self.start = net
        self.scale = max(self.scale, abs(self.start), *(abs(row[name]) for name in SUPPLIED))
        self.touched = self.touched or row["active_contacts"] > 0
        gain = net - self.start
        if self.touched and gain > _SHARE * self.scale:
            self.told = True
            self.tell(
                f"step {row['step']}, t = {row['time']:.6g} s: contact has made {gain:.3g} J, "
                f"{100.0 * gain / self.scale:.2g} % of the energy that the run had or was given: {self.what} gains "
                "energy at impacts; take another contact.treatment or time.integrator, or a smaller time.step "
                "(docs/contact.md, phases of an impact)"
            )

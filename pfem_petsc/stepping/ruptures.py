"""Bars that break: found after the loop that broke them, counted, and described for the log."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..mechanics.broken_bars import state_before_rupture
from ..mechanics.rupture import variable_of
from ..output.units import engineering

if TYPE_CHECKING:
    from .stepper import Stepper

__all__ = ["MOST_TOLD", "Break", "Ruptures"]

MOST_TOLD = 100
"""Number of broken bars that are described; the others are only counted."""


class Break(NamedTuple):
    """A bar that broke: number of the step, mesh number of the bar, and a description."""

    step: int
    bar: int
    text: str


class Ruptures:
    """Counts the bars of this rank that have broken; the loops over bars themselves decide which do.

    Attributes
    ----------
    count : number of broken bars that are counted on this rank
    told : number of them that have been taken by :meth:`take`
    """

    def __init__(self, stepper: Stepper) -> None:
        self._stepper = stepper
        self._bars, self._mesh = stepper.model.bars, stepper.model.mesh
        self._pending: list[Break] = []
        self.begin()

    def begin(self) -> None:
        """Take the bars that are broken now as known, after their state was restored."""
        self.count = self.told = 0
        if not self._bars.can_break:
            return
        self._known = self._bars.rupture() > 0.0
        self._counted = np.zeros(len(self._known), dtype=bool)
        self._counted[self._mesh.counted] = True
        self.count = self.told = int((self._known & self._counted).sum())

    def note(self) -> None:
        """Find the bars that broke in the last step, whose positions are those of the state."""
        broken = self._bars.rupture() > 0.0
        fresh = np.flatnonzero(broken & ~self._known & self._counted)
        self._known = broken
        self.count += len(fresh)
        self._bars.watched  # noqa: B018 - the fused loop reads the array
        number = self._stepper.number + 1
        for bar in fresh[: MOST_TOLD - len(self._pending)]:
            self._pending.append(Break(number, int(self._mesh.bar_ids[bar]), self._text(int(bar))))

    def take(self) -> list[Break]:
        """Return descriptions of the bars that broke since the last call, at most :data:`MOST_TOLD`."""
        pending, self._pending = self._pending, []
        self.told = self.count
        return pending

    def _text(self, bar: int) -> str:
        return f"bar {self._mesh.bar_ids[bar]} broke at {self._stepper.arrived()}: {self._reason(bar)}"

    def _reason(self, bar: int) -> str:
        """Return the limit that a bar has reached, with the value that it has."""
        block, column, stress, strain = state_before_rupture(self._bars, self._stepper.state.x, bar)
        plastic, damage = variable_of(block.law, "plastic_strain"), variable_of(block.law, "damage")
        values = {
            "sigma": stress,
            "strain": strain,
            "-sigma": -stress,
            "-strain": -strain,
            "plastic strain": abs(column[plastic]) if plastic >= 0 else 0.0,
            "damage": column[damage] if damage >= 0 else 0.0,
        }
        limits = dict(zip(values, block.parameters, strict=False))
        # the stress evaluated again may differ in the last digit from that in the loop
        key = max(values, key=lambda name: values[name] / limits[name])
        if key.endswith("sigma"):
            return f"{key} = {engineering(values[key], 'Pa')} >= {engineering(limits[key], 'Pa')}"
        return f"{key} = {values[key]:.4g} >= {limits[key]:.4g}"

"""Temperatures of bars above the reference, constant or varying, and the resulting thermal strains alpha theta."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from ..mesh.node_sets import group_hint
from .time_tables import Table

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..mesh.distribution import DistributedMesh
    from .bars import Bars

__all__ = ["Temperatures"]


class Temperatures:
    """Temperature of each local bar.

    Attributes
    ----------
    values : (b,) temperatures [K], or (0,)
    any : whether the case has temperatures
    varying : whether any of them changes over time
    """

    def __init__(self, case: Case, mesh: DistributedMesh, bars: Bars) -> None:
        self.any = bool(case.temperature)
        self.varying = any(entry.table is not None for entry in case.temperature)
        self._case, self._bars = case, bars
        self._entries = []
        for index, entry in enumerate(case.temperature):
            members = slice(None)
            if entry.bars is not None:
                if entry.bars not in mesh.bar_groups:
                    hint = group_hint(case, entry.bars, sorted(mesh.bar_groups), "Curve")
                    raise InputError(
                        f"{case.source}: temperature[{index}].bars = {entry.bars!r}: no such group of bars{hint}"
                    )
                members = mesh.bar_groups[entry.bars]
            table = Table(entry.table, entry.interpolation == "smooth") if entry.table is not None else None
            self._entries.append((members, entry.value, table))
        self._holds = case.holds("temperature")
        if self._holds:
            self.varying = False
        if self.any:
            bars.heat = np.zeros((2, len(mesh.bars)))
        self.values = bars.heat[1]
        if self._holds:
            self._entries = []
        if self.any:
            self.apply(0.0)
            bars.heat_at_start = bars.heat.copy()

    def hold(self, heat: np.ndarray) -> None:
        """Take over the thermal strains and temperatures [K] (2, b) of the previous stage if they remain in force."""
        if self._holds and self.any:
            self._bars.heat[:] = heat
            self._bars.heat_at_start = self._bars.heat.copy()

    @contextmanager
    def stiffest(self) -> Iterator[None]:
        """Give bars that soften the temperature at which their modulus is largest."""
        kept = self.values.copy()
        for block in self._bars.blocks:
            if block.law.modulus is not None:
                rows = np.array(self._case.material[self._case.section[block.section].material].softening)
                self.values[block.start : block.stop] = rows[np.argmax(rows[:, 1]), 0]
        try:
            yield
        finally:
            self.values[:] = kept

    def apply(self, time: float) -> None:
        """Set the thermal strains of the bars at a time [s]; later entries of the case override earlier ones."""
        for members, value, table in self._entries:
            self.values[members] = value if table is None else table(time)[0]
        for block in self._bars.blocks:
            part = slice(block.start, block.stop)
            self._bars.heat[0, part] = block.thermal_expansion * self.values[part]

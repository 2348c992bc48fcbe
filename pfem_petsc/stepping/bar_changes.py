"""Works of changing temperatures and rest lengths of bars, for the energy ledger.

In a step in which the strain less the thermal strain of a bar goes from e0 to e1 on a path with the mean stress S, and
its rest volume from V0 to V1, the energy W per volume, dissipation included, changes by S (e1 - e0) with the S of
:mod:`~pfem_petsc.mechanics.conserving`, so that of the bar by V S (e1 - e0) + W (V1 - V0), V and W being means of
both ends. Of this -V S (change of thermal strain) is the work of heating, V S (change of strain with the mean rest
length) that of the bar's ends, and the remainder the work of the changing rest length: that of what pulls the bar
tight, less the energy of the material that it takes out. Where a temperature changes the modulus of the elastic strain
from E0 to E1, s0 s1 (1/E0 - 1/E1)/2 per volume is work of heating too.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..mechanics.broken_bars import state_before_rupture
from ..mechanics.materials._work import SMALL
from ..mechanics.strain import MEASURES

if TYPE_CHECKING:
    from ..mechanics.bar_blocks import BarBlock
    from .stepper import Stepper

__all__ = ["BarChanges"]

_STRAINS = {  # of arrays of stretches
    MEASURES["engineering"]: lambda s: s - 1.0,
    MEASURES["green"]: lambda s: 0.5 * (s * s - 1.0),
    MEASURES["logarithmic"]: np.log,
}


class BarChanges:
    """Stores the state of the bars before a step and computes the works in it."""

    def __init__(self, stepper: Stepper) -> None:
        self.stepper, self.model = stepper, stepper.model
        self.keep()

    def keep(self) -> None:
        """Store the current stresses, internal variables, thermal strains, and with them lengths and energies."""
        if not self.model.bars_vary:
            return
        bars, x = self.model.bars, self.stepper.state.x
        self._stress = bars.fields(x)["stress"]
        self._variables = [block.history[: len(block.law.internal)].copy() for block in bars.blocks]
        self._thermal, self._warmth = bars.heat[0].copy(), bars.heat[1].copy()
        self._state = bars.rupture() if bars.can_break else np.empty(0)
        if self.model.rest_lengths.varying or any(block.law.mean_of_work for block in bars.blocks):
            self._rest, self._lengths, self._densities = bars.rest.copy(), bars.lengths(x), bars.densities(x)

    def works(self) -> tuple[float, float]:
        """Return the works of changing temperatures and of changing rest lengths on the counted bars in the last step
        [J]."""
        model = self.model
        if not model.bars_vary:
            return 0.0, 0.0
        before = dict(vars(self))
        self.keep()
        heating = stressing = 0.0
        for k, block in enumerate(model.bars.blocks):
            part = slice(block.start, block.counted)
            mean = self._mean_stress(before, k, block)
            rest = model.bars.rest[part]
            if model.rest_lengths.varying:
                rest = 0.5 * (before["_rest"][part] + rest)
                stressing += self._stressing(before, block, mean, rest)
            if model.temperatures.varying:
                change = self._thermal[part] - before["_thermal"][part]
                heating -= float((block.counted_area * rest * mean * change).sum())
                if block.law.modulus is not None:
                    heating += float((block.counted_area * rest * self._softening(before, block)).sum())
        return heating, stressing

    def _mean_stress(self, before: dict, k: int, block: BarBlock) -> np.ndarray:
        """Return the mean stress of the counted bars of a block in the step [Pa]."""
        counted = slice(block.counted - block.start)
        first, last = self._ends(before, block)
        mean = 0.5 * (first + last)
        if block.law.mean_of_work:
            return self._mean_of_work(before, block, mean)
        if block.law.mean_correction is not None:
            variables = before["_variables"][k][:, counted], self._variables[k][:, counted]
            mean += block.law.mean_correction(block.parameters, last - first, *variables)
        return mean

    def _mean_of_work(self, before: dict, block: BarBlock, mean: np.ndarray) -> np.ndarray:
        """Return the change of energies over that of strains of the counted bars of a block [Pa]; ``mean`` where these
        hardly change."""
        part, strain = slice(block.start, block.counted), _STRAINS[block.measure]
        first, last = (
            strain(of["_lengths"][part] / of["_rest"][part]) - (of["_thermal"][part] if len(of["_thermal"]) else 0.0)
            for of in (before, vars(self))
        )
        change, work = last - first, self._densities[part] - before["_densities"][part]
        large = np.abs(change) > SMALL * (np.abs(first) + np.abs(last))
        return np.divide(work, change, out=mean, where=large)

    def _ends(self, before: dict, block: BarBlock) -> tuple[np.ndarray, np.ndarray]:
        """Return the stresses of the counted bars of a block at start and end of the step [Pa]."""
        part = slice(block.start, block.counted)
        first, last = before["_stress"][part], self._stress[part]
        if block.law.rupture >= 0:
            last = self._with_bars(before["_state"][part], part, last)
        return first, last

    def _softening(self, before: dict, block: BarBlock) -> np.ndarray:
        """Return the work per volume [J/m3] that temperatures do by changing the modulus of the counted bars."""
        part = slice(block.start, block.counted)
        moduli = (block.law.modulus(block.parameters, at[part]) for at in (before["_warmth"], self._warmth))
        product = np.multiply(*self._ends(before, block)) * (1.0 / next(moduli) - 1.0 / next(moduli))
        if block.law.rupture >= 0:  # stresses are those of the share that is left
            left = 1.0 - np.abs(before["_state"][part])
            product = np.divide(product, left, out=np.zeros_like(product), where=left > 0.0)
        return 0.5 * product

    def _with_bars(self, state: np.ndarray, part: slice, stress: np.ndarray) -> np.ndarray:
        """Return stresses at the end of the step [Pa] of bars that broke there as they were before."""
        stress = stress.copy()
        for k in np.flatnonzero(self._state[part] != state):
            whole = state_before_rupture(self.model.bars, self.stepper.state.x, part.start + int(k))[2]
            stress[k] = (1.0 - abs(state[k])) * whole
        return stress

    def _stressing(self, before: dict, block: BarBlock, mean: np.ndarray, rest: np.ndarray) -> float:
        """Return the work of changing rest lengths on the counted bars of a block [J]; ``rest``: their means [m]."""
        part, strain = slice(block.start, block.counted), _STRAINS[block.measure]
        first, last = before["_lengths"][part], self._lengths[part]
        rest0, rest1 = before["_rest"][part], self._rest[part]
        whole = strain(last / rest1) - strain(first / rest0)
        moved = strain(last / rest) - strain(first / rest)
        density = 0.5 * (before["_densities"][part] + self._densities[part])
        return float((block.counted_area * (rest * mean * (whole - moved) + density * (rest1 - rest0))).sum())

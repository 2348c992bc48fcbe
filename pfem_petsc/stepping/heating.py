"""Work of temperature changes on bars, for the energy ledger."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .stepper import Stepper

__all__ = ["Heating"]


class Heating:
    """Stores the state of the bars before a step and computes the work in it."""

    def __init__(self, stepper: Stepper) -> None:
        self.stepper, self.model = stepper, stepper.model
        self.keep()

    def keep(self) -> None:
        """Store the current stresses, internal variables and thermal strains."""
        if self.model.temperatures.varying:
            bars = self.model.bars
            self._stress = bars.fields(self.stepper.state.x)["stress"]
            self._variables = [block.history[: len(block.law.internal)].copy() for block in bars.blocks]
            self._thermal = bars.heat[0].copy()

    def work(self) -> float:
        """Return the work [J] on the counted bars in the last step, -A l0 S (change of thermal strain), with the mean
        stress S of :mod:`~pfem_petsc.mechanics.conserving`: (s0 + s1)/2 with the correction of the law."""
        model = self.model
        if not model.temperatures.varying:
            return 0.0
        stress, variables, thermal = self._stress, self._variables, self._thermal
        self.keep()
        total = 0.0
        for block, before, after in zip(model.bars.blocks, variables, self._variables, strict=True):
            part = slice(block.start, block.counted)
            mean = 0.5 * (stress[part] + self._stress[part])
            if block.law.mean_correction is not None:
                counted = slice(block.counted - block.start)
                change = self._stress[part] - stress[part]
                mean += block.law.mean_correction(block.parameters, change, before[:, counted], after[:, counted])
            change = self._thermal[part] - thermal[part]
            total -= block.area * float((model.bars.rest[part] * mean * change).sum())
        return total

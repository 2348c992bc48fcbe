"""Rarely used queries of bars that break or are removed: the stress at the break, and the removal of a share."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..energies import BAR_ENERGIES

if TYPE_CHECKING:
    from .bar_blocks import BarBlock
    from .bars import Bars

__all__ = ["release", "state_before_rupture"]


def state_before_rupture(bars: Bars, x: np.ndarray, bar: int) -> tuple[BarBlock, np.ndarray, float, float]:
    """Return the block of a bar (local index), its data (rows,), and its stress [Pa] and strain without the thermal
    strain at positions ``x``, as if it had not broken."""
    block = next(block for block in bars.blocks if block.start <= bar < block.stop)
    k = bar - block.start
    history = block.history[:, k : k + 1].copy()
    history[block.law.rupture] = 0.0
    strain, stress, force = (np.zeros(bar + 1) for _ in range(3))
    arguments = (x, bars.ends, bars.rest, bars.heat, block.parameters, block.area, bars.step, history)
    block.kernels.fields(*arguments, bar, bar + 1, strain, stress, force)
    shift = bars.heat[0, bar] if bars.heat.shape[1] else 0.0
    return block, history[:, 0], float(stress[bar]), float(strain[bar] - shift)


def release(bars: Bars, x: np.ndarray, members: np.ndarray, state: float) -> np.ndarray:
    """Remove bars (local indices) up to a share, see :mod:`~pfem_petsc.mechanics.rupture`; return by how much the
    energies of the bars counted on this rank change, in the order of :data:`~pfem_petsc.energies.BAR_ENERGIES`."""
    change = np.zeros(len(BAR_ENERGIES))
    for block in bars.blocks:
        mine = members[(members >= block.start) & (members < block.stop)].astype(np.int64)
        moved = np.zeros(len(block.law.energies) - 1)
        law = (block.parameters, block.area, block.history, block.start)
        block.release(x, bars.ends, bars.rest, bars.heat, *law, mine, state, block.counted, moved)
        for name, energy in zip(block.law.energies, moved.tolist(), strict=False):
            change[BAR_ENERGIES.index(name)] -= energy
            change[BAR_ENERGIES.index("rupture_dissipation")] += energy
    return change

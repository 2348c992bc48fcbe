"""Bounds on the unknowns of one solve of an implicit step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["Bounds"]


@dataclass(frozen=True)
class Bounds:
    """What the rows of walls and links make of the unknowns.

    Attributes
    ----------
    arrays : lower and upper bounds (owned, 3) [m], infinite where there is none; None in free flight
    """

    arrays: tuple[np.ndarray, np.ndarray] | None = None

    def clip(self, w: np.ndarray) -> np.ndarray:
        """A guess (owned, 3) within the bounds, to the last digit."""
        return w if self.arrays is None else np.clip(w, *self.arrays)

    def project(self, w: np.ndarray, within: float) -> None:
        """Put unknowns (owned, 3) that are no farther than ``within`` [m] from a bound exactly there."""
        for bound in self.arrays or ():
            near = np.abs(w - bound) <= within
            w[near] = bound[near]

    def active(self, nodes: np.ndarray, w: np.ndarray, g: np.ndarray, noise: float) -> np.ndarray:
        """(m, 3) int8: -1 where unknowns of nodes (m,) are pressed on their lower bound, 1 on the upper, else 0.

        ``w`` (owned, 3), residual ``g`` (m, 3) of these nodes; one of at most ``noise`` presses nothing [N].
        """
        lower, upper = self.arrays
        active = np.zeros((len(nodes), 3), dtype=np.int8)
        active[(w[nodes] <= lower[nodes]) & (g > noise)] = -1
        active[(w[nodes] >= upper[nodes]) & (g < -noise)] = 1
        return active

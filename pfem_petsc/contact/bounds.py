"""Bounds on the unknowns of one solve of an implicit step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["Bounds"]


@dataclass(frozen=True)
class Bounds:
    """Lower and upper bounds that the rows of walls and links place on the unknowns.

    Attributes
    ----------
    arrays : lower and upper bounds (owned, 3) [m], infinite where there is no bound; None in free flight
    """

    arrays: tuple[np.ndarray, np.ndarray] | None = None

    def clip(self, w: np.ndarray) -> np.ndarray:
        """Return a guess (owned, 3) clipped exactly to the bounds."""
        return w if self.arrays is None else np.clip(w, *self.arrays)

    def project(self, w: np.ndarray, within: float) -> None:
        """Set unknowns (owned, 3) within ``within`` [m] of a bound to the bound, in place."""
        for bound in self.arrays or ():
            near = np.abs(w - bound) <= within
            w[near] = bound[near]

    def active(self, nodes: np.ndarray, w: np.ndarray, g: np.ndarray, noise: float) -> np.ndarray:
        """Return (m, 3) int8: -1 where an unknown of nodes (m,) is active at its lower bound, 1 at the upper, else 0.

        ``w`` (owned, 3); ``g`` (m, 3) residual of these nodes, zero up to ``noise`` [N].
        """
        lower, upper = self.arrays
        active = np.zeros((len(nodes), 3), dtype=np.int8)
        active[(w[nodes] <= lower[nodes]) & (g > noise)] = -1
        active[(w[nodes] >= upper[nodes]) & (g < -noise)] = 1
        return active

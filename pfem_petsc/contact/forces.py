"""Forces of walls on the nodes of a rank, and their sums."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

__all__ = ["WallForces"]


@dataclass
class WallForces:
    """Sums over this rank's nodes for each wall, and these nodes.

    Attributes
    ----------
    force : (walls, 3) on the truss [N]
    contacts : (walls,) nodes in contact
    moment : (walls, 3) of the force about the origin [N m]
    nodes : (m,) owned nodes near walls
    touching : (m, walls) bool, walls that they touch
    places : (m, 3) their positions [m]
    friction : energy that friction on these nodes dissipates in the step solved for [J]
    sums : names of the attributes that are sums
    """

    sums: ClassVar[tuple[str, ...]] = ("force", "contacts", "moment")

    force: np.ndarray
    contacts: np.ndarray
    moment: np.ndarray
    nodes: np.ndarray
    touching: np.ndarray
    places: np.ndarray
    friction: float = 0.0

    @classmethod
    def none(cls, walls: int) -> Self:
        """Return zero forces, shared by all steps without contact; the sums are read-only."""
        none = cls(
            np.zeros((walls, 3)),
            np.zeros(walls, dtype=np.int64),
            np.zeros((walls, 3)),
            np.empty(0, dtype=np.int64),
            np.empty((0, walls), dtype=bool),
            np.empty((0, 3)),
        )
        for name in none.sums:
            getattr(none, name).flags.writeable = False
        return none

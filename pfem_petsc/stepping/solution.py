"""The result of solving one balance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from ..contact.forces import WallForces

__all__ = ["Solution"]


@dataclass
class Solution:
    """Result of solving one balance.

    Attributes
    ----------
    u : (owned, 3) increment from the predictor [m]
    internal : (local, 3) internal force in the balance [N]
    walls : forces per wall, this rank's share
    newton, linear : numbers of iterations
    contacts : number of this rank's nodes in contact with walls
    """

    u: np.ndarray
    internal: np.ndarray
    walls: WallForces
    newton: int = 0
    linear: int = 0
    contacts: int = 0

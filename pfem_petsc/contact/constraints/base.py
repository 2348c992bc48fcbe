"""What every constraint is: rows r(x) >= 0 over a few nodes each, with their gradients.

A module of this package is a kind of constraint: a class ``Parameters`` with the keys of a ``[[constraint]]`` table,
and a class ``Constraint``. Explicit and implicit steps, history and checkpoints follow from the rows.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

import numpy as np

from ...case.base import ConstraintKeys, NodeSetName

__all__ = ["Constraint", "ConstraintKeys", "NodeSetName", "NodesOf"]

NodesOf = Callable[[str], tuple[np.ndarray, np.ndarray]]
"""Name of a node set to the mesh numbers of its nodes (n,), ascending, and their places in the mesh (n, 3) [m]; the
same on all ranks."""


class Constraint(ABC):
    """The rows of one table.

    Attributes
    ----------
    nodes : (r, k) mesh numbers of the nodes of each row; the same on all ranks
    """

    nodes: np.ndarray

    @abstractmethod
    def values(self, x: np.ndarray) -> np.ndarray:
        """Rows (r,) [m] at positions (r, k, 3) [m]: what is not negative is allowed."""

    @abstractmethod
    def gradients(self, x: np.ndarray) -> np.ndarray:
        """Derivatives (r, k, 3) of the rows by the positions (r, k, 3); of about unit length.

        A row that presses with the force f [N] pushes its nodes by f times its gradient.
        """

    def drift(self, x: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Second derivatives (r,) of the rows by time [m/s2] for nodes that move straight on: zero by default.

        ``x``, ``v`` (r, k, 3) : positions and velocities [m], [m/s]
        """
        return np.zeros(len(x))

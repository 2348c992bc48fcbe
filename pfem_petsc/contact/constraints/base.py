"""Base class of constraints: rows r(x) >= 0 over a few nodes each, with their gradients.

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
"""Maps the name of a node set to the mesh numbers of its nodes (n,), ascending, and their positions in the mesh (n, 3)
[m]; the same on all ranks."""


class Constraint(ABC):
    """The rows of one table.

    Attributes
    ----------
    nodes : (r, k) mesh numbers of the nodes of each row; the same on all ranks
    """

    nodes: np.ndarray

    @abstractmethod
    def values(self, x: np.ndarray) -> np.ndarray:
        """Return rows (r,) [m] at positions (r, k, 3) [m]; nonnegative values are allowed."""

    @abstractmethod
    def gradients(self, x: np.ndarray) -> np.ndarray:
        """Return derivatives (r, k, 3) of the rows with respect to the positions (r, k, 3), of about unit length.

        A row with force f [N] applies f times its gradient to its nodes.
        """

    def drift(self, x: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return second time derivatives (r,) of the rows [m/s2] at constant nodal velocities; zero by default.

        ``x``, ``v`` (r, k, 3) : positions and velocities [m], [m/s]
        """
        return np.zeros(len(x))

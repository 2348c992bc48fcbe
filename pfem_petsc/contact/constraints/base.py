"""Base class of constraints: rows r(x) >= 0 over a few nodes each, with their gradients.

A module of this package is a kind of constraint: a class ``Parameters`` with the keys of a ``[[constraint]]`` table,
and a class ``Constraint``. Explicit and implicit steps, history and checkpoints follow from the rows.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import NamedTuple, Self

import numpy as np

from ...case.base import ConstraintKeys, NodeSetName

__all__ = ["Constraint", "ConstraintKeys", "NodeSetName", "NodesOf", "SetPart"]


class SetPart(NamedTuple):
    """This rank's part of a node set in ascending order of mesh numbers: a range of the whole.

    The ranges of sets of the same size agree, so that corresponding nodes of two sets are on the same rank.
    """

    count: int
    """Nodes of the set on all ranks."""
    numbers: np.ndarray
    """(m,) mesh numbers, ascending."""
    places: np.ndarray
    """(m, 3) positions in the mesh [m]."""


NodesOf = Callable[[str], SetPart]
"""Function from the name of a node set (a key of type ``NodeSetName``) to this rank's part of it."""


class Constraint(ABC):
    """The rows of one table.

    The constructor creates rows for this rank's parts of node sets. It does not communicate; an error that it raises on
    one rank is raised on all. The rows of all ranks, in the order of the ranks, must not depend on the number of
    ranks. Rows are then sent to the ranks of their nodes: from then on :attr:`nodes` and :attr:`data` belong to other
    rows, and ``values``, ``gradients`` and ``drift`` may be called for any subset of them, see :meth:`of`.

    Attributes
    ----------
    nodes : (r, k) mesh numbers of the nodes of each row; k is the same on all ranks
    data : (r, m) float64, numbers of each row, such as a length; m is the same on all ranks, zero by default
    fixed : whether gradients never turn, so that rows are linear
    ids : (r,) number of each row in its table; None: counted over ranks
    """

    nodes: np.ndarray
    data: np.ndarray
    fixed = False
    ids: np.ndarray | None = None

    def of(self, nodes: np.ndarray, data: np.ndarray) -> Self:
        """Return the constraint with other rows (r, k), (r, m)."""
        other = copy.copy(self)
        other.nodes, other.data = nodes, data
        return other

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

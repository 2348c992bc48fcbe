"""Base class of constraints: rows r(x) >= 0 over a few nodes each, with their gradients.

A module of this package is a kind of constraint: a class ``Parameters`` with the keys of a ``[[constraint]]`` table,
and a class ``Constraint``. Explicit and implicit steps, history and checkpoints follow from the rows, which may be the
same in all steps or be found in each of them (``dynamic``).
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import NamedTuple, Self

import numpy as np
from mpi4py import MPI

from ...case.base import ConstraintKeys, NodeSetName

__all__ = ["Constraint", "ConstraintKeys", "ExpectedNodes", "NodeSetName", "NodesOf", "SetPart"]


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


class ExpectedNodes(NamedTuple):
    """This rank's nodes in a step whose rows are to be found.

    Attributes
    ----------
    comm : MPI.Comm
    numbers : (n,) mesh numbers of the nodes that this rank owns
    x : (n, 3) positions at the end of the step without the rows [m]; reach : (n,) how far from there they may end [m]
    time : at the end of the step [s]
    """

    comm: MPI.Comm
    numbers: np.ndarray
    x: np.ndarray
    reach: np.ndarray
    time: float


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
    dynamic : whether rows come and go: :meth:`find` is then called in each step, before it is solved
    ids : (r,) number of each row in its table, by which a row is the same in another step; None: counted over ranks
    name : of the table, for messages
    friction : coefficients of dynamic and static friction; restitution : its coefficient. Rows with either need
        :meth:`weights`
    """

    nodes: np.ndarray
    data: np.ndarray
    fixed = False
    dynamic = False
    ids: np.ndarray | None = None
    name = ""
    friction = 0.0, 0.0
    restitution = 0.0

    def of(self, nodes: np.ndarray, data: np.ndarray) -> Self:
        """Return the constraint with other rows (r, k), (r, m)."""
        other = copy.copy(self)
        other.nodes, other.data = nodes, data
        return other

    def find(self, nodes: ExpectedNodes) -> Self:
        """Return the constraint with the rows of a step, itself if they are those of the last one. Collective.

        Rows may be made on any rank; :meth:`with_rows` does the rest. What a search keeps from step to step belongs to
        the constraint returned, because a step that does not converge is repeated from the one before. ``ids`` must
        be given, and a row that stays must keep its last node.
        """
        return self

    def with_rows(self, comm: MPI.Comm, nodes: np.ndarray, data: np.ndarray, ids: np.ndarray) -> Self:
        """Return the constraint with other rows of this rank (r, k), (r, m), and their numbers (r,); itself if they are
        the same on all ranks. Collective."""
        pairs = ((self.nodes, nodes), (self.data, data), (self.ids, ids))
        if comm.allreduce(all(np.array_equal(one, other) for one, other in pairs), op=MPI.LAND):
            return self
        other = self.of(nodes, data)
        other.ids = ids
        return other

    def of_table(self, table: np.ndarray, width: int) -> Self:
        """Return the constraint with rows of a :class:`~pfem_petsc.contact.rows.RowSet`'s table whose rows have up to
        ``width`` nodes."""
        data = table[:, 2 + width : 2 + width + self.data.shape[1]].copy().view(np.float64)
        other = self.of(table[:, 2 : 2 + self.nodes.shape[1]].copy(), data)
        other.ids = table[:, 1].copy()
        return other

    def state(self) -> dict[str, np.ndarray]:
        """Return what :meth:`find` needs after a restart besides the rows: name to an array (n, ...) of the nodes that
        this rank owns, nothing by default; the same names on all ranks and from the start."""
        return {}

    def load_state(self, arrays: dict[str, np.ndarray]) -> None:
        """Take the arrays of :meth:`state` back."""

    @abstractmethod
    def values(self, x: np.ndarray) -> np.ndarray:
        """Return rows (r,) [m] at positions (r, k, 3) [m]; nonnegative values are allowed."""

    @abstractmethod
    def gradients(self, x: np.ndarray) -> np.ndarray:
        """Return derivatives (r, k, 3) of the rows with respect to the positions (r, k, 3), of about unit length.

        A row with force f [N] applies f times its gradient to its nodes.
        """

    def weights(self) -> np.ndarray:
        """Return the weights (r, k) of the nodes of rows n . (sum of weights times positions) >= d, whose gradients are
        the weights times unit vectors n; zero, by default, for others, which neither rub nor rebound."""
        return np.zeros(self.nodes.shape)

    def drift(self, x: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return second time derivatives (r,) of the rows [m/s2] at constant nodal velocities; zero by default.

        ``x``, ``v`` (r, k, 3) : positions and velocities [m], [m/s]
        """
        return np.zeros(len(x))

"""Rows over two nodes with a fixed direction."""

from __future__ import annotations

import numpy as np

from ..mesh.exchange import swap
from .rows import RowSet


class TwoNodeRows:
    """The rows of a set over two nodes with opposite gradients that never turn. Construction is collective.

    Attributes
    ----------
    rows : RowSet
    at : (p,) which rows of the set
    every : whether these are all rows of the set on this rank, no two of them with a common node
    ends, nodes : (2, p) nodes of the rows among those of the set, and their local indices, negative at other ranks
    normals, least : (p, 3) unit directions; (p,) bounds [m], of rows n . (x_2 - x_1) >= least
    along : (2, p) squared lengths of the free parts of the directions
    counted : (p,) bool, rows whose second node this rank owns
    restitution : (p,) coefficients
    """

    def __init__(self, rows: RowSet) -> None:
        self.rows, gradients = rows, rows.fixed_jacobian
        opposite = (gradients[:, 0] == -gradients[:, 1]).all(axis=1)
        self.at = np.flatnonzero(rows.fixed & (rows.last == 1) & opposite)
        self.every = len(self.at) == len(rows.source) and len(rows.numbers) == 2 * len(self.at)
        self.ends = np.ascontiguousarray(rows.ends[self.at, :2].T)
        self.nodes = rows.where[self.ends]
        self.counted = rows.counted[self.at]
        mine = self.nodes >= 0
        self._cut = np.flatnonzero(mine[0] != mine[1])
        self._others = rows.owners[self.at[self._cut], np.where(mine[0, self._cut], 1, 0)]
        self.normals = np.ascontiguousarray(gradients[self.at, 1])
        self.least = np.empty(0)
        if len(self.at):
            self.least = 0.0 - rows.values(np.zeros((len(rows.numbers), 3)))[self.at]
        self._free = rows.free[self.ends]
        self.along = (self._free * self.normals**2).sum(axis=2)
        self.restitution = rows.restitution[self.at]

    def agree(self, force: np.ndarray) -> None:
        """Replace forces (r,) of the set's rows, where two ranks have them, by those of the rank of the second node: if
        they differed by rounding, a row could be closed on one rank only. Collective."""
        if len(self._cut):
            at = self.at[self._cut]
            theirs = swap(self.rows.mesh.comm, self._others, force[at, None])[:, 0]
            force[at] = np.where(self.counted[self._cut], force[at], theirs)

    def gather(self, values: np.ndarray) -> np.ndarray:
        """Return values (2, p, ...) at the nodes of rows from those at owned nodes (owned, ...). Collective."""
        return self.rows.gather(values)[self.ends]

    def apart(self, ends: np.ndarray) -> np.ndarray:
        """Return n . (y_2 - y_1) (p,) of vectors (2, p, 3)."""
        return np.einsum("pi,pi->p", self.normals, ends[1] - ends[0])

    def pressed(self, force: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return owned nodes (m,) of rows with positive forces (p,), and the directions of their rows (m, 3)."""
        end, row = np.nonzero((self.nodes >= 0) & (force > 0.0))
        return self.nodes[end, row], self.normals[row]

    def together(
        self, values: np.ndarray, mass: np.ndarray, which: np.ndarray, rates: np.ndarray | float = 0.0
    ) -> np.ndarray:
        """Return velocities or accelerations (owned, 3) at which the nodes of rows ``which`` (p,) bool separate at
        ``rates`` (p,), with the same momentum; the rows share no nodes. Collective."""
        ends, masses = self.gather(values), self.gather(mass)
        gives = (self.along / masses).sum(axis=0)
        force = np.where(which & (gives > 0.0), rates - self.apart(ends), 0.0) / np.maximum(gives, 1e-300)
        end, row = np.nonzero((self.nodes >= 0) & (force != 0.0))
        push = (np.where(end == 1, force[row], -force[row])[:, None] * self.normals[row]) * self._free[end, row]
        same = values.copy()
        same[self.nodes[end, row]] += push / masses[end, row, None]
        return same

    def reduced_mass(self, mass: np.ndarray) -> np.ndarray:
        """Return 1/(1/m_1 + 1/m_2) (p,) [kg] along the directions, from masses of owned nodes (owned,). Collective."""
        gives = (self.along / self.gather(mass)).sum(axis=0)
        return 1.0 / np.maximum(gives, 1e-300)

    def close(self, at: np.ndarray, force: np.ndarray, ends: np.ndarray, slack: float) -> tuple[np.ndarray, float]:
        """Return which rows are closed (m,), and the energy [J] that those lose which close and whose second nodes this
        rank owns, see :mod:`~pfem_petsc.stepping.impact`.

        Parameters
        ----------
        at : (m,) rows whose force begins or ends; force : (m,) theirs
        ends : (2, m, 10) position, velocity and acceleration without contact, and mass of their nodes
        slack : distance at which a row has opened [m]
        """
        apart = (ends[1] - ends[0])[:, :9].reshape(-1, 3, 3)
        distance, speed, pull = np.einsum("mi,mki->km", self.normals[at], apart)
        distance, fresh = distance - self.least[at], force > 0.0
        square = np.maximum(speed * speed - 2.0 * pull * np.maximum(distance, 0.0), 0.0)
        gives = (self.along[:, at] / ends[:, :, 9]).sum(axis=0)
        lost = 0.5 * square / np.maximum(gives, 1e-300) * (1.0 - self.restitution[at] ** 2)
        return fresh | (distance <= slack), float(lost[fresh & (speed < 0.0) & self.counted[at]].sum())

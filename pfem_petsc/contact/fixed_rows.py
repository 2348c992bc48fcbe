"""Rows over two nodes with a fixed direction."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..mechanics.compiled import kernel
from ..mesh.exchange import swap
from .rows import RowSet


class ClosingRows(NamedTuple):
    """Rows (p,) n . (x_2 - x_1) >= least that may close.

    Attributes
    ----------
    normals, least : (p, 3) unit directions; (p,) bounds [m]
    along : (2, p) squared lengths of the free parts of the directions
    force : (p,) on the second nodes [N]; closed : (p,) bool, rows that have closed and not opened since
    restitution : (p,) coefficients
    """

    normals: np.ndarray
    least: np.ndarray
    along: np.ndarray
    force: np.ndarray
    closed: np.ndarray
    restitution: np.ndarray


class TwoNodeRows:
    """The rows of a set over two nodes with opposite gradients that never turn. Construction is collective.

    Attributes
    ----------
    rows : RowSet
    at : (p,) which rows of the set
    every : whether these are all rows of the set on this rank, no two of them with a common node
    ends, nodes : (2, p) nodes of the rows among those of the set, and their local indices, negative at other ranks
    normals, least, along : see :class:`ClosingRows`
    counted : (p,) bool, rows whose second node this rank owns
    record : ClosingRows, in the order of the set
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
        parts = self._free * self.normals**2
        self.along = (parts[:, :, 0] + parts[:, :, 1]) + parts[:, :, 2]
        p = len(self.at)
        changing = np.zeros(p), np.zeros(p, dtype=bool)
        self.record = ClosingRows(self.normals, self.least, self.along, *changing, rows.restitution[self.at])

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
        gives = (1.0 / masses * self.along).sum(axis=0)
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


@kernel
def close_rows(rows, at, ends, counted, slack):
    """Return the energy [J] that closing rows lose, see :mod:`~pfem_petsc.stepping.impact`; update ``rows.closed``.

    Parameters
    ----------
    rows : ClosingRows
    at : (m,) rows whose force begins or ends
    ends : (2, m, 10) position, velocity and acceleration without contact, and mass of their nodes
    counted : (p,) bool, rows whose energy this rank counts
    slack : distance at which a row has opened [m]
    """
    normals, along = rows.normals, rows.along
    energy = 0.0
    parts = np.empty(3)
    for m in range(len(at)):
        p = at[m]
        for k in range(3):
            d0 = normals[p, 0] * (ends[1, m, 3 * k] - ends[0, m, 3 * k])
            d1 = normals[p, 1] * (ends[1, m, 3 * k + 1] - ends[0, m, 3 * k + 1])
            d2 = normals[p, 2] * (ends[1, m, 3 * k + 2] - ends[0, m, 3 * k + 2])
            parts[k] = (d0 + d2) + d1
        distance, speed, pull = parts[0] - rows.least[p], parts[1], parts[2]
        fresh = rows.force[p] > 0.0
        rows.closed[p] = fresh or distance <= slack
        if fresh and speed < 0.0 and counted[p]:
            square = max(speed * speed - 2.0 * pull * max(distance, 0.0), 0.0)
            gives = along[0, p] / ends[0, m, 9] + along[1, p] / ends[1, m, 9]
            energy += 0.5 * square / max(gives, 1e-300) * (1.0 - rows.restitution[p] * rows.restitution[p])
    return energy

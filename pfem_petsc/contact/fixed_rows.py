"""Rows over two nodes with a fixed direction."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..mechanics.compiled import inlined, kernel, record
from .explicit import impact_square, rebound_lift
from .projection import Groups, RowPushes, System, project_groups
from .rows import FreeNodes, RowSet, find_broken, pair_values


@record
class FixedRows(NamedTuple):
    """Rows over two nodes with fixed directions, n . (x_2 - x_1) >= least (p rows), in the order of the row set, and
    their nodes (n,), which are all on this rank.

    Attributes
    ----------
    nodes, order : (n,) local indices of the nodes, and these in ascending order
    source, ends : (p,) table of each row; (2, p) its nodes
    normals, least : (p, 3) unit directions; (p,) bounds [m]
    along : (2, p) squared lengths of the free parts of the directions
    force, drag : (p,) forces and (p, 3) friction forces on the second nodes [N]; overwritten, like all that follow
    closed : (p,) bool, rows that have closed and not opened since
    restitution : (p,) coefficients
    rebound, arrival : (p,) memory of rows that have closed, see :class:`~pfem_petsc.contact.explicit.Arrivals`
    totals : (tables, 3) forces on the second nodes of each table [N]
    groups, system : see :mod:`~pfem_petsc.contact.projection`, the latter at ``x``
    tolerance : a row among several that is violated by at most this counts as satisfied [m]
    start, x, pushed : (n, 3) positions at the start of a step and without rows at its end, displacements by forces [m]
    moves, load : (n, 3) displacements [m] and forces [N] by rows
    """

    nodes: np.ndarray
    order: np.ndarray
    source: np.ndarray
    ends: np.ndarray
    normals: np.ndarray
    least: np.ndarray
    along: np.ndarray
    force: np.ndarray
    drag: np.ndarray
    closed: np.ndarray
    restitution: np.ndarray
    rebound: np.ndarray
    arrival: np.ndarray
    totals: np.ndarray
    groups: Groups
    system: System
    tolerance: float
    start: np.ndarray
    x: np.ndarray
    pushed: np.ndarray
    moves: np.ndarray
    load: np.ndarray


class ClosingRows(NamedTuple):
    """What :func:`close_rows` needs of rows; fields of :class:`FixedRows`."""

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
    normals, least, along : see :class:`FixedRows`
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

    def arrays(self, stiffness: np.ndarray, tolerance: float, tables: int) -> FixedRows:
        """Return the rows for compiled steps, without forces, which are all of the set.

        ``stiffness`` (owned,) is the force for a displacement of a node [N/m]; all nodes must be on this rank.
        ``tolerance`` : see :class:`FixedRows`; ``tables`` : number of tables of the case
        """
        rows, p, vectors = self.rows, len(self.at), np.zeros((6, len(self.rows.numbers), 3))
        nodes = FreeNodes(vectors[0], stiffness[rows.where], vectors[0], at_start=False, free=rows.free)
        system, (force, rebound, arrival) = rows.system(rows.fixed_jacobian, np.empty(p), nodes), np.zeros((3, p))
        fixed = rows.source, self.ends, self.normals, self.least, self.along
        forces = force, np.zeros((p, 3)), np.zeros(p, dtype=bool), self.record.restitution, rebound, arrival
        totals = np.zeros((tables, 3))
        return FixedRows(
            rows.where, np.argsort(rows.where), *fixed, *forces, totals, rows.groups, system, tolerance, *vectors[1:]
        )

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
def solve_fixed(rows, size):
    """Find the forces of :class:`FixedRows` that would be at ``x``, the displacements of their nodes, and the memory of
    those that close; ``size``: largest coordinate [m].

    Returns the first group of rows without a solution, or -1, and why, see
    :func:`~pfem_petsc.contact.projection.project_groups`; numbers of rows with a force, and of those whose force begins
    or ends with respect to ``closed``; and the energy that friction dissipates [J].
    """
    system, force, drag, p = rows.system, rows.force, rows.drag, len(rows.force)
    pulls, gaps, before = np.empty(p), np.empty(p), force > 0.0
    pair_values(rows.ends, rows.normals, rows.least, rows.x, system.values)
    force[:], drag[:], rows.moves[:], rows.load[:] = 0.0, 0.0, 0.0, 0.0
    for r in range(p):
        i, j, change, pulls[r] = rows.ends[0, r], rows.ends[1, r], 0.0, 0.0
        for c in range(3):
            system.slips[r, c] = rows.x[j, c] - rows.start[j, c] - (rows.x[i, c] - rows.start[i, c])
            change += rows.normals[r, c] * system.slips[r, c]
            pulls[r] -= rows.normals[r, c] * (rows.pushed[j, c] - rows.pushed[i, c])
        gaps[r] = system.values[r] - change
        system.values[r] -= rebound_lift(rows.restitution[r], rows.rebound[r], rows.arrival[r], pulls[r])
    tolerances, failed, why = np.full(len(rows.groups.starts) - 1, rows.tolerance), -1, 0
    if find_broken(rows.groups, system, rows.x, tolerances) > 0:
        which, pushes = np.flatnonzero(tolerances >= 0.0), RowPushes(force, drag, rows.moves)
        failed, why = project_groups(which, rows.groups, system, tolerances, size, pushes)
    count, altered, work = 0, 0, 0.0
    for r in range(p):
        i, j, change, presses = rows.ends[0, r], rows.ends[1, r], 0.0, force[r] > 0.0
        count, altered = count + presses, altered + (presses != rows.closed[r])
        for c in range(3 if presses else 0):
            change += rows.normals[r, c] * system.slips[r, c]
            part = force[r] * rows.normals[r, c] + drag[r, c]
            rows.load[i, c] -= part
            rows.load[j, c] += part
            work -= drag[r, c] * (system.slips[r, c] + rows.moves[j, c] - rows.moves[i, c])
        fresh = presses and not before[r] and rows.restitution[r] > 0.0
        rows.rebound[r] = impact_square(-change, gaps[r], pulls[r]) if fresh else 0.0
        rows.arrival[r] = gaps[r] if fresh else 0.0
    return failed, why, count, altered, work


@inlined
def pressed_nodes(rows, pressing):
    """Return the nodes (m,), ascending, of ``pressing`` rows, which are all that have a force."""
    nodes, count = np.empty(min(2 * pressing, len(rows.nodes)), dtype=np.int64), 0
    pushed = np.zeros(len(rows.nodes) if pressing > 0 else 0, dtype=np.bool_)
    for r in range(len(rows.force) if pressing > 0 else 0):
        for k in range(2):
            pushed[rows.ends[k, r]] |= rows.force[r] > 0.0
    for k in rows.order[: len(pushed)]:
        if pushed[k]:
            nodes[count] = rows.nodes[k]
            count += 1
    return nodes[:count].copy()


@kernel
def close_rows(rows, at, ends, counted, slack):
    """Return the energy [J] that closing rows lose, see :mod:`~pfem_petsc.stepping.impact`; update ``rows.closed``.

    Parameters
    ----------
    rows : ClosingRows or FixedRows
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

"""Rows over two nodes with a fixed direction."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..mechanics.compiled import inlined, kernel
from ..mechanics.records import record
from ..tolerances import FREE_PART
from .rows import RowSet
from .sweeps import Pushes, RubbingRows, settle_friction


@record
class FixedRows(NamedTuple):
    """Rows over two nodes with fixed directions, n . (x_2 - x_1) >= least (p rows), in the order of the row set.

    Attributes
    ----------
    table_starts : (tables + 1,) the first row of each table
    nodes, of : (2 p,) all nodes, ascending; their rows
    where : (2, p) local indices of the nodes, else -1 minus the row among those of other ranks
    normals, least : (p, 3) unit directions; (p,) bounds [m]
    soft : (p,) displacement by which a unit force separates the nodes [m/N], zero if supports hold both
    free : (2, p, 3) 0.0 where supports prescribe a component
    along : (2, p) squared lengths of the free parts of the directions
    totals : (tables, 3) room for the forces on the second nodes of each table [N]
    force, closed : (p,) forces [N]; bool, rows that have closed and not opened since; both are overwritten
    restitution : (p,) coefficients; friction : (p, 2) of dynamic and static friction, (0, 2) without
    drag : (p, 3) friction forces on the second nodes [N]
    rebound, arrival : (p,) memory of rows that have closed, see :class:`~pfem_petsc.contact.explicit.Arrivals`; (0,)
        without restitution
    """

    table_starts: np.ndarray
    nodes: np.ndarray
    of: np.ndarray
    where: np.ndarray
    normals: np.ndarray
    least: np.ndarray
    soft: np.ndarray
    free: np.ndarray
    along: np.ndarray
    totals: np.ndarray
    force: np.ndarray
    closed: np.ndarray
    restitution: np.ndarray
    friction: np.ndarray
    drag: np.ndarray
    rebound: np.ndarray
    arrival: np.ndarray


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

    def arrays(self, stiffness: np.ndarray, some: bool) -> FixedRows:
        """Return the rows, or none unless ``some``, for compiled steps, without forces.

        ``stiffness`` (owned,) is the force for a displacement of a node [N/m]; both nodes of all rows must be on this
        rank.
        """
        p = len(self.at) if some else 0
        where, along, tables = self.nodes[:, :p].copy(), self.along[:, :p].copy(), len(self.rows.sources)
        order = np.argsort(where.ravel(), kind="stable")
        soft = 1.0 / stiffness[where] * along if p else along
        return FixedRows(
            table_starts=np.searchsorted(self.rows.source[self.at][:p], np.arange(tables + 1)),
            nodes=where.ravel()[order],
            of=order % max(p, 1),
            where=where,
            normals=self.normals[:p],
            least=self.least[:p],
            soft=np.where(along[0] + along[1] > FREE_PART, soft[0] + soft[1], 0.0),
            free=self._free[:, :p].copy(),
            along=along,
            totals=np.zeros((tables, 3)),
            force=np.zeros(p),
            closed=np.zeros(p, dtype=bool),
            restitution=self.record.restitution[:p].copy(),
            friction=self.rows.friction[self.at][: p if self.rows.rubs else 0].copy(),
            drag=np.zeros((p, 3)),
            rebound=np.zeros(p if self.rows.rebounds else 0),
            arrival=np.zeros(p if self.rows.rebounds else 0),
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


class SingleRow(NamedTuple):
    """Room for a row that rubs: RubbingRows and Pushes of one, between two nodes."""

    rows: RubbingRows
    pushes: Pushes


@inlined
def new_single_row():
    """Return room for a row."""
    ends, weights = np.empty((1, 2), dtype=np.int64), np.empty((1, 2))
    ends[0, 0], ends[0, 1], weights[0, 0], weights[0, 1] = 0, 1, -1.0, 1.0
    vectors, normals, slips = np.empty((1, 2, 3)), np.empty((1, 3)), np.empty((1, 3))
    of_row = np.empty(1), slips, np.empty((1, 2)), np.empty((2, 3)), np.empty((1, 2))
    rows = RubbingRows(ends, weights, vectors, normals, *of_row)
    return SingleRow(rows, Pushes(np.empty(1), np.empty((1, 3)), np.empty((2, 3))))


@inlined
def rub_row(p, rows, short, stiffness, slip, size, single):
    """Find the force and drag of a row that presses; ``short``: its gap without force, negated [m]; ``stiffness`` and
    ``slip``: of its nodes (2,), and how far they move apart (3,); ``size``: largest coordinate [m]; ``single``:
    SingleRow. Returns whether they were found, and the energy that friction dissipates [J]."""
    one, pushes = single
    force = short / rows.soft[p]
    one.values[0], pushes.normal[0] = -short, force
    for k in range(2):
        one.friction[0, k] = rows.friction[p, k]
        for c in range(3):
            one.soft[k, c] = rows.free[k, p, c] / stiffness[k]
            one.gradients[0, k, c] = one.weights[0, k] * rows.normals[p, c] * rows.free[k, p, c]
            pushes.moves[k, c] = force * one.gradients[0, k, c] * one.soft[k, c]
    for c in range(3):
        one.normals[0, c], one.slips[0, c] = rows.normals[p, c], slip[c]
    found, work = settle_friction(1, one, size, pushes), 0.0
    rows.force[p] = pushes.normal[0]
    for c in range(3):
        rows.drag[p, c] = pushes.drag[0, c]
        work -= rows.drag[p, c] * (slip[c] + pushes.moves[1, c] - pushes.moves[0, c])
    return found, work


@inlined
def rebound_of_row(p, rows, gap, change, pull):
    """Return by how much the bound of a row is above zero [m] as it rebounds, and set its memory if it now closes, at a
    ``gap`` that would ``change`` in the step, of that by ``pull`` of forces that close it [m]; see
    :func:`~pfem_petsc.contact.explicit.impact_square`."""
    lift, e = 0.0, rows.restitution[p]
    if rows.rebound[p] > 0.0:
        whole = max(rows.rebound[p] + pull * rows.arrival[p] + 0.25 * pull * pull, 0.0)
        lift = max(e * math.sqrt(whole) - 0.5 * pull, 0.0)
    fresh = gap + change < lift and rows.soft[p] > 0.0 and e > 0.0 and rows.force[p] == 0.0
    rows.rebound[p] = max(change * change + pull * (change + gap), 0.0) if fresh and change < 0.0 else 0.0
    rows.arrival[p] = gap if fresh else 0.0
    return lift


@kernel
def pressed_nodes(rows, pressing):
    """Return the nodes (m,), ascending, of ``pressing`` rows, which are all that have a force."""
    nodes, count = np.empty(2 * pressing, dtype=np.int64), 0
    for k in range(len(rows.of) if pressing > 0 else 0):
        if rows.force[rows.of[k]] > 0.0:
            nodes[count] = rows.nodes[k]
            count += 1
    return nodes


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

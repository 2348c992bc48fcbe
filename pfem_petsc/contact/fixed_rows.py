"""Rows over two nodes with a fixed direction, each with nodes of its own: separated in one pass over the rows."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..mechanics.compiled import borrowing, kernel
from ..mesh.ordering import NODE_BLOCK
from ..tolerances import FREE_PART
from .rows import RowSet


class FixedRows(NamedTuple):
    """Rows over two nodes with fixed directions, n . (x_2 - x_1) >= least (p rows, b blocks of nodes).

    Attributes
    ----------
    starts : (b + 1,) the first row of each block: rows are sorted by the block of their later node
    place : (p,) where the rows are, in the order of the row set, which is that of sums; ``table_starts`` (tables + 1,)
        the first row of each table in this order
    ready : (b,) the block after which each block can be finished, ascending; (0,) if there are no rows
    near : (b,) bool, blocks with nodes of rows
    nodes, of, node_starts : (2 p,), (2 p,), (b + 1,) all nodes, ascending; their rows; the first node of each block
    where : (2, p) local indices of the nodes, else -1 minus the row among those of other ranks
    normals, least : (p, 3) unit directions; (p,) bounds [m]
    soft : (p,) displacement by which a unit force separates the nodes [m/N], zero if supports hold both
    axes : (k,) components in which any direction is not zero
    free, held : (2, p, 3) 0.0 where supports prescribe a component; (2, p) bool, nodes with such components
    along : (2, p) squared lengths of the free parts of the directions
    totals : (tables, 3) room for the forces on the second nodes of each table [N]
    force, closed : (p,) forces [N]; bool, rows that have closed and not opened since; both are overwritten
    """

    starts: np.ndarray
    place: np.ndarray
    table_starts: np.ndarray
    ready: np.ndarray
    near: np.ndarray
    nodes: np.ndarray
    of: np.ndarray
    node_starts: np.ndarray
    where: np.ndarray
    normals: np.ndarray
    soft: np.ndarray
    least: np.ndarray
    axes: np.ndarray
    free: np.ndarray
    held: np.ndarray
    along: np.ndarray
    totals: np.ndarray
    force: np.ndarray
    closed: np.ndarray


class ClosingRows(NamedTuple):
    """What :func:`close_rows` needs of rows; fields of :class:`FixedRows`."""

    normals: np.ndarray
    least: np.ndarray
    along: np.ndarray
    force: np.ndarray
    closed: np.ndarray


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
        self.record = ClosingRows(self.normals, self.least, self.along, np.zeros(p), np.zeros(p, dtype=bool))

    def of_blocks(self, stiffness: np.ndarray, some: bool) -> FixedRows:
        """Return the rows, or none unless ``some``, for batches of steps, sorted by blocks of nodes, without forces.

        ``stiffness`` (owned,) is the force for a displacement of a node [N/m]; both nodes of all rows must be on this
        rank.
        """
        own = self.nodes if some else self.nodes[:, :0]
        p, n_blocks = own.shape[1], -(-len(stiffness) // NODE_BLOCK)
        blocks = own // NODE_BLOCK
        later = blocks.max(axis=0)
        order = np.lexsort((own[0], later))
        place = np.empty(p, dtype=np.int64)
        place[order] = np.arange(p)
        numbers = np.arange(n_blocks + 1)
        ready = np.arange(n_blocks)
        for end in blocks:
            np.maximum.at(ready, end, later)
        where = np.ascontiguousarray(own[:, order])
        at = np.argsort(where.ravel(), kind="stable")
        nodes = where.ravel()[at]
        near = np.zeros(n_blocks, dtype=bool)
        near[blocks] = True
        free, along = np.ascontiguousarray(self._free[:, order]), np.ascontiguousarray(self.along[:, order])
        soft = 1.0 / stiffness[where] * along
        tables = len(self.rows.sources)
        return FixedRows(
            starts=np.searchsorted(later[order], numbers),
            place=place,
            table_starts=np.searchsorted(self.rows.source[self.at][:p], np.arange(tables + 1)),
            ready=np.maximum.accumulate(ready) if p else np.empty(0, dtype=np.int64),
            near=near,
            nodes=nodes,
            of=at % max(p, 1),
            node_starts=np.searchsorted(nodes, NODE_BLOCK * numbers),
            where=where,
            normals=self.normals[order],
            soft=np.where(along[0] + along[1] > FREE_PART, soft[0] + soft[1], 0.0),
            least=self.least[order],
            axes=np.flatnonzero(np.abs(self.normals).sum(axis=0)),
            free=free,
            held=(free == 0.0).any(axis=2),
            along=along,
            totals=np.zeros((tables, 3)),
            force=np.zeros(p),
            closed=np.zeros(p, dtype=bool),
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


@borrowing
def solve_rows(block, rows, nodes, shared, u, contact):
    """Solve the rows whose later node is in a block, with the bits of single steps: those of
    :func:`~pfem_petsc.contact.projection.project_groups`.

    ``nodes`` has ``mass`` and ``damping`` (n,), ``shared`` the step ``h``, the numbers ``alpha`` and ``eta``, and
    positions and velocities at half steps ``x``, ``half`` (n, 3), to which increments ``u`` (n, 3) are added;
    forces are written to ``contact`` (n, 3) [N], which is zero. Returns the number of rows with a force, and of rows
    whose force begins or ends with respect to ``rows.closed``.
    """
    x, half, h = shared.x, shared.half, shared.h
    mass, damping, alpha, eta = nodes.mass, nodes.damping, shared.alpha, shared.eta
    where, normals, axes, force = rows.where, rows.normals, rows.axes, rows.force
    damped = len(damping) > 0
    count, changed = 0, 0
    for p in range(rows.starts[block], rows.starts[block + 1]):
        i, j = where[0, p], where[1, p]
        d0 = d1 = d2 = 0.0
        for m in range(len(axes)):
            c = axes[m]
            there = (x[j, c] + h * half[j, c]) + u[j, c]
            here = (x[i, c] + h * half[i, c]) + u[i, c]
            d = normals[p, c] * (there - here)
            if c == 0:
                d0 = d
            elif c == 1:
                d1 = d
            else:
                d2 = d
        short = rows.least[p] - ((d0 + d2) + d1)
        if short <= 0.0 or not rows.soft[p] > 0.0:
            force[p] = 0.0
            if rows.closed[p]:
                changed += 1
            continue
        push = short / max(rows.soft[p], 1e-300)
        force[p] = push
        count += 1
        if not rows.closed[p]:
            changed += 1
        for end in range(2):
            node = where[end, p]
            hard = alpha * mass[node] + (eta * damping[node] if damped else 0.0)
            strength = push if end == 1 else -push
            for m in range(len(axes)):
                c = axes[m]
                part = strength * normals[p, c]
                contact[node, c] = part
                if rows.held[end, p]:
                    part *= rows.free[end, p, c]
                u[node, c] += part / hard
    return count, changed


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
            energy += 0.5 * square / max(gives, 1e-300)
    return energy

"""Rows over two nodes with a fixed direction, each with nodes of its own: separated in one pass over the rows."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..mechanics.compiled import borrowing, kernel
from ..mesh.ordering import NODE_BLOCK
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
    soft : (p,) displacement by which a unit force separates the nodes [m/N]
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


@kernel
def separate_nodes(rows, x, u, stiffness, far, load):
    """Move the nodes of rows so that the bounds are satisfied, and set the forces of the rows; return how many act.

    Parameters
    ----------
    rows : FixedRows
    x, u : (owned, 3); positions are their sum [m]; u is changed
    stiffness : (owned,) force for a displacement of a node [N/m]
    far : (partners, k) components ``rows.axes`` of positions [m]
    load : (owned, 3) to which the forces on nodes are added [N]
    """
    where, axes, normals, soft, least = rows.where, rows.axes, rows.normals, rows.soft, rows.least
    free, held, force = rows.free, rows.held, rows.force
    count = 0
    apart = np.zeros(3)
    for p in range(len(force)):
        # inlined by hand: a call that passes the arrays costs more than all the rest
        i, j = where[0, p], where[1, p]
        for k in range(len(axes)):
            c = axes[k]
            there = x[j, c] + u[j, c] if j >= 0 else far[-1 - j, k]
            here = x[i, c] + u[i, c] if i >= 0 else far[-1 - i, k]
            apart[c] = normals[p, c] * (there - here)
        short = least[p] - ((apart[0] + apart[2]) + apart[1])
        force[p] = 0.0
        if short <= 0.0 or not soft[p] > 0.0:
            continue
        force[p] = short / max(soft[p], 1e-300)
        count += 1
        for end in range(2):
            node = where[end, p]
            if node < 0:
                continue
            hard = stiffness[node]
            strength = force[p] if end == 1 else -force[p]
            for c in axes:
                push = strength * normals[p, c]
                load[node, c] += push
                if held[end, p]:
                    push *= free[end, p, c]
                u[node, c] += push / hard
    return count


@kernel
def compliances(where, stiffness, far, along, soft):
    """Compute the displacement ``soft`` (p,) by which a unit force separates the nodes of each row [m/N].

    ``stiffness`` (owned,), ``far`` (partners,) 1/stiffness; ``along`` (2, p) see :class:`FixedRows`.
    """
    for p in range(len(soft)):
        i, j = where[0, p], where[1, p]
        soft[p] = (1.0 / stiffness[i] if i >= 0 else far[-1 - i]) * along[0, p]
        soft[p] += (1.0 / stiffness[j] if j >= 0 else far[-1 - j]) * along[1, p]


@kernel
def leaving_rows(rows, x, u, axes, leaving):
    """Write components ``axes`` (k,) of x + u (owned, 3) of the nodes that partners need into ``leaving`` (rows, k)."""
    for m in range(len(rows)):
        i = rows[m]
        for k in range(len(axes)):
            leaving[m, k] = x[i, axes[k]] + u[i, axes[k]]


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
    record : FixedRows, in the order of the set, without blocks
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
        free = rows.free[self.ends]
        self.along = np.einsum("epi,pi->ep", free, self.normals**2)
        axes = np.flatnonzero(rows.mesh.comm.allreduce(np.abs(self.normals).sum(axis=0)))
        p, whole, none = len(self.at), np.empty(0, dtype=np.int64), np.empty(0, dtype=bool)
        self.record = FixedRows(
            *(whole, np.arange(p), np.searchsorted(rows.source, np.arange(len(rows.sources) + 1)), whole, none),
            *(whole, whole, whole, self.nodes, self.normals, np.empty(p), self.least, axes),
            *(free, (free == 0.0).any(axis=2), self.along),
            *(np.zeros((len(rows.sources), 3)), np.zeros(p), np.zeros(p, dtype=bool)),
        )
        self._soft_of: np.ndarray | None = None

    def separate(self, predictor: np.ndarray, u: np.ndarray, stiffness: np.ndarray, load: np.ndarray) -> np.ndarray:
        """Separate the nodes of rows that the free positions, predictor + u (owned, 3), violate; return the forces (p,)
        [N]. Collective.

        ``stiffness`` (owned,) [N/m] is the same array as long as its values are the same; forces on nodes are added to
        ``load`` (owned, 3) [N].
        """
        rows, partners = self.record, self.rows.partners
        if stiffness is not self._soft_of:
            far = np.empty((0, 1))
            if not partners.alone:
                far = partners.bring(1.0 / stiffness[partners.rows, None])
            compliances(rows.where, stiffness, far[:, 0], rows.along, rows.soft)
            self._soft_of = stiffness
        far = np.empty((0, len(rows.axes)))
        if not partners.alone:
            leaving = partners.leaving(len(rows.axes))
            leaving_rows(partners.rows, predictor, u, rows.axes, leaving)
            far = partners.bring(leaving)
        separate_nodes(rows, predictor, u, stiffness, far, load)
        return rows.force.copy()

    def of_blocks(self, stiffness: np.ndarray) -> FixedRows:
        """Return the rows for batches of steps, sorted by blocks of nodes, without forces.

        ``stiffness`` (owned,) is the force for a displacement of a node [N/m]; both nodes of all rows must be on this
        rank.
        """
        record = self.record
        p, n_blocks = len(self.at), -(-len(stiffness) // NODE_BLOCK)
        blocks = self.nodes // NODE_BLOCK
        later = blocks.max(axis=0)
        order = np.lexsort((self.nodes[0], later))
        place = np.empty(p, dtype=np.int64)
        place[order] = np.arange(p)
        numbers = np.arange(n_blocks + 1)
        ready = np.arange(n_blocks)
        for end in blocks:
            np.maximum.at(ready, end, later)
        where = np.ascontiguousarray(self.nodes[:, order])
        at = np.argsort(where.ravel(), kind="stable")
        nodes = where.ravel()[at]
        near = np.zeros(n_blocks, dtype=bool)
        near[blocks] = True
        free, along = np.ascontiguousarray(record.free[:, order]), np.ascontiguousarray(self.along[:, order])
        soft = np.empty(p)
        compliances(where, stiffness, np.empty(0), along, soft)
        return FixedRows(
            np.searchsorted(later[order], numbers),
            place,
            record.table_starts,
            np.maximum.accumulate(ready) if p else np.empty(0, dtype=np.int64),
            near,
            nodes,
            at % max(p, 1),
            np.searchsorted(nodes, NODE_BLOCK * numbers),
            where,
            self.normals[order],
            soft,
            self.least[order],
            record.axes.copy(),
            free,
            np.ascontiguousarray(record.held[:, order]),
            along,
            np.zeros_like(record.totals),
            np.zeros(p),
            np.zeros(p, dtype=bool),
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
        push = (np.where(end == 1, force[row], -force[row])[:, None] * self.normals[row]) * self.record.free[end, row]
        same = values.copy()
        same[self.nodes[end, row]] += push / masses[end, row, None]
        return same

    def reduced_mass(self, mass: np.ndarray) -> np.ndarray:
        """Return 1/(1/m_1 + 1/m_2) (p,) [kg] along the directions, from masses of owned nodes (owned,). Collective."""
        gives = (self.along / self.gather(mass)).sum(axis=0)
        return 1.0 / np.maximum(gives, 1e-300)


@borrowing
def solve_rows(block, rows, nodes, shared, u, contact):
    """Solve the rows whose later node is in a block, as :func:`separate_nodes` does.

    ``nodes`` has ``mass`` and ``damping`` (n,), ``shared`` the step ``h``, the numbers ``alpha`` and ``eta``, and
    positions and velocities at half steps ``x``, ``half`` (n, 3), to which increments ``u`` (n, 3) are added;
    ``contact`` (n, 3) [N] is written, and zero at nodes of rows without a force. Returns the number of rows with a
    force, and of rows whose force begins or ends with respect to ``rows.closed``.
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
        before = force[p]
        if short <= 0.0 or not rows.soft[p] > 0.0:
            if before != 0.0:
                force[p] = 0.0
                for c in range(3):
                    contact[i, c] = contact[j, c] = 0.0
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
def close_rows(rows, at, ends, counted, slack):
    """Return the energy [J] that closing rows lose, see :mod:`~pfem_petsc.stepping.impact`; update ``rows.closed``.

    Parameters
    ----------
    rows : FixedRows
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

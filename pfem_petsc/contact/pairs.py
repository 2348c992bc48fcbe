"""Contact between bodies: pairs of nodes that cannot pass each other along a direction, alone or sharing nodes with
others.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..errors import SimulationFailure
from ..mesh.exchange import swap
from ..parallel.agreement import agreed
from .contact import near_planes
from .fixed_rows import (
    FixedRows,
    broken_pairs,
    compliances,
    leaving_rows,
    make_rows,
    move_nodes,
    needed_forces,
    part_nodes,
    pressed_nodes,
    push_nodes,
    table_forces,
)
from .projection import project, solve_groups
from .row_search import find_pairs
from .rows import free_positions, free_stiffness, leaving_nodes

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..mesh.distribution import DistributedMesh
    from .contact import Contact


_ZERO = np.zeros(1)


class CoupledPairs:
    """The pairs of a rank, grouped by shared nodes.

    Attributes
    ----------
    any : whether any pairs of the model share nodes or have nodes that walls stop; else pairs are independent
    any_walled : whether walls stop any node of the model's pairs
    shared_node : lowest mesh number of a node in several pairs, or None
    coupled_node : lowest mesh number of a node in several pairs or with a wall, or None
    numbers : (n,) mesh numbers of the nodes of this rank's pairs, ascending
    shared : (n,) bool, nodes in several pairs
    """

    def __init__(self, pairs: ContactPairs, contact: Contact) -> None:
        self.pairs = pairs
        self.contact = contact
        ends = np.stack([pairs.first, pairs.second])
        self.numbers, first, of = np.unique(ends, return_index=True, return_inverse=True)
        self._of = of.reshape(ends.shape)
        n = len(self.numbers)
        self._where = pairs.where.ravel()[first]
        self._owned = np.flatnonzero(self._where >= 0)
        self._away = np.flatnonzero(self._where < 0)
        self._here, self._far = self._where[self._owned], -1 - self._where[self._away]
        self._free = pairs.free.reshape(-1, 3)[first]
        self._x, self._hard, self._nowhere = np.empty((n, 3)), np.empty(n), np.empty((0, 3))
        self._zero = np.zeros(n, dtype=np.int64)
        self._members = self._every(contact.members.astype(float)) > 0.0
        walled = self._members.any(axis=1)
        self.shared = np.bincount(self._of.ravel(), minlength=n) > 1
        self.shared_node = self._lowest(self.shared)
        self.coupled_node = self._lowest(self.shared | walled)
        self.any = self.coupled_node is not None
        self.any_walled = self._lowest(walled) is not None
        self._gather_groups()

    def _lowest(self, which: np.ndarray) -> int | None:
        own = self.numbers[which]
        lowest = self.pairs.mesh.comm.allreduce(int(own.min()) if len(own) else 2**62, op=MPI.MIN)
        return lowest if lowest < 2**62 else None

    def _gather_groups(self) -> None:
        """Sort the pairs into groups connected by shared nodes."""
        group = np.arange(len(self.numbers))
        while True:  # propagate the lowest label through nodes and pairs until nothing changes
            lowest = np.minimum(group[self._of[0]], group[self._of[1]])
            before = group.copy()
            for end in self._of:
                np.minimum.at(group, end, lowest)
            if np.array_equal(group, before):
                break
        labels, self._group = np.unique(group[self._of[0]], return_inverse=True)
        self._pairs = np.argsort(self._group, kind="stable")
        self._starts = np.searchsorted(self._group[self._pairs], np.arange(len(labels) + 1))

    def _every(self, values: np.ndarray) -> np.ndarray:
        """Return values (n, k) at the nodes of pairs from those at owned nodes (owned, k). Collective."""
        partners = self.pairs.partners
        return self._spread(values[self._here], partners.bring(values[partners.rows]))

    def _spread(self, here: np.ndarray, far: np.ndarray) -> np.ndarray:
        """Return values (n, k) from those at owned nodes of pairs (m, k) and those received from partners."""
        every = np.empty((len(self.numbers), here.shape[1]))
        every[self._owned] = here
        every[self._away] = far[self._far]
        return every

    def part(
        self, predictor: np.ndarray, u: np.ndarray, stiffness: np.ndarray, time: float, tolerance: float
    ) -> np.ndarray:
        """Return forces of the pairs (p,) [N] in a step; see :meth:`ContactPairs.explicit`. Collective."""
        contact, partners = self.contact, self.pairs.partners
        displacements = contact.motion.displacements(time)
        rows, walls = partners.rows, len(contact.walls) if contact.partial else 0
        far = np.empty((0, 4 + walls))
        if not partners.alone:
            leaving = partners.leaving(4 + walls)
            leaving_nodes(rows, predictor, u, stiffness, self._nowhere, leaving)
            if walls:
                leaving[:, 4:] = contact.applicable(rows, leaving[:, :3], displacements)
            far = partners.bring(leaving)
        x, hard = self._x, self._hard
        free_positions(self._where, predictor, u, far, x)
        free_stiffness(self._where, stiffness, far, hard)

        def own_planes(nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            applicable = self._members[nodes]
            if contact.partial:
                where = self._where[nodes]
                own = where >= 0
                applicable[own] = contact.applicable(where[own], x[nodes[own]], displacements)
                applicable[~own] = far[-1 - where[~own], 4:] > 0.0
            return contact.planes(applicable, x[nodes], displacements)

        near = np.zeros(len(x), dtype=bool)
        if self.any_walled:
            flat = contact.flat
            offsets = contact.plane_offsets(time)[flat]
            members = np.ascontiguousarray(self._members[:, flat])
            near_planes(x, contact.normals[flat], offsets, np.zeros(len(offsets), bool), members, _ZERO, near)
        shared = None
        if contact.flat.all() and not contact.partial:
            every = np.ones((1, len(contact.walls)), dtype=bool)
            shared = *contact.planes(every, np.zeros((1, 3)), displacements), self._members
        return self._forces(x, hard, self.pairs.gaps, own_planes, np.flatnonzero(near), tolerance, shared)

    def rest(
        self, a: np.ndarray, mass: np.ndarray, least: np.ndarray, resting: np.ndarray, tolerance: float
    ) -> np.ndarray:
        """Return initial forces of the pairs (p,) [N] for accelerations (owned, 3). Collective.

        ``least`` (p,): bounds on n . (a_2 - a_1), -inf for pairs that do not apply; ``resting`` (owned, walls) bool:
        nodes that rest on walls.

        Raises
        ------
        SimulationFailure
            On ranks whose pairs have no solution.
        """
        state, contact = self.contact.state, self.contact
        data = self._every(np.concatenate([a, mass[:, None], state.position, resting], axis=1))
        displacements = contact.motion.displacements(state.time)
        walled = data[:, 7:] > 0.0
        normals, _ = contact.planes(walled, data[:, 4:7], displacements)
        offsets = np.where(walled, 0.0, -np.inf)
        x = np.ascontiguousarray(data[:, :3])

        def planes(nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            return normals[nodes], offsets[nodes]

        near = np.flatnonzero(walled.any(axis=1))
        return self._forces(x, data[:, 3].copy(), least, planes, near, tolerance)

    def _forces(
        self,
        x: np.ndarray,
        stiffness: np.ndarray,
        least: np.ndarray,
        planes: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
        near: np.ndarray,
        tolerance: float,
        shared: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
    ) -> np.ndarray:
        """Return forces of the pairs (p,) for nodes at x (n, 3), of which ``near`` (m,) may lie beyond walls.

        ``planes(nodes)`` gives the normals (m, w, 3) and offsets (m, w) of nodes (m,), -inf where a wall is no concern;
        ``shared``: normals (1, w, 3), offsets (1, w) and nodes (n, w) bool where they are the same for all nodes.
        """
        pairs, free = self.pairs, self._free
        force, broken = np.zeros(len(least)), np.empty(len(least), dtype=bool)
        pushed = x
        if len(near):
            pushed = x.copy()
            moved, (normals, offsets) = x[near], planes(near)
            project(moved, free[near] == 0.0, normals, offsets, tolerance, np.zeros(offsets.shape))
            pushed[near] = moved
        if not broken_pairs(self._of, pushed, least, pairs.normals, tolerance, broken):
            return force
        chosen = np.zeros(len(self._starts) - 1, dtype=bool)
        chosen[self._group[broken]] = True
        groups = np.flatnonzero(chosen)
        if shared is not None:
            plane, given = self._zero, shared
        else:
            nodes = np.unique(self._of[:, chosen[self._group]])
            plane = np.full(len(x), -1)
            plane[nodes] = np.arange(len(nodes))
            given = *planes(nodes), np.empty((0, 0), dtype=bool)
        arguments = self._of, pairs.normals, least, x, stiffness, free, plane, given, tolerance, force
        infeasible = solve_groups(groups, self._starts, self._pairs, *arguments)
        if infeasible >= 0:
            some = np.unique(self._of[:, self._group == infeasible])
            shown = ", ".join(str(number) for number in self.numbers[some[:6]])
            raise SimulationFailure(f"no positions of nodes {shown} satisfy their contact pairs, walls and supports")
        return force


class ContactPairs:
    """The pairs of a case on this rank: those of its nodes, and those connected with them. Construction is collective.

    Attributes
    ----------
    names : of the tables; ``table`` (p,) is the index of each pair's table
    first, second : (p,) mesh numbers of the nodes
    normals, gaps : (p, 3), (p,) unit directions, and bounds on n . (x_second - x_first) [m]
    where : (2, p) local index of an end that this rank owns, else -1 minus its row among those of other ranks
    mine, local : (2, p) bool, ends that this rank owns, and their local indices, else 0
    partners : GhostExchange for values at ends that other ranks own
    coupled : CoupledPairs
    along : (2, p) compliance factors of the ends along the directions
    free : (2, p, 3) 1.0 where a component of an end may move, 0.0 where a support prescribes it
    force : (p,) force of each pair in the last step, positive in compression [N]; equal on all ranks that have the pair
    closed : (p,) bool, pairs that have closed and not opened since
    """

    def __init__(
        self, case: Case, nodes: dict[str, np.ndarray], mesh: DistributedMesh, fixed: np.ndarray, contact: Contact
    ) -> None:
        self.source = case.source
        self.mesh = mesh
        self.names = [pair.name for pair in case.contact_pair]
        found = find_pairs(case, nodes, mesh)
        self.partners = found.partners
        self.table, self.where, self._owners = found.table, found.where, found.owners
        self.first, self.second = found.numbers
        directions = [np.array(pair.direction) / np.linalg.norm(pair.direction) for pair in case.contact_pair]
        self.normals = np.array(directions)[self.table]
        self._axes = np.flatnonzero(np.any(directions, axis=0))  # components on which distances depend
        self._soft, self._softened = np.empty(len(self.table)), None
        self.gaps = np.array([pair.gap for pair in case.contact_pair], dtype=float)[self.table]
        self.mine = self.where >= 0
        self.local = np.maximum(self.where, 0)
        self.free = self.gather(np.where(fixed, 0.0, 1.0))
        self.along = np.einsum("epi,pi->ep", self.free, self.normals**2)  # compliance factors
        self._held = (self.free == 0.0).any(axis=2)
        self._none = np.empty((0, 3))
        self._nodes = np.empty(int(self.mine.sum()), dtype=np.int64)
        self._directions = np.empty((len(self._nodes), 3))
        self.closed = np.zeros(len(self.table), dtype=bool)
        self.release()
        self._no_totals = np.zeros((len(self.names), 3))
        table_forces(self.where, self.table, self.force, self.normals, self._no_totals)
        self.coupled = CoupledPairs(self, contact)

    def numbers(self, pair: int) -> tuple[int, int]:
        """Return the mesh numbers of a pair's second and first node."""
        return int(self.second[pair]), int(self.first[pair])

    def explicit(
        self,
        predictor: np.ndarray,
        u: np.ndarray,
        stiffness: np.ndarray,
        contact: np.ndarray,
        time: float,
        tolerance: float,
    ) -> bool:
        """Separate the pairs that the free positions, predictor + u, violate; walls follow. Collective.

        Gives whether any pair here has a force.

        Parameters
        ----------
        predictor, u : (owned, 3) [m]; u is changed
        stiffness : (owned,) force for a displacement of a node [N/m]
        contact : (owned, 3) forces on the nodes, to which those of the pairs are added [N]
        time : of the positions [s]
        tolerance : a coupled pair violated by at most this counts as satisfied [m]

        Raises
        ------
        SimulationFailure
            On ranks with pairs that are infeasible together with walls and supports.
        """
        if self.coupled.any:
            self.force = self.coupled.part(predictor, u, stiffness, time, tolerance)
            self._move(u, self.force, stiffness, contact)
        else:
            if stiffness is not self._softened:
                self._soften(stiffness)
                self._softened = stiffness
            self.force = self._part(predictor, u, stiffness, contact)
        return bool(self.force.any())

    def rows(self, stiffness: np.ndarray) -> FixedRows:
        """Return the pairs as rows for loops over many steps, without forces; ``stiffness`` (owned,) [N/m].

        Pairs must be independent of each other, with both nodes on this rank.
        """
        rows = self.where, self.normals, self.gaps, self._axes, self.free, self.along, self.table
        return make_rows(*rows, len(self.names), stiffness)

    def pressed(self) -> tuple[np.ndarray, np.ndarray]:
        """Return owned nodes (k,) of pairs in contact, and the directions (k, 3) of their pairs."""
        if not self.force.any():
            return self._nodes[:0].copy(), self._none
        count = pressed_nodes(self.where, self.force, self.normals, self._nodes, self._directions)
        return self._nodes[:count].copy(), self._directions[:count].copy()

    def any_pressed(self) -> bool:
        """Return whether any pair of the model has a force. Collective."""
        return bool(self.mesh.comm.allreduce(bool(self.force.any()), op=MPI.LOR))

    def release(self) -> None:
        """Set all forces to zero."""
        self.force = np.zeros(len(self.table))

    def part(self, predictor: np.ndarray, u: np.ndarray, stiffness: np.ndarray) -> np.ndarray:
        """Change u (owned, 3) [m] so that predictor + u satisfies all pairs; return their forces (p,) [N].

        Collective.
        """
        self._soften(stiffness)
        self._softened = None  # the values of the array may change
        return self._part(predictor, u, stiffness, self._none)

    def _soften(self, stiffness: np.ndarray) -> None:
        """Compute the compliances of the pairs. Collective."""
        far = np.empty((0, 1))
        if not self.partners.alone:
            far = self.partners.bring(1.0 / stiffness[self.partners.rows, None])
        compliances(self.where, stiffness, far[:, 0], self.along, self._soft)

    def _part(self, predictor: np.ndarray, u: np.ndarray, stiffness: np.ndarray, load: np.ndarray) -> np.ndarray:
        force, axes, far = np.empty(len(self.table)), self._axes, np.empty((0, len(self._axes)))
        if not self.partners.alone:
            leaving = self.partners.leaving(len(axes))
            leaving_rows(self.partners.rows, predictor, u, axes, leaving)
            far = self.partners.bring(leaving)
        positions = self.where, predictor, u, stiffness, far, axes
        part_nodes(*positions, self.normals, self._soft, self.gaps, self.free, self._held, force, load)
        return force

    def together(
        self, values: np.ndarray, mass: np.ndarray, rates: np.ndarray | float = 0.0, which: np.ndarray | None = None
    ) -> np.ndarray:
        """Return velocities or accelerations (owned, 3) at which pairs ``which`` (p,) separate at ``rates`` (p,), by
        default those in contact. Momentum is conserved. Collective."""
        same, which = values.copy(), self.force > 0.0 if which is None else which
        force = self._needed(values, mass, np.where(which, rates, -np.inf))
        self._move(same, force, mass)
        return same

    def resting(self, x: np.ndarray, v: np.ndarray, slack: float, still: float) -> np.ndarray:
        """Return (p,) bool: pairs at positions (owned, 3) that are closed within ``slack`` [m] and whose relative
        velocity is at most ``still`` [m/s]. Collective."""
        ends = self.gather(np.concatenate([x, v], axis=1))
        closed = np.abs(self.distances(ends[:, :, :3]) - self.gaps) <= slack
        return closed & (np.abs(self.distances(ends[:, :, 3:])) <= still)

    def rest(self, a: np.ndarray, mass: np.ndarray, closed: np.ndarray, resting: np.ndarray) -> np.ndarray:
        """Set the forces of closed pairs (p,) such that accelerations (owned, 3) do not make them overlap.

        ``resting`` (owned, walls) bool: nodes that rest on walls too. Returns the pairs' forces (owned, 3) [N] on free
        components. Collective.
        """
        least = np.where(closed, 0.0, -np.inf)
        if self.coupled.any:
            largest = self.mesh.comm.allreduce(float(np.abs(a).max(initial=0.0)), op=MPI.MAX)
            with agreed(self.mesh.comm):
                self.force = self.coupled.rest(a, mass, least, resting, 1e-13 * largest)
        else:
            self.force = np.maximum(self._needed(a, mass, least), 0.0)
        change = np.zeros_like(a)
        self._move(change, self.force, np.ones_like(mass))
        return change

    def reduced_mass(self, mass: np.ndarray) -> np.ndarray:
        """Return 1/(1/m_1 + 1/m_2) (p,) [kg] along the directions, from masses of owned nodes (owned,). Collective."""
        gives = (self.along / self.gather(mass)).sum(axis=0)
        return 1.0 / np.maximum(gives, 1e-300)

    def keep(self, values: np.ndarray, of_pairs: np.ndarray) -> None:
        """Write values (p,) of pairs in contact to their second ends in an array of owned nodes (owned,)."""
        here = self.mine[1] & (self.force > 0.0)
        values[self.local[1, here]] = of_pairs[here]

    def push(self, contact: np.ndarray, factor: float = 1.0) -> None:
        """Add the pairs' forces, times a factor, to those on the nodes (owned, 3) [N]."""
        push_nodes(self.where, self.force, factor, self.normals, contact)

    def _needed(self, x: np.ndarray, stiffness: np.ndarray, least: np.ndarray) -> np.ndarray:
        """Return forces (p,) that bring the distances at x (owned, 3) to ``least`` (p,), zero where that is -inf.
        Collective."""
        far, force, rows = np.empty((0, 4)), np.empty(len(self.table)), self.partners.rows
        if not self.partners.alone:
            far = self.partners.bring(np.column_stack([x[rows], 1.0 / stiffness[rows]]))
        needed_forces(self.where, x, stiffness, far, self.normals, self.along, least, force)
        return force

    def _move(self, u: np.ndarray, force: np.ndarray, stiffness: np.ndarray, load: np.ndarray | None = None) -> None:
        load = self._none if load is None else load
        move_nodes(self.where, force, self.normals, self.free, self._held, stiffness, u, load)

    def totals(self) -> dict[str, np.ndarray]:
        """Return the force (3,) [N] of each table's pairs on this rank's second nodes in the last step, by name."""
        sums = self._no_totals.copy()
        if self.force.any():
            table_forces(self.where, self.table, self.force, self.normals, sums)
        return dict(zip(self.names, sums, strict=True))

    def kept(self) -> dict[str, np.ndarray]:
        """Return the state of pairs for a checkpoint, at their second nodes: name to (owned, tables)."""
        at, found = self.mine[1], {}
        for name, values in (("pairs.force", self.force), ("pairs.closed", self.closed.astype(np.uint8))):
            found[name] = np.zeros((self.mesh.n_owned, len(self.names)), dtype=values.dtype)
            found[name][self.local[1, at], self.table[at]] = values[at]
        return found

    def load_state(self, name: str, values: np.ndarray) -> None:
        """Restore what :meth:`kept` returned. Collective."""
        of_pairs = self.gather(values)[1, np.arange(len(self.table)), self.table]
        if name == "pairs.force":
            self.force = of_pairs
        else:
            self.closed = of_pairs > 0.0

    def gather(self, values: np.ndarray) -> np.ndarray:
        """Return values (2, p, ...) at both ends from those at owned nodes (owned, ...). Collective."""
        values = np.asarray(values, dtype=float)
        data = values[self.local] if len(values) else np.zeros((*self.local.shape, *values.shape[1:]))
        if not self.partners.alone:
            rows = values[self.partners.rows]
            far = self.partners.bring(rows.reshape(len(rows), int(np.prod(values.shape[1:]))))
            away = ~self.mine
            data[away] = far[-1 - self.where[away]].reshape(-1, *values.shape[1:])
        return data

    def gather_of(self, at: np.ndarray, of_nodes: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """Return values (2, k, n) at both ends of pairs ``at`` (k,); ``of_nodes`` returns (m, n) at owned nodes (m,).

        If two ranks have a pair, both must request it, or neither; only these two communicate.
        """
        where = self.where[:, at]
        mine = where >= 0
        own = of_nodes(where[mine])
        data = np.empty((*where.shape, own.shape[1]))
        data[mine] = own
        cut = np.flatnonzero(mine[0] != mine[1])
        if len(cut):
            end = np.where(mine[0, cut], 0, 1)
            data[1 - end, cut] = swap(self.mesh.comm, self._owners[at[cut]], data[end, cut])
        return data

    def distances(self, ends: np.ndarray) -> np.ndarray:
        """Return n . (x_2 - x_1) (p,) [m] at positions (2, p, 3)."""
        return np.einsum("pi,pi->p", self.normals, ends[1] - ends[0])

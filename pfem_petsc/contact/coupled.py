"""Pairs that share nodes, or whose nodes walls stop too, in explicit steps with lumped mass.

Each group of connected pairs is one small problem: find the positions nearest to the free ones, in the distance
k |x - x_free|^2, that satisfy the group's pairs and the walls of its nodes. With the gradients of these constraints as
rows of N, the multipliers solve

    0 <= lambda   complementary to   N K^-1 N^T lambda + (values at the free positions) >= 0,

by the dual active-set method of Goldfarb and Idnani (:mod:`~pfem_petsc.contact.complementarity`). All ranks that own a
node of a group have the whole group and solve the same problem. Only the forces of the pairs are used; the subsequent
projection onto walls determines the forces of the walls.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..errors import SimulationFailure
from .complementarity import complementary, solve_groups
from .pair_loops import broken_pairs
from .projection import project
from .row_loops import free_positions, free_stiffness, leaving_nodes
from .search import near_planes

if TYPE_CHECKING:
    from .contact import Contact
    from .pairs import ContactPairs

__all__ = ["CoupledPairs", "complementary"]

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

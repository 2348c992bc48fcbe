"""Contact between bodies: pairs of nodes that cannot pass each other along a direction.

A pair bounds the relative coordinate: n . (x_second - x_first) >= gap. In an explicit step with lumped mass a pair
whose free positions x violate it is a problem of two nodes of stiffness k_1 and k_2 with the exact solution

    lambda = (gap - n . (x_2 - x_1)) / (1/k_1 + 1/k_2),   x_1 -= lambda n / k_1,   x_2 += lambda n / k_2,

where prescribed components do not move. Pairs are independent of each other unless they share nodes or walls stop their
nodes too; see :mod:`pfem_petsc.contact.coupled`. A rank has the pairs of its own nodes. If another rank owns the other
node, both ranks have the pair, exchange the values of their nodes, and compute the same force. For implicit steps see
:mod:`pfem_petsc.contact.pair_coordinates`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..mesh.exchange import swap
from ..parallel.agreement import agreed
from .coupled import CoupledPairs
from .fixed_rows import FixedRows, make_rows
from .pair_loops import (
    compliances,
    leaving_rows,
    move_nodes,
    needed_forces,
    part_nodes,
    pressed_nodes,
    push_nodes,
    table_forces,
)
from .pair_search import find_pairs

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..mesh.distribution import DistributedMesh
    from .contact import Contact

__all__ = ["ContactPairs"]


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

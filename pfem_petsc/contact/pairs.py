"""Contact between bodies: pairs of nodes that cannot pass each other along a direction.

A pair bounds the relative coordinate: n . (x_second - x_first) >= gap. In an explicit step with lumped mass a pair
whose free positions x break it is a problem of two nodes of stiffness k_1 and k_2 with the exact solution

    lambda = (gap - n . (x_2 - x_1)) / (1/k_1 + 1/k_2),   x_1 -= lambda n / k_1,   x_2 += lambda n / k_2,

where components that supports prescribe do not give way. Where pairs share nodes, or walls stop these as well, see
:mod:`pfem_petsc.contact.coupled`; else pairs are independent of each other. The ends of a pair may be on two ranks: all
ranks know all pairs. For implicit steps see :mod:`pfem_petsc.contact.pair_coordinates`.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from mpi4py import MPI

from ..errors import InputError
from .coupled import CoupledPairs
from .matching import nearest_across

__all__ = ["ContactPairs"]


class ContactPairs:
    """All pairs of a case. Construction is collective.

    Attributes
    ----------
    names : of the tables; ``table`` (p,) says to which of them a pair belongs
    first, second : (p,) mesh numbers of the nodes
    normals, gaps : (p, 3), (p,) unit directions, and bounds on n . (x_second - x_first) [m]
    mine, local : (2, p) which ends this rank owns, and their owned local indices
    coupled : CoupledPairs
    free : (2, p, 3) 1.0 where a component of an end may move, 0.0 where a support prescribes it
    force : (p,) force of each pair in the last step, positive where it presses [N]; the same on all ranks
    """

    def __init__(self, case, nodes: dict[str, np.ndarray], mesh, fixed: np.ndarray, contact) -> None:
        self.source = case.source
        self.mesh = mesh
        self.names = [pair.name for pair in case.contact_pair]
        self.normals = np.empty((0, 3))
        self.gaps = np.empty(0)
        self.table = np.empty(0, dtype=np.int64)
        self.first = self.second = np.empty(0, dtype=np.int64)
        for index, pair in enumerate(case.contact_pair):
            normal = np.array(pair.direction) / np.linalg.norm(pair.direction)
            first, second = _match(pair, nodes, mesh, normal, f"{case.source}: contact_pair {pair.name!r}")
            self.first = np.append(self.first, first)
            self.second = np.append(self.second, second)
            self.normals = np.vstack([self.normals, np.tile(normal, (len(first), 1))])
            self.gaps = np.append(self.gaps, np.full(len(first), pair.gap))
            self.table = np.append(self.table, np.full(len(first), index))
        ids = mesh.node_ids[: mesh.n_owned]
        order = np.argsort(ids)
        ends = np.stack([self.first, self.second])
        if (self.first == self.second).any():
            itself = self.first[self.first == self.second][0]
            raise InputError(f"{case.source}: contact_pair: node {itself} is paired with itself")
        place = np.searchsorted(ids[order], ends)
        place = np.minimum(place, max(len(ids) - 1, 0))
        self.mine = (ids[order][place] == ends) if len(ids) else np.zeros(ends.shape, dtype=bool)
        self.local = order[place] if len(ids) else np.zeros(ends.shape, dtype=np.int64)
        self.free = np.zeros((*ends.shape, 3))
        self.free[self.mine] = np.where(fixed[self.local[self.mine]], 0.0, 1.0)
        mesh.comm.Allreduce(MPI.IN_PLACE, self.free)
        self._along = np.einsum("epi,pi->ep", self.free, self.normals**2)  # how far ends give way to their pairs
        self._ends = self.local[self.mine]
        self.coupled = CoupledPairs(self, contact)
        self.release()

    def check_scheme(self, on_its_own: bool, treatment: str) -> None:
        """Refuse what shared nodes and walls at pairs do not go with.

        Raises
        ------
        InputError
            On all ranks. ``on_its_own``: each node is solved on its own, by an explicit scheme with lumped mass.
        """
        key, coupled = f"{self.source}: contact_pair", self.coupled
        if coupled.shared.any() and not on_its_own:
            raise InputError(
                f"{key}: node {coupled.numbers[coupled.shared][0]} is in several pairs, which needs an explicit "
                "integrator with lumped mass"
            )
        if coupled.any and treatment != "scheme":
            which = coupled.shared | coupled.walled
            raise InputError(
                f"{key}: node {coupled.numbers[which][0]} is in several pairs, or a wall stops it as well, which needs "
                'contact.treatment = "scheme"'
            )
        walls = coupled.contact
        met = np.zeros(len(walls.names), dtype=np.int64)
        met += walls.members[coupled.here].any(axis=0)
        special = ~walls.flat | (walls.restitution > 0.0) | (walls.static_friction > 0.0) | walls.ties.tying
        if walls.motion.free is not None:
            special[walls.motion.free.at] = True
        self.sum(met)
        if (special & (met > 0)).any():
            name = walls.names[int(np.argmax(special & (met > 0)))]
            raise InputError(
                f"{key}: wall {name!r} stops nodes of pairs: such a wall must be flat, without mass, friction and "
                "restitution, and not tied; or give it a node_set without them"
            )

    def check_start(self, x: np.ndarray, length: float, source: str) -> None:
        """Refuse pairs that start beyond each other by more than rounding of the model's size [m]. Collective."""
        distance = self.distances(self.gather(x)) - self.gaps
        if len(distance) and distance.min() < -1e-12 * length:
            pair = int(np.argmin(distance))
            raise InputError(
                f"{source}: contact_pair {self.names[self.table[pair]]!r}: nodes {self.first[pair]} and "
                f"{self.second[pair]} start {-distance[pair]:.6g} m beyond each other; reverse the direction, which "
                "points from the first to the second, or move the mesh"
            )

    def explicit(
        self,
        predictor: np.ndarray,
        u: np.ndarray,
        stiffness: np.ndarray,
        contact: np.ndarray,
        time: float,
        tolerance: float,
    ) -> None:
        """Part the pairs that free positions, predictor + u, break; walls have their turn after them. Collective.

        Parameters
        ----------
        predictor, u : (owned, 3) [m]; u is changed
        stiffness : (owned,) force for a displacement of a node [N/m]
        contact : (owned, 3) forces on the nodes, added to [N]
        time : of the positions [s]
        tolerance : a pair broken by no more counts as kept, where walls stop its nodes as well [m]

        Raises
        ------
        SimulationFailure
            On all ranks, where pairs, walls and supports leave nodes no room.
        """
        if self.coupled.any:
            here = self.coupled.here
            x = predictor[here] + u[here]
            planes = self.coupled.planes(x, time)
            self.force = self.coupled.forces(x, stiffness[here], self.gaps, planes, tolerance)
            self._move(u, self.force, stiffness)
        else:
            self.force = self.part(predictor, u, stiffness)
        self.push(contact)

    def pressed(self) -> tuple[np.ndarray, np.ndarray]:
        """Owned nodes (k,) that pairs hold, and the directions (k, 3) of their pairs."""
        pressed = self.mine & (self.force > 0.0)
        return self.local[pressed], np.broadcast_to(self.normals, (2, *self.normals.shape))[pressed]

    def release(self) -> None:
        """No pair presses."""
        self.force = np.zeros(len(self.table))

    def part(self, predictor: np.ndarray, u: np.ndarray, stiffness: np.ndarray) -> np.ndarray:
        """Change u (owned, 3) [m] so that predictor + u keeps all pairs; the pairs' forces (p,) [N]. Collective."""
        x = predictor[self._ends] + u[self._ends]
        force = np.maximum(self._needed(x, stiffness, self.gaps), 0.0)
        self._move(u, force, stiffness)
        return force

    def together(
        self, values: np.ndarray, mass: np.ndarray, rates: np.ndarray | float = 0.0, which: np.ndarray | None = None
    ) -> np.ndarray:
        """Velocities or accelerations (owned, 3) at which pairs ``which`` (p,) part at ``rates`` (p,); default: those
        that are pressed. Momentum is kept. Collective."""
        same, which = values.copy(), self.force > 0.0 if which is None else which
        self._move(same, self._needed(values[self._ends], mass, np.where(which, rates, -np.inf)), mass)
        return same

    def resting(self, x: np.ndarray, v: np.ndarray, slack: float, still: float) -> np.ndarray:
        """(p,) bool: pairs of nodes at (owned, 3) that are closed within a slack [m] and do not part or meet faster
        than ``still`` [m/s]. Collective."""
        ends = self.gather(np.concatenate([x, v], axis=1))
        closed = np.abs(self.distances(ends[:, :, :3]) - self.gaps) <= slack
        return closed & (np.abs(self.distances(ends[:, :, 3:])) <= still)

    def rest(self, a: np.ndarray, mass: np.ndarray, closed: np.ndarray, resting: np.ndarray) -> np.ndarray:
        """Set the forces that closed pairs (p,) need for accelerations (owned, 3) that do not bring them nearer.

        ``resting`` (owned, walls): nodes that walls do not let go either. Gives the pairs' forces (owned, 3) [N] on
        components that are free. Collective.
        """
        least = np.where(closed, 0.0, -np.inf)
        if self.coupled.any:
            state, here = self.coupled.contact.state, self.coupled.here
            normals, _ = self.coupled.planes(state.position[here], state.time)
            planes = normals, np.where(resting[here], 0.0, -np.inf)
            largest = self.mesh.comm.allreduce(float(np.abs(a).max(initial=0.0)), op=MPI.MAX)
            self.force = self.coupled.forces(a[here], mass[here], least, planes, 1e-13 * largest)
        else:
            self.force = np.maximum(self._needed(a[self._ends], mass, least), 0.0)
        change = np.zeros_like(a)
        self._move(change, self.force, np.ones_like(mass))
        return change

    def reduced_mass(self, mass: np.ndarray) -> np.ndarray:
        """1/(1/m_1 + 1/m_2) (p,) [kg] along the directions, from those of owned nodes (owned,). Collective."""
        gives = (self._along / self.gather(mass)).sum(axis=0)
        return 1.0 / np.maximum(gives, 1e-300)

    def keep(self, values: np.ndarray, of_pairs: np.ndarray) -> None:
        """Put values (p,) of pressed pairs into those of owned nodes (owned,), at the second ends."""
        here = self.mine[1] & (self.force > 0.0)
        values[self.local[1, here]] = of_pairs[here]

    def push(self, contact: np.ndarray, factor: float = 1.0) -> None:
        """Add the pairs' forces, times a factor, to those on the nodes (owned, 3) [N]."""
        for _, _, at, push in self._pushes(factor * self.force):
            np.add.at(contact, at, push)

    def _needed(self, x: np.ndarray, stiffness: np.ndarray, least: np.ndarray) -> np.ndarray:
        """Forces (p,) on the ends here at (k, 3) that make the distances ``least`` (p,), none where that is -inf."""
        data = np.zeros((*self.mine.shape, 4))
        data[self.mine, :3] = x
        data[self.mine, 3] = 1.0 / stiffness[self._ends]
        self.sum(data)
        soft = (data[:, :, 3] * self._along).sum(axis=0)
        usable = (soft > 0.0) & (least > -np.inf)
        short = np.where(usable, least, 0.0) - self.distances(data[:, :, :3])
        return np.where(usable, short / np.maximum(soft, 1e-300), 0.0)

    def _move(self, u: np.ndarray, force: np.ndarray, stiffness: np.ndarray) -> None:
        for end, here, at, push in self._pushes(force):
            np.add.at(u, at, push * self.free[end, here] / stiffness[at, None])

    def _pushes(self, force: np.ndarray) -> Iterator[tuple[int, np.ndarray, np.ndarray, np.ndarray]]:
        """Of both ends: end, (p,) pairs whose force acts on it here, nodes (k,), forces (k, 3) [N]."""
        if not force.any():
            return
        for end, sign in ((0, -1.0), (1, 1.0)):
            here = self.mine[end] & (force != 0.0)
            yield end, here, self.local[end, here], sign * force[here, None] * self.normals[here]

    def totals(self) -> dict[str, np.ndarray]:
        """Name of each table to its pairs' force on the second nodes (3,) [N], in the last step."""
        forces = self.force[:, None] * self.normals
        return {name: forces[self.table == k].sum(axis=0) for k, name in enumerate(self.names)}

    def gather(self, values: np.ndarray) -> np.ndarray:
        """Values (2, p, ...) of both ends from those of owned nodes (owned, ...), on all ranks. Collective."""
        data = np.zeros((*self.mine.shape, *values.shape[1:]))
        data[self.mine] = values[self.local[self.mine]]
        return self.sum(data)

    def sum(self, data: np.ndarray) -> np.ndarray:
        """The sum over ranks, in place: what one rank has set, all know. Collective."""
        if self.mesh.comm.size > 1:
            self.mesh.comm.Allreduce(MPI.IN_PLACE, data)
        return data

    def distances(self, ends: np.ndarray) -> np.ndarray:
        """n . (x_2 - x_1) (p,) [m] of positions (2, p, 3)."""
        return np.einsum("pi,pi->p", self.normals, ends[1] - ends[0])


def _match(pair, nodes, mesh, normal: np.ndarray, key: str) -> tuple[np.ndarray, np.ndarray]:
    """Mesh numbers of a table's pairs: each second node with the first one nearest to it across the direction."""
    found = []
    for name in (pair.first, pair.second):
        local = nodes[name]
        parts = mesh.comm.allgather((mesh.node_ids[local], mesh.points[local]))
        ids = np.concatenate([part[0] for part in parts])
        order = np.argsort(ids)
        points = np.concatenate([part[1] for part in parts])[order]
        found.append((ids[order], points))
    (first, here), (second, there) = found
    if len(first) != len(second):
        raise InputError(f"{key}: first has {len(first)} nodes and second {len(second)}: they cannot be paired")
    nearest = nearest_across(here, there, normal) if len(first) else np.empty(0, dtype=np.int64)
    if len(np.unique(nearest)) < len(nearest):
        raise InputError(f"{key}: two nodes of second are nearest to the same node of first, seen along the direction")
    return first[nearest], second

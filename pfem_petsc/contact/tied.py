"""Nodes tied permanently to walls with ``tied = true``.

In the step in which a node reaches such a wall it is stopped along the normal, as by any wall. From then on its
position relative to the wall is constant in all three directions, whatever the sign of the force. Prescribed components
still follow the supports; if these move a node through its wall, the run ends. Ties are part of the state: ``tied_to``
(owned,) is the index of the wall plus one, 0 if there is none, and ``tied_at`` (owned, 3) the position on the wall at
rest [m].
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..errors import SimulationFailure
from ..parallel.agreement import agreed
from ..tolerances import BEYOND
from .node_walls import held_by_supports

if TYPE_CHECKING:
    from .frames import NodalFrames
    from .node_walls import NodeWalls
    from .walls.base import WallKeys

FreshTies = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Nodes (k,) tied in a step, their walls (k,), and the walls' normals there (k, 3)."""


class Ties:
    """The tied nodes of this rank; the state keeps nothing if no wall has ``tied = true``.

    Attributes
    ----------
    any : whether the case has walls with ``tied = true``
    tying : (slots,) bool
    nobody : empty arrays of nodes, walls and vectors
    """

    nobody: FreshTies = (np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64), np.empty((0, 3)))

    def __init__(self, contact: NodeWalls, walls: Sequence[WallKeys]) -> None:
        self.contact = contact
        self.tying = np.array([wall.tied for wall in walls], dtype=bool)[contact.wall_of]
        self.any = bool(self.tying.any())
        self._nowhere = np.zeros(contact.mesh.n_owned if not self.any else 0, dtype=bool)
        self._nowhere.flags.writeable = False

    @property
    def held(self) -> np.ndarray:
        """(owned,) bool: nodes that are tied."""
        return self._memory()[0] > 0 if self.any else self._nowhere

    def walls(self, nodes: np.ndarray) -> np.ndarray:
        """Return the walls (m,) to which nodes (m,) are tied."""
        return self._memory()[0][nodes] - 1

    def nodes(self) -> tuple[np.ndarray, np.ndarray]:
        """Return tied nodes (m,), ascending, and their walls (m,)."""
        tied_to, _ = self._memory()
        nodes = np.flatnonzero(tied_to)
        return nodes, tied_to[nodes] - 1

    def targets(self, time: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return tied nodes (m,), their walls (m,), and their positions at a time [s] (m, 3) [m]."""
        nodes, walls = self.nodes()
        return nodes, walls, self.contact.motion.poses(time).carried(walls, self._memory()[1][nodes])

    def hold(self, x: np.ndarray, stiffness: np.ndarray, time: float) -> tuple[np.ndarray, ...]:
        """Return tied nodes (m,) in an explicit step, their walls (m,), positions and forces (m, 3) [m], [N].

        Parameters
        ----------
        x : (owned, 3) free positions at ``time`` [m]
        stiffness : (owned,) force for a displacement of the node [N/m]

        Raises
        ------
        SimulationFailure
            On this rank, if a node was moved through another wall.
        """
        nodes, walls, places = self.targets(time)
        places = np.where(self.contact.fixed[nodes], x[nodes], places)
        self.check(nodes, walls, places, time)
        return nodes, walls, places, stiffness[nodes, None] * (places - x[nodes])

    def pin(self, frames: NodalFrames, x: np.ndarray, time: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Fix the tied nodes of an implicit step in their frames. Collective.

        ``x`` (owned, 3) contains the prescribed components at ``time`` [m].

        Returns
        -------
        (indices among the frames (m,), walls (m,), positions at ``time`` (m, 3) [m])

        Raises
        ------
        SimulationFailure
            On all ranks, if a node was moved through another wall.
        """
        if not self.any:
            return self.nobody
        nodes, walls, places = self.targets(time)
        with agreed(self.contact.mesh.comm):
            self.check(nodes, walls, np.where(self.contact.fixed[nodes], x[nodes], places), time)
        at = np.searchsorted(frames.nodes, nodes)
        frames.pin(at, places, ~self.contact.fixed[nodes])
        return at, walls, places

    def check(self, nodes: np.ndarray, walls: np.ndarray, places: np.ndarray, time: float) -> None:
        """Check that tied nodes at (m, 3) are not moved through walls, their own (m,) included if supports move them.

        Raises
        ------
        SimulationFailure
            On this rank.
        """
        contact = self.contact
        partly = contact.fixed[nodes].any(axis=1)
        if len(contact.wall_of) == 1 and not partly.any():
            return
        partly &= ~np.isin(walls, contact.motion.bodies.at)  # their positions may be trial values
        if len(nodes) == 0:
            return
        poses = contact.motion.poses(time)
        applicable = contact.applicable(nodes, places, poses)
        applicable[contact.wall_of == walls[:, None]] = np.repeat(
            partly, (contact.wall_of == walls[:, None]).sum(axis=1)
        )
        normals, gaps = contact.distances(applicable, places, poses)
        gaps[held_by_supports(contact.fixed[nodes][:, None, :], normals)] = np.inf
        node, slot = np.unravel_index(np.argmin(gaps), gaps.shape)
        depth, other = -gaps[node, slot], contact.wall_of[slot]
        if depth > BEYOND * contact.size and other == walls[node]:
            raise SimulationFailure(
                f"node {contact.mesh.node_ids[nodes[node]]} is tied to wall {contact.names[other]!r} and its supports "
                f"move it {depth:.3g} m beyond the wall; free these components, move the wall with the "
                "supports, or do not tie the node"
            )
        if depth > BEYOND * contact.size:
            raise SimulationFailure(
                f"node {contact.mesh.node_ids[nodes[node]]}, tied to wall {contact.names[walls[node]]!r}, is moved "
                f"{depth:.3g} m beyond wall {contact.names[other]!r}; keep the walls "
                "apart, or name the nodes that they stop with 'node_set'"
            )

    def take(self, nodes: np.ndarray, touching: np.ndarray, places: np.ndarray, time: float) -> FreshTies:
        """Tie nodes (m,) at (m, 3) that touch (m, slots) walls with ``tied = true``, to the first of several.

        Returns the newly tied nodes (k,), their walls (k,), and the walls' normals there (k, 3).
        """
        if not self.any:
            return self.nobody
        tied_to, tied_at = self._memory()
        fresh = touching & self.tying & (tied_to[nodes] == 0)[:, None]
        met = fresh.any(axis=1)
        walls, poses = self.contact.wall_of[fresh[met].argmax(axis=1)], self.contact.motion.poses(time)
        tied_to[nodes[met]] = walls + 1
        normals = np.zeros((len(walls), 3))
        for k in np.unique(walls):
            own = poses.rest(k, places[met][walls == k])
            tied_at[nodes[met][walls == k]] = own
            normals[walls == k] = poses.turned(k, self.contact.walls[k].planes(own)[0])
        return nodes[met], walls, normals

    def damp_velocity(
        self, nodes: np.ndarray, walls: np.ndarray, normals: np.ndarray, v: np.ndarray, time: float, h: float
    ) -> None:
        """Tie nodes where they come to rest on their walls, for schemes with x1 - x0 = h (v0 + v1)/2.

        If such a node were fixed at the position of first contact, its velocity relative to the wall would be reversed
        in every step. It vanishes if the node is fixed half a step further along that velocity. A node that still
        approaches the wall is stopped once more before it is tied.

        Parameters
        ----------
        nodes, walls, normals : results of :meth:`take`
        v : (owned, 3) velocities [m/s]
        time, h : of the walls, and step [s]
        """
        if not self.any:
            return
        tied_to, tied_at = self._memory()
        poses = self.contact.motion.poses(time)
        places = poses.carried(walls, tied_at[nodes])
        relative = v[nodes] - self.contact.motion.rates_at(places, time)[np.arange(len(nodes)), walls]
        later = np.einsum("ki,ki->k", relative, normals) < -1e-9 * np.linalg.norm(relative, axis=1)
        tied_to[nodes[later]] = 0
        along = np.einsum("mji,mj->mi", poses.turns[walls], relative) if len(poses.turns) else relative
        tied_at[nodes] += 0.5 * h * along
        tied_at[nodes[later]] = 0.0

    def _memory(self) -> tuple[np.ndarray, np.ndarray]:
        memory, owned = self.contact.state.memory, self.contact.mesh.n_owned
        if "tied_to" not in memory:
            memory["tied_to"], memory["tied_at"] = np.zeros(owned, dtype=np.int64), np.zeros((owned, 3))
        return memory["tied_to"], memory["tied_at"]

"""Nodes that walls with ``tied = true`` hold for good.

In the step in which a node meets such a wall it is stopped as by any wall, along the normal; from then on its position
relative to the wall is the one of that moment, in all three directions and whatever the sign of the force. Components
that supports prescribe stay the supports'; where these carry a node through its wall the run ends. What is tied is part
of the state: ``tied_to`` (owned,) is the wall's index plus one, 0 where there is none, and ``tied_at`` (owned, 3) the
place relative to the wall [m].
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..errors import SimulationFailure
from ..parallel.agreement import agreed
from ..tolerances import BEYOND
from .free_parts import held_by_supports

if TYPE_CHECKING:
    from .contact import Contact
    from .frames import NodalFrames
    from .walls.base import WallKeys

__all__ = ["FreshTies", "NoTies", "Ties"]

FreshTies = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Nodes (k,) tied in a step, their walls (k,), and the walls' normals there (k, 3)."""


class Ties:
    """The tied nodes of this rank.

    Attributes
    ----------
    any : whether the case has walls that tie
    tying : (walls,) bool
    nobody : no nodes, no walls, and vectors of none of them
    """

    nobody: FreshTies = (np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64), np.empty((0, 3)))

    def __init__(self, contact: Contact, walls: Sequence[WallKeys]) -> None:
        self.contact = contact
        self.tying = np.array([wall.tied for wall in walls], dtype=bool)
        self.any = bool(self.tying.any())

    @property
    def held(self) -> np.ndarray:
        """(owned,) bool: nodes that are tied."""
        return self._memory()[0] > 0

    def walls(self, nodes: np.ndarray) -> np.ndarray:
        """Walls (m,) that tied nodes (m,) are tied to."""
        return self._memory()[0][nodes] - 1

    def nodes(self) -> tuple[np.ndarray, np.ndarray]:
        """Tied nodes (m,), ascending, and their walls (m,)."""
        tied_to, _ = self._memory()
        nodes = np.flatnonzero(tied_to)
        return nodes, tied_to[nodes] - 1

    def targets(self, time: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Tied nodes (m,), their walls (m,), and where these hold them at a time [s] (m, 3) [m]."""
        nodes, walls = self.nodes()
        return nodes, walls, self._memory()[1][nodes] + self.contact.motion.displacements(time)[walls]

    def hold(self, x: np.ndarray, stiffness: np.ndarray, time: float) -> tuple[np.ndarray, ...]:
        """Tied nodes (m,) of an explicit step, with their walls (m,), places and forces (m, 3) [m], [N].

        Parameters
        ----------
        x : (owned, 3) free positions at ``time`` [m]
        stiffness : (owned,) force for a displacement of the node [N/m]

        Raises
        ------
        SimulationFailure
            On this rank: a node was carried through another wall.
        """
        nodes, walls, places = self.targets(time)
        places = np.where(self.contact.fixed[nodes], x[nodes], places)
        self.check(nodes, walls, places, time)
        return nodes, walls, places, stiffness[nodes, None] * (places - x[nodes])

    def pin(self, frames: NodalFrames, x: np.ndarray, time: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Hold the tied nodes of an implicit step, of which there are frames. Collective.

        ``x`` (owned, 3) has the prescribed components at ``time`` [m].

        Returns
        -------
        (places among the frames (m,), walls (m,), places at ``time`` (m, 3) [m])

        Raises
        ------
        SimulationFailure
            On all ranks: a node was carried through another wall.
        """
        nodes, walls, places = self.targets(time)
        with agreed(self.contact.mesh.comm):
            self.check(nodes, walls, np.where(self.contact.fixed[nodes], x[nodes], places), time)
        at = np.searchsorted(frames.nodes, nodes)
        frames.pin(at, places, ~self.contact.fixed[nodes])
        return at, walls, places

    def check(self, nodes: np.ndarray, walls: np.ndarray, places: np.ndarray, time: float) -> None:
        """Refuse to carry nodes at (m, 3) through walls, their own (m,) among them where supports prescribe components.

        Raises
        ------
        SimulationFailure
            On this rank.
        """
        contact = self.contact
        partly = contact.fixed[nodes].any(axis=1)
        if len(contact.walls) == 1 and not partly.any():
            return
        partly &= ~np.isin(walls, contact.motion.bodies.at)  # whose place may be a trial
        if len(nodes) == 0:
            return
        displacements = contact.motion.displacements(time)
        applicable = contact.applicable(nodes, places, displacements)
        applicable[np.arange(len(nodes)), walls] = partly
        normals, offsets = contact.planes(applicable, places, displacements)
        gaps = np.einsum("mwi,mi->mw", normals, places) - offsets
        gaps[held_by_supports(contact.fixed[nodes][:, None, :], normals)] = np.inf
        node, other = np.unravel_index(np.argmin(gaps), gaps.shape)
        if gaps[node, other] < -BEYOND * contact.length and other == walls[node]:
            raise SimulationFailure(
                f"node {contact.mesh.node_ids[nodes[node]]} is tied to wall {contact.names[other]!r} and its supports "
                f"carry it {-gaps[node, other]:.3g} m beyond the wall; free these components, move the wall with the "
                "supports, or do not tie the node"
            )
        if gaps[node, other] < -BEYOND * contact.length:
            raise SimulationFailure(
                f"node {contact.mesh.node_ids[nodes[node]]}, tied to wall {contact.names[walls[node]]!r}, is carried "
                f"{-gaps[node, other]:.3g} m beyond wall {contact.names[other]!r}; keep the walls "
                "apart, or name the nodes that they concern with 'node_set'"
            )

    def take(self, nodes: np.ndarray, touching: np.ndarray, places: np.ndarray, time: float) -> FreshTies:
        """Tie nodes (m,) at (m, 3) that touch (m, walls) walls that tie; of several the first.

        Gives the nodes that are now tied (k,), their walls (k,), and the walls' normals there (k, 3).
        """
        tied_to, tied_at = self._memory()
        fresh = touching & self.tying & (tied_to[nodes] == 0)[:, None]
        met = fresh.any(axis=1)
        walls = fresh[met].argmax(axis=1)
        tied_to[nodes[met]] = walls + 1
        own = places[met] - self.contact.motion.displacements(time)[walls]
        tied_at[nodes[met]] = own
        normals = np.zeros((len(walls), 3))
        for k in np.unique(walls):
            normals[walls == k] = self.contact.walls[k].planes(own[walls == k])[0]
        return nodes[met], walls, normals

    def calm(
        self, nodes: np.ndarray, walls: np.ndarray, normals: np.ndarray, v: np.ndarray, rates: np.ndarray, h: float
    ) -> None:
        """Tie nodes where they come to rest on their walls, for schemes with x1 - x0 = h (v0 + v1)/2.

        Held at the place of the touch, such a node would have its velocity relative to the wall turned round in every
        step, for ever. Half a step further on along that velocity it has lost it. A node that still approaches the wall
        is stopped once more before it is tied.

        Parameters
        ----------
        nodes, walls, normals : as :meth:`take` gives them
        v : (owned, 3) velocities [m/s]; rates : (walls, 3) those of the walls
        h : step [s]
        """
        tied_to, tied_at = self._memory()
        relative = v[nodes] - rates[walls]
        away = np.einsum("ki,ki->k", relative, normals)
        later = away < -1e-9 * np.linalg.norm(relative, axis=1)
        tied_to[nodes[later]] = 0
        tied_at[nodes] += 0.5 * h * relative
        tied_at[nodes[later]] = 0.0

    def _memory(self) -> tuple[np.ndarray, np.ndarray]:
        memory, owned = self.contact.state.memory, self.contact.mesh.n_owned
        if "tied_to" not in memory:
            memory["tied_to"], memory["tied_at"] = np.zeros(owned, dtype=np.int64), np.zeros((owned, 3))
        return memory["tied_to"], memory["tied_at"]


class NoTies(Ties):
    """Stands for :class:`Ties` where no wall ties: keeps nothing in the state."""

    def __init__(self, contact: Contact, walls: Sequence[WallKeys]) -> None:
        super().__init__(contact, walls)
        self._nowhere = np.zeros(contact.mesh.n_owned, dtype=bool)
        self._nowhere.flags.writeable = False

    @property
    def held(self) -> np.ndarray:
        """See :class:`Ties`."""
        return self._nowhere

    def pin(self, frames: NodalFrames, x: np.ndarray, time: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See :class:`Ties`; not collective."""
        return self.nobody

    def take(self, nodes: np.ndarray, touching: np.ndarray, places: np.ndarray, time: float) -> FreshTies:
        """See :class:`Ties`."""
        return self.nobody

    def calm(
        self, nodes: np.ndarray, walls: np.ndarray, normals: np.ndarray, v: np.ndarray, rates: np.ndarray, h: float
    ) -> None:
        """See :class:`Ties`."""

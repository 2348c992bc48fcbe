"""Forces of walls on the nodes of a rank, their free directions, and the log of contact times and releases."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from mpi4py import MPI

from ..mechanics.compiled import kernel
from ..tolerances import FREE_PART


@dataclass
class WallForces:
    """Sums over this rank's nodes for each wall, and these nodes.

    Attributes
    ----------
    force : (walls, 3) on the truss [N]
    contacts : (walls,) nodes in contact
    moment : (walls, 3) of the force about the origin [N m]
    nodes : (m,) owned nodes near walls
    touching : (m, walls) bool, walls that they touch
    places : (m, 3) their positions [m]
    friction : energy that friction on these nodes dissipates in the step solved for [J]
    sums : names of the attributes that are sums
    """

    sums: ClassVar[tuple[str, ...]] = ("force", "contacts", "moment")

    force: np.ndarray
    contacts: np.ndarray
    moment: np.ndarray
    nodes: np.ndarray
    touching: np.ndarray
    places: np.ndarray
    friction: float = 0.0

    @classmethod
    def none(cls, walls: int) -> Self:
        """Return zero forces, shared by all steps without contact; the sums are read-only."""
        none = cls(
            np.zeros((walls, 3)),
            np.zeros(walls, dtype=np.int64),
            np.zeros((walls, 3)),
            np.empty(0, dtype=np.int64),
            np.empty((0, walls), dtype=bool),
            np.empty((0, 3)),
        )
        for name in none.sums:
            getattr(none, name).flags.writeable = False
        return none


def free_squares(fixed: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return squared lengths (...,) of unit normals (..., 3) restricted to components that are not ``fixed``."""
    return (np.where(fixed, 0.0, normals) ** 2).sum(axis=-1)


def held_by_supports(fixed: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return (...,) bool: only supports determine the motion of a node along these unit normals."""
    return free_squares(fixed, normals) <= FREE_PART


_PENDING = 4096  # steps whose contacts are buffered before ranks combine them


@kernel
def compare_contacts(touching, before, nodes, now, present, releases):
    """Update ``touching`` (owned, w) from the nodes that touched ``before`` to the walls that ``nodes`` (m,) touch
    ``now`` (m, w), and count ``releases`` (w,).

    ``present`` (owned,) bool is workspace, all False. Returns the number of changes and the nodes that touch walls.
    """
    walls = touching.shape[1]
    changes = 0
    count = 0
    after = np.empty_like(nodes)
    for j in range(len(nodes)):
        i = nodes[j]
        present[i] = True
        any_wall = False
        for k in range(walls):
            if touching[i, k] != now[j, k]:
                changes += 1
                if touching[i, k]:
                    releases[k] += 1
                touching[i, k] = now[j, k]
            any_wall = any_wall or now[j, k]
        if any_wall:
            after[count] = i
            count += 1
    for i in before:
        if not present[i]:
            for k in range(walls):
                if touching[i, k]:
                    changes += 1
                    releases[k] += 1
                    touching[i, k] = False
    for i in nodes:
        present[i] = False
    return changes, after[:count].copy()


class ContactLog:
    """Sums over the steps of a run.

    Attributes
    ----------
    touching : (owned, walls) bool, contacts after the last step
    releases : (walls,) number of releases of this rank's nodes from each wall
    changes : number of contacts of this rank that closed or opened since the last row of the history
    last : (m,) nodes that touch any wall after the last step
    present : (owned,) bool, workspace of :func:`compare_contacts`
    time : (walls,) time during which any node of the model touched each wall [s]; the same on all ranks
    """

    def __init__(self, n_owned: int, n_walls: int) -> None:
        self.touching = np.zeros((n_owned, n_walls), dtype=bool)
        self.releases = np.zeros(n_walls, dtype=np.int64)
        self.changes = 0
        self.time = np.zeros(n_walls)
        self.last = np.empty(0, dtype=np.int64)
        self.present = np.zeros(n_owned, dtype=bool)
        self._pending = 0
        self._steps = np.empty(_PENDING)
        self._flags = np.empty((_PENDING, n_walls), dtype=np.uint8)

    def book(self, walls: WallForces, step: float, comm: MPI.Comm) -> None:
        """Record the contacts of a step of size ``step`` [s]. Collective whenever the buffer is full."""
        self.note(walls.contacts > 0, step, comm)
        if len(walls.nodes) == 0 and len(self.last) == 0:
            return
        changes, self.last = compare_contacts(
            self.touching, self.last, walls.nodes, walls.touching, self.present, self.releases
        )
        self.changes += changes

    def note(self, touched: np.ndarray, step: float, comm: MPI.Comm) -> None:
        """Record the walls (walls,) bool that were touched in a step. Collective whenever the buffer is full."""
        if self._pending >= _PENDING:
            self.meet(comm)
        self._steps[self._pending] = step
        self._flags[self._pending] = touched
        self._pending += 1

    def meet(self, comm: MPI.Comm, contacts: np.ndarray | None = None) -> None:
        """Update the contact times on all ranks. Collective.

        ``contacts`` (walls,): number of nodes of all ranks in contact after the last step, if known.
        """
        n, self._pending = self._pending, 0
        if n == 1 and contacts is not None:
            self.time += self._steps[0] * (contacts > 0)
        elif n and len(self.time):
            flags = self._flags[:n]
            if comm.size > 1:
                comm.Allreduce(MPI.IN_PLACE, flags, op=MPI.MAX)
            self.time += self._steps[:n] @ flags

    def share(self) -> dict[str, Any]:
        """Return this rank's sums for a checkpoint."""
        return {
            "wall_releases": self.releases.tolist(),
            "contact_changes": self.changes,
        }

    def times(self, comm: MPI.Comm) -> dict[str, Any]:
        """Return contact times, and the steps not yet added to them, for a checkpoint. Collective.

        Only :meth:`meet` adds them: other partial sums would round differently.
        """
        flags = self._flags[: self._pending].copy()
        comm.Allreduce(MPI.IN_PLACE, flags, op=MPI.MAX)
        return {"sum": self.time.tolist(), "steps": self._steps[: self._pending].tolist(), "flags": flags.tolist()}

    def load_state(self, share: dict[str, Any], times: dict[str, Any], touching: np.ndarray) -> None:
        """Restore this rank's sums, the contact times and the contacts from a checkpoint."""
        self.releases[:] = np.array(share["wall_releases"], dtype=np.int64)
        self.changes = int(share["contact_changes"])
        self.time[:] = times["sum"]
        self._pending = n = len(times["steps"])
        self._steps[:n] = times["steps"]
        self._flags[:n] = np.array(times["flags"], dtype=np.uint8).reshape(n, len(self.time))
        self.touching = touching
        self.last = np.flatnonzero(touching.any(axis=1))

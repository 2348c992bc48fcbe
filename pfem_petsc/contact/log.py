"""What contact did so far: impulses, contact times, releases and changes of the active set."""

from __future__ import annotations

from typing import Any

import numpy as np
from mpi4py import MPI

__all__ = ["ContactLog"]


class ContactLog:
    """Sums over the steps of a run.

    Attributes
    ----------
    touching : (owned, walls) bool, who touches what after the last step
    impulse : (walls, 3) of each wall's force on this rank's nodes since the start [N s]
    releases : (walls,) how often nodes of this rank let go of each wall
    changes : nodes and walls of this rank that met or parted since the last row of the history
    time : (walls,) for how long any node of the model has touched each wall [s]; the same on all ranks
    """

    def __init__(self, n_owned: int, n_walls: int) -> None:
        self.touching = np.zeros((n_owned, n_walls), dtype=bool)
        self.impulse = np.zeros((n_walls, 3))
        self.releases = np.zeros(n_walls, dtype=np.int64)
        self.changes = 0
        self.time = np.zeros(n_walls)
        self._before = np.empty(0, dtype=np.int64)
        self._steps: list[float] = []
        self._flags: list[np.ndarray] = []

    def book(self, walls, step: float) -> None:
        """Book the forces of a step of so many seconds."""
        self._steps.append(step)
        self._flags.append(walls.contacts > 0)
        if len(walls.nodes) == 0 and len(self._before) == 0:
            return
        self.impulse += step * walls.force
        changed = np.union1d(self._before, walls.nodes)
        earlier = self.touching[changed]
        self.touching[self._before] = False
        self.touching[walls.nodes] = walls.touching
        now = self.touching[changed]
        self.releases += (earlier & ~now).sum(axis=0)
        self.changes += int((earlier != now).sum())
        self._before = walls.nodes[walls.touching.any(axis=1)]

    def meet(self, comm: MPI.Comm) -> None:
        """Bring the contact times up to date on all ranks. Collective."""
        if self._steps and len(self.time):
            flags = np.array(self._flags, dtype=np.uint8)
            comm.Allreduce(MPI.IN_PLACE, flags, op=MPI.MAX)
            self.time += np.array(self._steps) @ flags
        self._steps, self._flags = [], []

    def share(self) -> dict[str, Any]:
        """This rank's sums, for a checkpoint."""
        return {
            "wall_impulse": self.impulse.tolist(),
            "wall_releases": self.releases.tolist(),
            "contact_changes": self.changes,
        }

    def times(self, comm: MPI.Comm) -> dict[str, Any]:
        """Contact times, and the steps not yet added to them, for a checkpoint. Collective.

        They are added by :meth:`meet` only: other partial sums would end in other last digits.
        """
        flags = np.array(self._flags, dtype=np.uint8).reshape(len(self._steps), len(self.time))
        comm.Allreduce(MPI.IN_PLACE, flags, op=MPI.MAX)
        return {"sum": self.time.tolist(), "steps": list(self._steps), "flags": flags.tolist()}

    def put_back(self, share: dict[str, Any], times: dict[str, Any], touching: np.ndarray) -> None:
        """Take this rank's sums, the contact times and who touches what from a checkpoint."""
        self.impulse[:] = np.array(share["wall_impulse"], dtype=float).reshape(self.impulse.shape)
        self.releases[:] = np.array(share["wall_releases"], dtype=np.int64)
        self.changes = int(share["contact_changes"])
        self.time[:] = times["sum"]
        self._steps = list(times["steps"])
        self._flags = [np.array(flags, dtype=np.uint8) for flags in times["flags"]]
        self.touching = touching
        self._before = np.flatnonzero(touching.any(axis=1))

"""Walls and the nodes they stop: who can touch what, and the forces that result."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import InputError, SimulationFailure
from ..registry import lookup
from .frames import NodalFrames, build_frames
from .projection import project

__all__ = ["Contact", "WallForces"]


@dataclass
class WallForces:
    """Per wall: force on the truss [N] (walls, 3) and nodes in contact (walls,), sums over this rank's nodes."""

    force: np.ndarray
    contacts: np.ndarray


class Contact:
    """All walls of a case and this rank's nodes.

    Attributes
    ----------
    names : of the walls, in the case's order
    any : whether the case has walls
    """

    def __init__(self, case, nodes: dict[str, np.ndarray], mesh, fixed: np.ndarray) -> None:
        self.source = case.source
        self.mesh = mesh
        self.fixed = fixed
        self.names = [wall.name for wall in case.wall]
        self.any = bool(case.wall)
        self.walls = [
            lookup("pfem_petsc.contact.walls", wall.type, f"{case.source}: wall.type").Wall(wall) for wall in case.wall
        ]
        self.members = np.ones((mesh.n_owned, len(self.walls)), dtype=bool)
        for k, wall in enumerate(case.wall):
            if wall.node_set is not None:
                self.members[:, k] = False
                self.members[nodes[wall.node_set], k] = True
        self.everyone = [wall.node_set is None for wall in case.wall]

    def none(self) -> WallForces:
        """No contact."""
        return WallForces(np.zeros((len(self.walls), 3)), np.zeros(len(self.walls), dtype=np.int64))

    def gaps(self, x: np.ndarray, time: float) -> np.ndarray:
        """Distances (owned, walls) [m] of positions (owned, 3) from the walls, infinite where a wall is no concern."""
        gaps = np.full((len(x), len(self.walls)), np.inf)
        for k, wall in enumerate(self.walls):
            normals, offsets = wall.planes(x, time)
            gaps[:, k] = np.einsum("ij,ij->i", normals, x) - offsets
            if not self.everyone[k]:
                gaps[~self.members[:, k], k] = np.inf
        return gaps

    def check_start(self, x: np.ndarray, length: float) -> None:
        """Refuse nodes that start beyond a wall by more than rounding of the model's size ``length`` [m]. Collective.

        Raises
        ------
        InputError
            On all ranks; names the wall, the deepest node and its depth.
        """
        if not self.any:
            return
        comm = self.mesh.comm
        gaps = self.gaps(x, 0.0)
        for k, name in enumerate(self.names):
            deepest, node, count = 0.0, -1, 0
            if len(gaps):
                at = int(np.argmin(gaps[:, k]))
                deepest, node = float(gaps[at, k]), int(self.mesh.node_ids[at])
                count = int((gaps[:, k] < -1e-12 * length).sum())
            depth, node = min(comm.allgather((deepest, node)))
            count = comm.allreduce(count)
            if count:
                raise InputError(
                    f"{self.source}: wall {name!r}: node {node} starts {-depth:.6g} m beyond the wall "
                    f"({count} node{'s' if count > 1 else ''} in all); move the wall or the mesh, turn the normal to the "
                    "allowed side, or name the nodes that it concerns with 'node_set'"
                )

    def _planes(self, nodes: np.ndarray, x: np.ndarray, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Planes (m, w, 3), (m, w) of some nodes at positions (m, 3); offset -inf where a wall is no concern."""
        normals = np.zeros((len(nodes), len(self.walls), 3))
        offsets = np.empty((len(nodes), len(self.walls)))
        for k, wall in enumerate(self.walls):
            normals[:, k], offsets[:, k] = wall.planes(x, time)
        offsets[~self.members[nodes]] = -np.inf
        return normals, offsets

    def explicit(self, x: np.ndarray, stiffness: np.ndarray, time: float, tolerance: float) -> tuple:
        """Project free positions (owned, 3), in place, onto what the walls allow.

        Parameters
        ----------
        x : (owned, 3) free positions at ``time`` [m]
        stiffness : (owned,) alpha m + eta c: force for a displacement of the node [N/m]
        tolerance : [m]

        Returns
        -------
        (nodes, correction (m, 3) [m], force (m, 3) [N] by the walls, WallForces)
        """
        gaps = self.gaps(x, time)
        nodes = np.flatnonzero((gaps < 0.0).any(axis=1))
        walls = self.none()
        if len(nodes) == 0:
            return nodes, np.empty((0, 3)), np.empty((0, 3)), walls
        free = x[nodes]
        normals, offsets = self._planes(nodes, free, time)
        moved = free.copy()
        multipliers = np.zeros(offsets.shape)
        stuck = project(moved, self.fixed[nodes], normals, offsets, tolerance, multipliers)
        if stuck >= 0:
            node = self.mesh.node_ids[nodes[stuck]]
            touched = [name for name, offset in zip(self.names, offsets[stuck], strict=True) if offset > -np.inf]
            raise SimulationFailure(
                f"no position of node {node} at time {time:.6g} s satisfies all walls ({', '.join(touched)}) and its "
                "supports; the walls leave it no room"
            )
        force = multipliers[:, :, None] * normals * stiffness[nodes][:, None, None]
        walls.force = force.sum(axis=0)
        walls.contacts = (multipliers > 0.0).sum(axis=0)
        x[nodes] = moved
        return nodes, moved - free, force.sum(axis=1), walls

    def frames(self, candidates: np.ndarray, x: np.ndarray, time: float) -> NodalFrames:
        """Coordinates and bounds of candidate nodes (owned local indices) from their planes at positions (owned, 3)."""
        at = x[candidates]
        normals, offsets = self._planes(candidates, at, time)
        gaps = np.einsum("iwk,ik->iw", normals, at) - offsets
        return build_frames(candidates, self.fixed[candidates], normals, offsets, gaps)

    def forces(self, frames: NodalFrames, residual: np.ndarray, active: np.ndarray) -> tuple[np.ndarray, WallForces]:
        """Forces of an implicit step from its residual on the active bounds.

        Parameters
        ----------
        frames : NodalFrames
        residual : (m, 3) residual of the frames' nodes in their coordinates [N]
        active : (m, 3) int8: -1 on the lower bound, +1 on the upper, 0 on none

        Returns
        -------
        force : (m, 3) by the walls on each node, in x [N]
        WallForces
        """
        walls = self.none()
        total = np.zeros((len(frames.nodes), 3))
        every = np.arange(len(frames.nodes))
        left = np.where(active != 0, residual, 0.0)
        for k in range(len(self.walls)):
            row = frames.rows[:, k]
            sign = frames.signs[:, k]
            safe = np.maximum(row, 0)
            touching = (row >= 0) & (active[every, safe] == -sign)
            strength = np.where(touching, left[every, safe], 0.0)
            left[every[touching], safe[touching]] = 0.0  # walls that share a bound: the first takes the force
            force = strength[:, None] * frames.basis[every, safe]
            total += force
            walls.force[k] = force.sum(axis=0)
            walls.contacts[k] = int((touching & (strength != 0.0)).sum())
        return total, walls

"""Walls and the nodes they stop: who can touch what, and the forces that result."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ..errors import InputError, SimulationFailure
from ..parallel.agreement import agreed
from ..registry import lookup
from .friction import add_friction
from .frames import NodalFrames, build_frames
from .log import ContactLog
from .motion import WallMotion
from .projection import project
from .search import near_planes

__all__ = ["Contact", "WallForces"]

_CURVED_ROUNDS = 100  # projections of an explicit step until tangent planes and positions agree
_ZERO = np.zeros(1)


@dataclass
class WallForces:
    """Per wall, sums over this rank's nodes, and these nodes.

    Attributes
    ----------
    force : (walls, 3) on the truss [N]
    contacts : (walls,) nodes in contact
    moment : (walls, 3) of the force about the origin [N m]
    nodes : (m,) owned nodes near walls
    touching : (m, walls) bool, what they touch
    places : (m, 3) where they are [m]
    sums : names of those that are sums
    """

    sums: ClassVar[tuple[str, ...]] = ("force", "contacts", "moment")

    force: np.ndarray
    contacts: np.ndarray
    moment: np.ndarray
    nodes: np.ndarray
    touching: np.ndarray
    places: np.ndarray


class Contact:
    """All walls of a case and this rank's nodes.

    Attributes
    ----------
    names : of the walls, in the case's order
    any : whether the case has walls
    moving : (walls,) bool
    normals : (walls, 3) of flat walls, zero for the others
    log : ContactLog
    restitution, friction, static_friction : (walls,); rough : whether any wall has friction
    state : of the nodes, for walls that must know where nodes come from; set by the stepper
    """

    def __init__(self, case, nodes: dict[str, np.ndarray], mesh, fixed: np.ndarray, parameters=None) -> None:
        walls = list(case.wall) if parameters is None else parameters
        self.source = case.source
        self.mesh = mesh
        self.fixed = fixed
        self.state = None
        self.names = [wall.name for wall in walls]
        self.any = bool(walls)
        self.walls = [
            lookup("pfem_petsc.contact.walls", wall.type, f"{case.source}: wall.type").Wall(wall) for wall in walls
        ]
        self.motion = WallMotion(walls)
        self.moving = self.motion.moving
        self.everyone = np.array([wall.node_set is None for wall in walls], dtype=bool)
        self.members = np.ones((mesh.n_owned, len(walls)), dtype=bool)
        for k, wall in enumerate(walls):
            if wall.node_set is not None:
                self.members[:, k] = False
                self.members[nodes[wall.node_set], k] = True
        self.log = ContactLog(mesh.n_owned, len(walls))
        self.friction = np.array([wall.friction for wall in walls], dtype=np.float64)
        static = [wall.friction if wall.static_friction is None else wall.static_friction for wall in walls]
        self.static_friction = np.array(static, dtype=np.float64)
        self.restitution = np.array([wall.restitution for wall in walls], dtype=np.float64)
        self.rough = bool(self.static_friction.any())
        self.flat = np.array([wall.flat for wall in self.walls], dtype=bool)
        self.partial = any(wall.partial for wall in self.walls)
        self.normals = np.zeros((len(walls), 3))
        self._offsets = np.zeros(len(walls))
        for k in np.flatnonzero(self.flat):
            self.normals[k], self._offsets[k] = self.walls[k].normal, self.walls[k].offset
        extent = np.ptp(mesh.points, axis=0).max() if len(mesh.points) else 0.0
        self.length = max(mesh.comm.allgather(float(extent)))

    def none(self) -> WallForces:
        """No contact."""
        n = len(self.walls)
        return WallForces(
            np.zeros((n, 3)),
            np.zeros(n, dtype=np.int64),
            np.zeros((n, 3)),
            np.empty(0, dtype=np.int64),
            np.empty((0, n), dtype=bool),
            np.empty((0, 3)),
        )

    def positions(self, time: float) -> np.ndarray:
        """Where the walls' centres are (walls, 3) [m]."""
        return np.array([wall.centre for wall in self.walls]).reshape(-1, 3) + self.motion.shifts(time)

    def gaps(self, x: np.ndarray, time: float, nodes: np.ndarray | None = None) -> np.ndarray:
        """Distances (m, walls) [m] of owned nodes at (m, 3) from the walls, infinite where a wall is no concern.

        ``nodes`` (m,) says which they are; default: all of them.
        """
        members = self.members if nodes is None else self.members[nodes]
        shifts = self.motion.shifts(time)
        gaps = np.full((len(x), len(self.walls)), np.inf)
        for k in range(len(self.walls)):
            gaps[:, k] = self.gap(k, x, shifts)
            if not self.everyone[k]:
                gaps[~members[:, k], k] = np.inf
        return gaps

    def gap(self, k: int, x: np.ndarray, shifts: np.ndarray) -> np.ndarray:
        """Distances (m,) [m] of positions (m, 3) from wall k."""
        normals, offsets = self.walls[k].planes(x - shifts[k])
        return np.einsum("ij,ij->i", normals, x - shifts[k]) - offsets

    def near(self, x: np.ndarray, shifts: np.ndarray, reach: np.ndarray = _ZERO) -> np.ndarray:
        """(owned,) bool: nodes at positions (owned, 3) within reach of a wall; (owned,) or (1,) [m], 0: beyond it."""
        near = np.zeros(len(x), dtype=bool)
        if self.flat.any():
            at = self.flat
            offsets = self._offsets[at] + np.einsum("ij,ij->i", self.normals[at], shifts[at])
            members = self.members if self.flat.all() else np.ascontiguousarray(self.members[:, at])
            near_planes(x, self.normals[at], offsets, self.everyone[at], members, reach, near)
        for k in np.flatnonzero(~self.flat):
            near |= (self.gap(k, x, shifts) < reach) & self.members[:, k]
        return near

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
        for k, wall in enumerate(self.walls):
            if wall.partial:  # nothing starts beyond a wall that nodes can pass by
                continue
            deepest, node, count = 0.0, -1, 0
            if len(gaps):
                at = int(np.argmin(gaps[:, k]))
                deepest, node = float(gaps[at, k]), int(self.mesh.node_ids[at])
                count = int((gaps[:, k] < -1e-12 * length).sum())
            depth, node = min(comm.allgather((deepest, node)))
            count = comm.allreduce(count)
            if count:
                raise InputError(
                    f"{self.source}: wall {self.names[k]!r}: node {node} starts {-depth:.6g} m beyond the wall "
                    f"({count} node{'s' if count > 1 else ''} in all); move the wall or the mesh, turn the normal to the "
                    "allowed side, name the nodes that it concerns with 'node_set', or let 'adjust = true' move the nodes"
                )

    def concerned(self, nodes: np.ndarray, x: np.ndarray, shifts: np.ndarray) -> np.ndarray:
        """(m, walls) bool: walls that can stop nodes on their way to positions (m, 3)."""
        concerned = self.members[nodes]
        if self.partial and self.state is not None:
            state = self.state
            before = state.position[nodes]
            earlier = self.motion.shifts(state.time)
            for k, wall in enumerate(self.walls):
                if wall.partial:
                    # a node that the wall held may be beyond it by what the scheme makes of the balance
                    held = state.contact[nodes] @ wall.normal > 0.0
                    slack = np.where(held, 0.1 * wall.half.min(), 1e-9 * self.length)
                    concerned[:, k] &= wall.stops(before - earlier[k], x - shifts[k], slack)
        return concerned

    def planes(self, concerned: np.ndarray, x: np.ndarray, shifts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Planes (m, w, 3), (m, w) at positions (m, 3); offset -inf where a wall is no concern."""
        normals = np.empty((len(x), len(self.walls), 3))
        offsets = np.empty((len(x), len(self.walls)))
        for k, wall in enumerate(self.walls):
            normals[:, k], offsets[:, k] = wall.planes(x - shifts[k])
            offsets[:, k] += normals[:, k] @ shifts[k]
        offsets[~concerned] = -np.inf
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
        if self.motion.free is not None:
            self._push_walls(x, stiffness, time, tolerance)
        return self._project(x, stiffness, time, tolerance)

    def _push_walls(self, x: np.ndarray, stiffness: np.ndarray, time: float, tolerance: float) -> None:
        """Find where walls with mass end in an explicit step. Collective."""
        free = self.motion.free
        failure: SimulationFailure | None = None

        def forces() -> tuple[np.ndarray, np.ndarray]:
            nonlocal failure
            try:
                nodes, _, _, walls = self._project(x.copy(), stiffness, time, tolerance, booked=False)
            except SimulationFailure as met:  # told once all ranks have left the iteration
                failure = failure or met
                return np.zeros((len(free.at), 3)), np.zeros((len(free.at), 3, 3))
            normals, _ = self.planes(walls.touching, walls.places, self.motion.shifts(time))
            active = np.where(walls.touching[:, :, None] & ~self.fixed[nodes][:, None, :], normals, 0.0)
            inverse = np.linalg.pinv(active, rcond=1e-8) if len(nodes) else np.zeros((0, 3, len(self.walls)))
            weight = stiffness[nodes][:, None] * (inverse * inverse).sum(axis=1)  # k (N N^T)^-1 on its diagonal
            slope = np.einsum("mw,mwi,mwj->wij", np.where(walls.touching, weight, 0.0), normals, normals)
            return walls.force[free.at], slope[free.at]

        free.solve(forces, 1e-15 * self.length)
        if failure is not None:
            raise failure

    def _project(
        self, x: np.ndarray, stiffness: np.ndarray, time: float, tolerance: float, booked: bool = True
    ) -> tuple:
        shifts = self.motion.shifts(time)
        near = self.near(x, shifts)
        if self.restitution.any():
            near |= self._returning()
        nodes = np.flatnonzero(near)
        if len(nodes) == 0:
            return nodes, np.empty((0, 3)), np.empty((0, 3)), self.none()
        free = x[nodes]
        concerned = self.concerned(nodes, free, shifts)
        at = free
        rebound = self._rebound(nodes)
        for _ in range(_CURVED_ROUNDS):
            normals, offsets = self.planes(concerned, at, shifts)
            offsets += rebound
            moved, multipliers = free.copy(), np.zeros(offsets.shape)
            stuck = project(moved, self.fixed[nodes], normals, offsets, tolerance, multipliers)
            if stuck >= 0:
                raise SimulationFailure(self._no_room(nodes[stuck], offsets[stuck], time))
            if self.flat.all() or np.abs(moved - at).max() <= tolerance:
                break
            at = moved
        else:
            node = self.mesh.node_ids[nodes[np.argmax(np.abs(moved - at).max(axis=1))]]
            raise SimulationFailure(
                f"the place of node {node} on curved walls at time {time:.6g} s was not found in {_CURVED_ROUNDS} rounds; "
                "take a smaller time step"
            )
        strength = multipliers * stiffness[nodes][:, None]
        force = strength[:, :, None] * normals
        if self.rough:
            moved, force = self._rub(nodes, free, shifts, (normals, offsets), stiffness[nodes], moved, strength, time)
        if booked and self.restitution.any():
            self._remember_approach(nodes, free, shifts, normals, strength)
        walls = self.sums(nodes, force, moved, np.einsum("mwi,mwi->mw", force, normals) > 0.0)
        x[nodes] = moved
        return nodes, moved - free, force.sum(axis=1), walls

    def _returning(self) -> np.ndarray:
        """(owned,) bool: nodes that hit a wall with restitution in the last step."""
        rebound = self.state.memory.get("rebound")
        return (rebound > 0.0).any(axis=1) if rebound is not None else np.zeros(len(self.members), dtype=bool)

    def _rebound(self, nodes: np.ndarray) -> np.ndarray:
        """Distances (m, walls) [m] from walls that nodes get to in this step, having hit them in the last."""
        rebound = self.state.memory.get("rebound") if self.restitution.any() else None
        return rebound[nodes] if rebound is not None else np.zeros((len(nodes), len(self.walls)))

    def _remember_approach(self, nodes, free, shifts, normals, strength) -> None:
        """Who hits a wall with restitution in this step, and how far it gets from it in the next [m]."""
        state = self.state
        rebound = state.memory.setdefault("rebound", np.zeros((len(self.members), len(self.walls))))
        way = shifts - self.motion.shifts(state.time)
        if self.motion.free is not None:  # how they would meet, not how the wall gives way
            way[self.motion.free.at] = self.motion.free.unpushed() - self.motion.free.state.x
        approach = -np.einsum("mwi,mwi->mw", normals, (free - state.position[nodes])[:, None, :] - way)
        fresh = (strength > 0.0) & ~self.log.touching[nodes]
        rebound[:] = 0.0
        rebound[nodes] = np.where(fresh, self.restitution * np.maximum(approach, 0.0), 0.0)

    def _rub(self, nodes, free, shifts, planes, stiffness, moved, strength, time) -> tuple[np.ndarray, np.ndarray]:
        """Positions and forces (m, w, 3) with friction, from those without; curved walls by tangent planes at the result."""
        state = self.state
        way = shifts - self.motion.shifts(state.time)
        before, fixed = state.position[nodes], self.fixed[nodes]
        normals, offsets = planes
        concerned = offsets > -np.inf
        tolerance = 1e-13 * self.length
        for _ in range(_CURVED_ROUNDS):
            at, pressing, drag = moved.copy(), strength.copy(), np.zeros(normals.shape)
            unsettled = add_friction(
                at, before, way, fixed, normals, offsets, self.friction, self.static_friction, stiffness, pressing, drag
            )
            if unsettled >= 0:
                raise SimulationFailure(
                    f"the friction of node {self.mesh.node_ids[nodes[unsettled]]} at time {time:.6g} s on several walls was "
                    "not settled; take a smaller time step"
                )
            if self.flat.all():
                break
            normals_there, offsets = self.planes(concerned, at, shifts)
            if np.abs(normals_there - normals).max() <= 1e-14:
                break
            normals = normals_there
            moved, multipliers = free.copy(), np.zeros(offsets.shape)
            project(moved, fixed, normals, offsets, tolerance, multipliers)
            strength = multipliers * stiffness[:, None]
        return at, pressing[:, :, None] * normals + drag

    def sums(self, nodes: np.ndarray, force: np.ndarray, x: np.ndarray, touching: np.ndarray) -> WallForces:
        """Sums of forces (m, w, 3) on nodes at (m, 3)."""
        moment = np.cross(x[:, None, :], force).sum(axis=0)
        return WallForces(force.sum(axis=0), touching.sum(axis=0), moment, nodes, touching, x)

    def _no_room(self, node: int, offsets: np.ndarray, time: float) -> str:
        touched = [name for name, offset in zip(self.names, offsets, strict=True) if offset > -np.inf]
        return (
            f"no position of node {self.mesh.node_ids[node]} at time {time:.6g} s satisfies all walls "
            f"({', '.join(touched)}) and its supports; the walls leave it no room"
        )

    def frames(
        self, candidates: np.ndarray, x: np.ndarray, time: float, concerned: np.ndarray, rank: np.ndarray | None = None
    ) -> NodalFrames:
        """Coordinates and bounds of candidate nodes from their planes at positions (owned, 3). Collective.

        ``concerned`` (m, walls) says which walls can stop a candidate; ``rank`` (m, walls) in which order they are taken
        where there are more than three; default: nearest first.
        """
        at = x[candidates]
        normals, offsets = self.planes(concerned, at, self.motion.shifts(time))
        if rank is None:
            rank = np.einsum("iwk,ik->iw", normals, at) - offsets
        tolerance = 1e-12 * self.length
        frames = build_frames(candidates, self.fixed[candidates], normals, offsets, rank, tolerance)
        with agreed(self.mesh.comm):
            if frames.contradiction >= 0:
                node = frames.contradiction
                raise SimulationFailure(self._no_room(candidates[node], offsets[node], time))
        return frames

    def strengths(self, frames: NodalFrames, residual: np.ndarray, active: np.ndarray) -> np.ndarray:
        """Normal forces (m, walls) [N] of an implicit step from its residual on the active bounds.

        Parameters
        ----------
        frames : NodalFrames
        residual : (m, 3) residual of the frames' nodes in their coordinates [N]
        active : (m, 3) int8: -1 on the lower bound, +1 on the upper, 0 on none
        """
        strengths = np.zeros(frames.rows.shape)
        every = np.arange(len(frames.nodes))
        left = np.where(active != 0, residual, 0.0)
        for k in range(len(self.walls)):
            row = frames.rows[:, k]
            sign = frames.signs[:, k]
            safe = np.maximum(row, 0)
            touching = (row >= 0) & (active[every, safe] == -sign)
            strengths[touching, k] = np.abs(left[every[touching], safe[touching]])
            left[every[touching], safe[touching]] = 0.0  # walls that share a bound: the first takes the force
        return strengths

    def forces(self, frames: NodalFrames, strengths: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, WallForces]:
        """Forces (m, 3) on the frames' nodes at (m, 3) from normal forces (m, walls), and their sums per wall."""
        force = strengths[:, :, None] * frames.normals
        return force.sum(axis=1), self.sums(frames.nodes, force, x, strengths > 0.0)

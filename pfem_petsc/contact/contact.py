"""Walls and the nodes that they stop: search, candidates of implicit steps, nodes that start beyond walls."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..errors import InputError, SimulationFailure
from ..integrators.base import Balance, State
from ..mechanics.compiled import kernel
from ..parallel.agreement import agreed
from ..registry import lookup
from ..tolerances import BEYOND, ON_BOUND, PROJECTED, resolvable
from .explicit import ExplicitContact
from .forces import ContactLog, WallForces
from .frames import MIN_VOLUME, NodalFrames, Planes, build_frames
from .tied import FreshTies, Ties
from .wall_motion import WallMotion

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..mesh.distribution import DistributedMesh
    from .walls.base import WallKeys


@kernel
def near_planes(x, normals, offsets, all_nodes, members, reach, near):
    """Mark nodes within reach of a plane.

    Parameters
    ----------
    x : (n, 3) positions [m]
    normals : (w, 3); offsets : (w,) [m]: planes n . x = d
    all_nodes : (w,) bool, whether a plane applies to all nodes
    members : (n, w) bool, nodes to which a plane applies otherwise
    reach : (n,) or (1,) distance below which a node counts as near [m]
    near : (n,) bool, updated

    Returns
    -------
    int
        Number of nodes marked here.
    """
    count = 0
    per_node = len(reach) > 1
    for i in range(len(x)):
        limit = reach[i] if per_node else reach[0]
        for k in range(len(offsets)):
            gap = normals[k, 0] * x[i, 0] + normals[k, 1] * x[i, 1] + normals[k, 2] * x[i, 2] - offsets[k]
            if gap < limit and (all_nodes[k] or members[i, k]):
                near[i] = True
                count += 1
                break
    return count


_ZERO = np.zeros(1)
_TURN = 0.8  # cosine between normals in a step, below which forces act along that at the new position


class Contact:
    """All walls of a case and this rank's nodes.

    Attributes
    ----------
    names : of the walls, in the order of the case
    any : whether the case has walls
    moving : (walls,) bool
    normals : (walls, 3) of flat walls, zero for the others
    log : ContactLog
    restitution, friction, static_friction : (walls,); has_friction : whether any wall has friction
    ties : Ties
    plain : whether all walls are flat and without further features
    size : length that tolerances are relative to [m], see :mod:`~pfem_petsc.tolerances`
    rebounds : whether restitution is a bound on the next position, for schemes that solve for the next position
    state : of the nodes, for walls that need their previous positions; set by the stepper
    """

    def __init__(
        self,
        case: Case,
        nodes: dict[str, np.ndarray],
        mesh: DistributedMesh,
        fixed: np.ndarray,
        parameters: Sequence[WallKeys] | None = None,
    ) -> None:
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
        self.motion = WallMotion(walls, case.holds("wall"))
        self.moving = self.motion.moving
        self.all_nodes = np.array([wall.node_set is None for wall in walls], dtype=bool)
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
        self.rebounds = False
        self.has_friction = bool(self.static_friction.any())
        self.ties = Ties(self, walls)
        self.flat = np.array([wall.flat for wall in self.walls], dtype=bool)
        self.partial = any(wall.partial for wall in self.walls)
        self.normals = np.zeros((len(walls), 3))
        self._offsets = np.zeros(len(walls))
        for k in np.flatnonzero(self.flat):
            self.normals[k], self._offsets[k] = self.walls[k].normal, self.walls[k].offset
        self._explicit = ExplicitContact(self)
        self.plain = self._explicit.plain
        ends = np.stack([-mesh.points.min(axis=0, initial=np.inf), mesh.points.max(axis=0, initial=-np.inf)])
        mesh.comm.Allreduce(MPI.IN_PLACE, ends, op=MPI.MAX)
        centres = np.array([wall.centre for wall in self.walls])
        coordinates = float(np.abs(ends).max()), float(np.abs(centres).max(initial=0.0))
        self.size = resolvable(float(ends.sum(axis=0).max()), *coordinates)

    @property
    def special(self) -> np.ndarray:
        """(walls,) bool: walls other than plain planes with prescribed motion: curved, with mass, friction or
        restitution, or tied."""
        special = ~self.flat | (self.restitution > 0.0) | (self.static_friction > 0.0) | self.ties.tying
        special[self.motion.bodies.at] = True
        return special

    @property
    def symmetric(self) -> bool:
        """Whether the Hessian of a step with these walls is symmetric; friction makes it unsymmetric."""
        return not self.has_friction

    @cached_property
    def nothing(self) -> WallForces:
        """Zero contact forces; read-only."""
        return WallForces.none(len(self.walls))

    def positions(self, time: float) -> np.ndarray:
        """Return the positions of the walls' centres (walls, 3) [m]."""
        return np.array([wall.centre for wall in self.walls]).reshape(-1, 3) + self.motion.displacements(time)

    def gaps(self, x: np.ndarray, time: float, nodes: np.ndarray | None = None) -> np.ndarray:
        """Return distances (m, walls) [m] of owned nodes at (m, 3) from walls, infinite where a wall does not apply.

        ``nodes`` (m,) : indices of these nodes; default: all owned nodes.
        """
        members = self.members if nodes is None else self.members[nodes]
        displacements = self.motion.displacements(time)
        gaps = np.full((len(x), len(self.walls)), np.inf)
        for k in range(len(self.walls)):
            gaps[:, k] = self.gap(k, x, displacements)
            if not self.all_nodes[k]:
                gaps[~members[:, k], k] = np.inf
        return gaps

    def gap(self, k: int, x: np.ndarray, displacements: np.ndarray) -> np.ndarray:
        """Return distances (m,) [m] of positions (m, 3) from wall k."""
        return self.walls[k].gaps(x - displacements[k])

    @property
    def steady(self) -> bool:
        """Return whether there are no walls, or only flat walls at rest without further features."""
        return not self.any or (self.plain and not self.moving.any())

    def plane_offsets(self, time: float) -> np.ndarray:
        """Return offsets (w,) [m] of the planes n . x = d of flat walls at a time [s]."""
        if not self.moving.any():
            return self._offsets
        return self._offsets + np.einsum("ij,ij->i", self.normals, self.motion.displacements(time))

    def near(self, x: np.ndarray, displacements: np.ndarray, reach: np.ndarray = _ZERO) -> np.ndarray:
        """Return (owned,) bool: nodes at positions (owned, 3) within ``reach``, (owned,) or (1,) [m], of a wall.

        With a reach of zero these are the nodes beyond a wall.
        """
        near = np.zeros(len(x), dtype=bool)
        if self.flat.any():
            at = self.flat
            offsets = self._offsets[at] + np.einsum("ij,ij->i", self.normals[at], displacements[at])
            members = self.members if self.flat.all() else np.ascontiguousarray(self.members[:, at])
            near_planes(x, self.normals[at], offsets, self.all_nodes[at], members, reach, near)
        for k in np.flatnonzero(~self.flat):
            near |= (self.gap(k, x, displacements) < reach) & self.members[:, k]
        return near

    def applicable(self, nodes: np.ndarray, x: np.ndarray, displacements: np.ndarray) -> np.ndarray:
        """Return (m, walls) bool: walls that can stop nodes that move to positions (m, 3)."""
        applicable = self.members[nodes]
        if self.partial and self.state is not None:
            state = self.state
            before = state.position[nodes]
            earlier = self.motion.displacements(state.time)
            for k, wall in enumerate(self.walls):
                if wall.partial:
                    # a node in contact may lie beyond the wall, because the balance need not hold at its position
                    held = state.contact[nodes] @ wall.normal > 0.0
                    slack = np.where(held, 0.1 * wall.half.min(), BEYOND * self.size)
                    applicable[:, k] &= wall.stops(before - earlier[k], x - displacements[k], slack)
        return applicable

    def planes(
        self, applicable: np.ndarray, x: np.ndarray, displacements: np.ndarray, acting: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return planes (m, w, 3), (m, w) at positions (m, 3), with offset -inf for walls that do not apply.

        ``acting`` : result of :meth:`acting`. Planes of curved walls then have these normals, at the same distance.
        """
        normals = np.empty((len(x), len(self.walls), 3))
        offsets = np.empty((len(x), len(self.walls)))
        for k, wall in enumerate(self.walls):
            normals[:, k], offsets[:, k] = wall.planes(x - displacements[k])
            offsets[:, k] += normals[:, k] @ displacements[k]
            if not wall.flat:
                if acting is not None:
                    other = acting[:, k].any(axis=1)
                    normals[other, k] = acting[other, k]
                offsets[:, k] = np.einsum("mi,mi->m", normals[:, k], x) - self.gap(k, x, displacements)
        offsets[~applicable] = -np.inf
        return normals, offsets

    def acting(self, nodes: np.ndarray, x: np.ndarray, displacements: np.ndarray, part: float) -> np.ndarray | None:
        """Return the directions (m, w, 3) in which curved walls push nodes (m,) that move to (m, 3) in a step.

        These are the normals where the forces of the step's balance act, at the fraction ``part`` of the way
        (:attr:`~pfem_petsc.integrators.base.Balance.acting`). None: all are the normals at the end. So are those that
        are zero in the result: of flat walls, and where the normal turns by more than 37 degrees on the way, because a
        force along the earlier normal may not reach the surface.

        ``displacements`` (w, 3) : of the walls at the end [m]
        """
        if part == 1.0 or self.flat.all():
            return None
        earlier, start = self.motion.displacements(self.state.time), self.state.position[nodes]
        acting = np.zeros((len(x), len(self.walls), 3))
        for k in np.flatnonzero(~self.flat):
            end, before = x - displacements[k], start - earlier[k]
            there, _ = self.walls[k].planes(before + part * (end - before))
            turn = np.einsum("mi,mi->m", there, self.walls[k].planes(end)[0])
            acting[:, k] = np.where((turn > _TURN)[:, None], there, 0.0)
        return acting

    def explicit(
        self,
        predictor: np.ndarray,
        u: np.ndarray,
        stiffness: np.ndarray,
        time: float,
        tolerance: float,
        part: float = 1.0,
    ) -> tuple[np.ndarray, np.ndarray, WallForces]:
        """Correct increments ``u`` (owned, 3), in place, so that the positions predictor + u satisfy the walls.

        Parameters
        ----------
        predictor, u : (owned, 3); their sum is the position at ``time`` without walls [m]
        stiffness : (owned,) alpha m + eta c: force for a displacement of the node [N/m]
        tolerance : [m]
        part : see :meth:`acting`; other parts than 1 need the state

        Returns
        -------
        (nodes (m,), force (m, 3) [N] by the walls, WallForces)
        """
        return self._explicit.press(predictor, u, stiffness, time, tolerance, part)

    def sums(
        self, nodes: np.ndarray, force: np.ndarray, x: np.ndarray, touching: np.ndarray, friction: float = 0.0
    ) -> WallForces:
        """Return sums of forces (m, w, 3) on nodes at (m, 3); ``friction``: energy dissipated in the step [J]."""
        moment = np.cross(x[:, None, :], force).sum(axis=0)
        return WallForces(force.sum(axis=0), touching.sum(axis=0), moment, nodes, touching, x, friction)

    def record(self, walls: WallForces, time: float, h: float) -> FreshTies:
        """Record a step of ``h`` [s] whose positions at ``time`` have these forces; return the nodes that were tied.

        Collective whenever the log is full.
        """
        if self.any:
            self.log.book(walls, h, self.mesh.comm)
        return self.ties.take(walls.nodes, walls.touching, walls.places, time)

    def damp_velocity(self, fresh: FreshTies, v: np.ndarray, time: float, h: float) -> None:
        """See :meth:`~pfem_petsc.contact.tied.Ties.damp_velocity`; velocities (owned, 3), result of :meth:`record`."""
        self.ties.damp_velocity(*fresh, v, self.motion.rates(time), h)

    def infeasible_message(self, node: int, offsets: np.ndarray) -> str:
        """Return the message about a node (owned index) whose planes are infeasible together."""
        touched = [name for name, offset in zip(self.names, offsets, strict=True) if offset > -np.inf]
        return (
            f"no position of node {self.mesh.node_ids[node]} satisfies all walls "
            f"({', '.join(touched)}) and its supports: they are infeasible together; move the "
            "walls apart, or free the node"
        )

    def unsettled_message(self) -> str:
        """Return the message about walls with mass for which no position balances the forces on them."""
        names = ", ".join(repr(self.names[k]) for k in self.motion.bodies.at)
        return (
            f"walls with mass ({names}) have no position at which the forces of the nodes balance: nodes alternate "
            "between walls that push them the same way; reduce time.step, remove one of these walls, or limit it by "
            "'node_set'"
        )

    def frames(
        self, candidates: Candidates, x: np.ndarray, time: float, least: float = MIN_VOLUME, part: float = 1.0
    ) -> NodalFrames:
        """Build coordinates and bounds of candidates from their planes at positions (owned, 3). Collective.

        ``least``: see :func:`~pfem_petsc.contact.frames.build_frames`; ``part``: see :meth:`acting`.
        """
        nodes, rank = candidates.nodes, candidates.priority
        at, displacements = x[nodes], self.motion.displacements(time)
        acting = self.acting(nodes, at, displacements, part)
        normals, offsets = self.planes(candidates.applicable, at, displacements, acting)
        if rank is None:
            rank = np.einsum("iwk,ik->iw", normals, at) - offsets
        tolerance = ON_BOUND * self.size
        frames = build_frames(nodes, Planes(self.fixed[nodes], normals, offsets, rank, at), tolerance, least)
        with agreed(self.mesh.comm):
            if frames.contradiction >= 0:
                node = frames.contradiction
                raise SimulationFailure(self.infeasible_message(nodes[node], offsets[node]))
        return frames

    def strengths(self, frames: NodalFrames, residual: np.ndarray, active: np.ndarray) -> np.ndarray:
        """Return normal forces (m, walls) [N] of an implicit step from its residual on the active bounds.

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
            # of almost parallel walls that share a row, take the nearest
            bound = np.where(sign > 0.0, frames.lower[every, safe], frames.upper[every, safe])
            touching &= sign * (bound - frames.bounds[:, k]) <= ON_BOUND * self.size
            strengths[touching, k] = np.abs(left[every[touching], safe[touching]])
            left[every[touching], safe[touching]] = 0.0  # where walls share a bound, the first takes the force
        return strengths


@dataclass(frozen=True)
class Candidates:
    """Nodes whose unknowns have bounds.

    Attributes
    ----------
    nodes : (m,) owned local indices, ascending; applicable : (m, walls) bool, walls that may stop them
    priority : (m, walls) order of the walls, lowest first; None: by distance
    anywhere : whether any rank has candidates
    """

    nodes: np.ndarray
    applicable: np.ndarray
    priority: np.ndarray | None = None
    anywhere: bool = True

    def join(
        self,
        contact: Contact,
        displacements: np.ndarray,
        joined: np.ndarray,
        broken: np.ndarray,
        x: np.ndarray,
        strengths: np.ndarray,
        largest_rank: float,
    ) -> Candidates:
        """Return the candidates of the next solve: violated walls first, then those that press, then by distance.

        Parameters
        ----------
        contact : Contact
        displacements : (walls, 3) of walls [m]
        joined, broken : (k,) nodes beyond walls, and (k, walls) bool, which walls
        x : (owned, 3) positions [m]
        strengths : (m, walls) normal forces on the present candidates [N]
        largest_rank : offset that orders walls that press before all open ones [m]
        """
        nodes = np.union1d(self.nodes, joined)
        applicable = np.zeros((len(nodes), len(contact.walls)), dtype=bool)
        applicable[np.searchsorted(nodes, joined)] = broken
        place = np.searchsorted(nodes, self.nodes)
        applicable[place] |= self.applicable
        normals, offsets = contact.planes(applicable, x[nodes], displacements)
        priority = np.einsum("iwk,ik->iw", normals, x[nodes]) - offsets
        normal_forces = strengths > 0.0
        largest = max(float(strengths.max(initial=0.0)), 1e-300)
        held = priority[place]
        held[normal_forces] = -largest_rank * (1.0 + strengths[normal_forces] / largest)
        priority[place] = held
        return Candidates(nodes, applicable, priority)

    def without(self, held: np.ndarray) -> Candidates:
        """Return the candidates with no applicable walls at tied nodes, ``held`` (owned,) bool."""
        return replace(self, applicable=self.applicable & ~held[self.nodes][:, None])


def expected_candidates(
    contact: Contact, state: State, balance: Balance, held: np.ndarray, displacements: np.ndarray
) -> Candidates:
    """Return the owned nodes that may touch a wall in a step, among them those in contact before it. Collective.

    ``held`` (owned,) bool : nodes in contact before the step; ``displacements`` (walls, 3) : of the walls at the time
    of the balance [m]
    """
    walls = len(contact.walls)
    nobody = Candidates(np.empty(0, dtype=np.int64), np.zeros((0, walls), dtype=bool), anywhere=False)
    if not contact.any:
        return nobody
    move = (balance.time - state.time) * state.v
    reach = 0.5 * np.linalg.norm(move, axis=1) + BEYOND * contact.size
    near = held | contact.near(state.position + move, displacements, reach) | contact.ties.held
    if contact.mesh.comm.allreduce(int(near.any()), op=MPI.MAX) == 0:
        return nobody
    nodes = np.flatnonzero(near)
    return Candidates(
        nodes, _within_reach(contact, state, nodes, (state.position + move)[nodes], displacements, reach[nodes])
    )


def _within_reach(
    contact: Contact, state: State, nodes: np.ndarray, x: np.ndarray, displacements: np.ndarray, reach: np.ndarray
) -> np.ndarray:
    """Return (m, walls) bool: walls that nodes (m,) moving to (m, 3) touch or come within reach (m,) [m] of."""
    applicable = contact.applicable(nodes, x, displacements)
    within = np.zeros_like(applicable)
    starts = state.position[nodes], contact.motion.displacements(state.time), BEYOND * contact.size
    for place, there, distance in ((x, displacements, reach[:, None]), starts):
        normals, offsets = contact.planes(applicable, place, there)
        within |= np.einsum("mwi,mi->mw", normals, place) - offsets < distance
    return within & applicable


def adjust_start(case: Case, nodes: dict[str, np.ndarray], mesh: DistributedMesh) -> int:
    """Move nodes onto walls with ``adjust = true``; bars are unstressed in the new positions. Collective.

    Returns
    -------
    int
        Number of nodes moved on all ranks.

    Raises
    ------
    InputError
        On all ranks, for infeasible walls at a node, or a bar that loses its length.
    """
    # friction, restitution and ties play no role here
    plain = {"friction": 0.0, "static_friction": None, "restitution": 0.0, "tied": False}
    walls = [wall.model_copy(update=plain) for wall in case.wall if wall.adjust]
    if not walls:
        return 0
    owned = mesh.n_owned
    contact = Contact(case, nodes, mesh, np.zeros((owned, 3), dtype=bool), walls)
    points, way = mesh.points[:owned], np.zeros((owned, 3))
    moved = np.empty(0, dtype=np.int64)
    with agreed(mesh.comm):
        try:
            moved, *_ = contact.explicit(points, way, np.ones(owned), 0.0, PROJECTED * contact.size)
        except SimulationFailure as failure:
            raise InputError(f"{case.source}: wall.adjust: {failure}") from failure
    points += way
    mesh.update_ghosts(mesh.points)
    a, b = mesh.bars.T
    length = np.linalg.norm(mesh.points[b] - mesh.points[a], axis=1)
    with agreed(mesh.comm):
        if len(length) and length.min() <= BEYOND * contact.size:
            bar = int(np.argmin(length))
            ends = mesh.node_ids[[a[bar], b[bar]]]
            raise InputError(
                f"{case.source}: wall.adjust: bar {mesh.bar_ids[bar]} between nodes {ends[0]} and {ends[1]} has zero "
                "length once its nodes are on the wall; move the wall or the mesh"
            )
    return mesh.comm.allreduce(len(moved))


def check_start(contact: Contact, x: np.ndarray, length: float) -> None:
    """Check that no node starts beyond a wall by more than rounding of the model's size ``length`` [m]. Collective.

    Raises
    ------
    InputError
        On all ranks; names the wall, the deepest node and its depth.
    """
    if not contact.any:
        return
    comm = contact.mesh.comm
    gaps = contact.gaps(x, 0.0)
    for k, wall in enumerate(contact.walls):
        if wall.partial:  # no node starts beyond a wall that nodes can pass beside
            continue
        deepest, node, count = 0.0, -1, 0
        if len(gaps):
            at = int(np.argmin(gaps[:, k]))
            deepest, node = float(gaps[at, k]), int(contact.mesh.node_ids[at])
            count = int((gaps[:, k] < -ON_BOUND * length).sum())
        depth, node = min(comm.allgather((deepest, node)))
        count = comm.allreduce(count)
        if count:
            raise InputError(
                f"{contact.source}: wall {contact.names[k]!r}: node {node} starts {-depth:.6g} "
                f"m beyond the wall ({count} node{'s' if count > 1 else ''} in all); move the wall or the mesh, "
                "turn the normal to the allowed side, name the nodes that it applies to with 'node_set', or let "
                "'adjust = true' move the nodes"
            )

"""Walls and the nodes that they stop: search, candidates of implicit steps, nodes that start beyond walls."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..errors import InputError, SimulationFailure
from ..integrators.base import Balance, State
from ..parallel.agreement import agreed
from ..tolerances import BEYOND, ON_BOUND
from .explicit import ExplicitContact
from .frames import MIN_VOLUME, NodalFrames, Planes, RowPlanes, build_frames
from .node_walls import WallForces
from .surfaces import OTHER
from .tied import FreshTies
from .wall_motion import Poses

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..mesh.distribution import DistributedMesh


_NO_ROWS = RowPlanes.none(0)


class Contact(ExplicitContact):
    """All walls of a case and this rank's nodes, in explicit and implicit steps."""

    @property
    def special(self) -> np.ndarray:
        """(slots,) bool: of walls other than plain planes with prescribed displacements: curved, turning, with mass,
        friction or restitution, or tied."""
        special = ~self.flat | (self.restitution > 0.0) | (self.static_friction > 0.0) | self.ties.tying
        special |= np.isin(self.wall_of, self.motion.bodies.at)
        return special

    @property
    def steady(self) -> bool:
        """Whether compiled steps serve the walls: infinite flat ones, spheres, cylinders and surfaces of triangles,
        not tied."""
        triangles = np.isin(np.arange(len(self.walls)), self.surfaces_of_triangles)
        known = bool(((self.at_rest.radii != OTHER) | triangles).all()) and not self.partial
        return not self.any or (known and not self.ties.any)

    def record(self, walls: WallForces, time: float, h: float) -> FreshTies:
        """Record a step of ``h`` [s] whose positions at ``time`` have these forces; return the nodes that were tied.

        Collective whenever the log is full.
        """
        if self.any:
            self.log.book(walls, h, self.mesh.comm)
        return self.ties.take(walls.nodes, walls.touching, walls.places, time)

    def frames(
        self,
        candidates: Candidates,
        x: np.ndarray,
        time: float,
        least: float = MIN_VOLUME,
        part: float = 1.0,
        rows: RowPlanes = _NO_ROWS,
    ) -> NodalFrames:
        """Build coordinates and bounds of candidates from their planes at positions (owned, 3). Collective.

        ``least``: see :func:`~pfem_petsc.contact.frames.build_frames`; ``part``: see :meth:`acting`; ``rows``: further
        planes of some of the candidates.
        """
        nodes, rank = candidates.nodes, candidates.priority
        at, poses = x[nodes], self.motion.poses(time)
        self.find_faces(nodes, at, poses, ON_BOUND * self.size)
        acting = self.acting(nodes, at, poses, part)
        normals, offsets = self.planes(candidates.applicable, at, poses, acting, nodes)
        if rank is None:
            rank = np.einsum("iwk,ik->iw", normals, at) - offsets
        tolerance, walls = ON_BOUND * self.size, offsets.shape[1]
        if rows.offsets.shape[1]:
            normals, offsets, rank, at = rows.beside(nodes, (normals, offsets, rank, at))
        frames = build_frames(nodes, Planes(self.fixed[nodes], normals, offsets, rank, at), tolerance, least)
        with agreed(self.mesh.comm):
            if frames.contradiction >= 0:
                node = frames.contradiction
                raise SimulationFailure(self.infeasible_message(nodes[node], offsets[node, :walls]))
        return frames

    def strengths(self, frames: NodalFrames, residual: np.ndarray, active: np.ndarray) -> np.ndarray:
        """Return normal forces (m, slots) [N] of an implicit step from its residual on the active bounds, also in the
        slots of tables of rows that the frames have.

        Parameters
        ----------
        frames : NodalFrames
        residual : (m, 3) residual of the frames' nodes in their coordinates [N]
        active : (m, 3) int8: -1 on the lower bound, +1 on the upper, 0 on none
        """
        strengths = np.zeros(frames.rows.shape)
        every = np.arange(len(frames.nodes))
        left = np.where(active != 0, residual, 0.0)
        for k in range(frames.rows.shape[1]):
            row = frames.rows[:, k]
            ratio = frames.ratios[:, k]
            sign = np.sign(ratio)
            safe = np.maximum(row, 0)
            touching = (row >= 0) & (active[every, safe] == -sign)
            # of almost parallel walls that share a row, take the nearest
            bound = np.where(sign > 0.0, frames.lower[every, safe], frames.upper[every, safe])
            touching &= sign * (bound - frames.bounds[:, k]) <= ON_BOUND * self.size
            strengths[touching, k] = np.abs(left[every[touching], safe[touching]] / ratio[touching])
            left[every[touching], safe[touching]] = 0.0  # where walls share a bound, the first takes the force
        return strengths


@dataclass(frozen=True)
class Candidates:
    """Nodes whose unknowns have bounds.

    Attributes
    ----------
    nodes : (m,) owned local indices, ascending; applicable : (m, slots) bool, walls that may stop them
    priority : (m, slots) order of the walls, lowest first; None: by distance
    anywhere : whether any rank has candidates
    """

    nodes: np.ndarray
    applicable: np.ndarray
    priority: np.ndarray | None = None
    anywhere: bool = True

    def join(
        self,
        contact: Contact,
        poses: Poses,
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
        poses : of walls
        joined, broken : (k,) nodes beyond walls, and (k, slots) bool, which walls
        x : (owned, 3) positions [m]
        strengths : (m, slots) normal forces on the present candidates [N]
        largest_rank : offset that orders walls that press before all open ones [m]
        """
        nodes = np.union1d(self.nodes, joined)
        applicable = np.zeros((len(nodes), len(contact.wall_of)), dtype=bool)
        applicable[np.searchsorted(nodes, joined)] = broken
        place = np.searchsorted(nodes, self.nodes)
        applicable[place] |= self.applicable
        _, priority = contact.distances(applicable, x[nodes], poses, nodes)
        normal_forces = strengths > 0.0
        largest = max(float(strengths.max(initial=0.0)), 1e-300)
        held = priority[place]
        held[normal_forces] = -largest_rank * (1.0 + strengths[normal_forces] / largest)
        priority[place] = held
        return Candidates(nodes, applicable, priority)

    def beside(self, nodes: np.ndarray) -> Candidates:
        """Return the candidates and further nodes (k,) that no wall stops, for rows; there are some anywhere."""
        every = np.union1d(self.nodes, nodes)
        at, shape = np.searchsorted(every, self.nodes), (len(every), self.applicable.shape[1])
        applicable, priority = np.zeros(shape, dtype=bool), None
        applicable[at] = self.applicable
        if self.priority is not None:
            priority = np.zeros(shape)
            priority[at] = self.priority
        return Candidates(every, applicable, priority)

    def without(self, held: np.ndarray) -> Candidates:
        """Return the candidates with no applicable walls at tied nodes, ``held`` (owned,) bool."""
        return replace(self, applicable=self.applicable & ~held[self.nodes][:, None])


def expected_candidates(contact: Contact, state: State, balance: Balance, held: np.ndarray, poses: Poses) -> Candidates:
    """Return the owned nodes that may touch a wall in a step, among them those in contact before it. Collective.

    ``held`` (owned,) bool : nodes in contact before the step; ``poses`` : of the walls at the time of the balance
    """
    slots = len(contact.wall_of)
    nobody = Candidates(np.empty(0, dtype=np.int64), np.zeros((0, slots), dtype=bool), anywhere=False)
    if not contact.any:
        return nobody
    move = (balance.time - state.time) * state.v
    reach = 0.5 * np.linalg.norm(move, axis=1) + BEYOND * contact.size
    contact.forget_faces()
    near = held | contact.near(state.position + move, poses, reach) | contact.ties.held
    if contact.mesh.comm.allreduce(int(near.any()), op=MPI.MAX) == 0:
        return nobody
    nodes = np.flatnonzero(near)
    return Candidates(nodes, _within_reach(contact, state, nodes, (state.position + move)[nodes], poses, reach[nodes]))


def _within_reach(
    contact: Contact, state: State, nodes: np.ndarray, x: np.ndarray, poses: Poses, reach: np.ndarray
) -> np.ndarray:
    """Return (m, slots) bool: walls that nodes (m,) moving to (m, 3) touch or come within reach (m,) [m] of."""
    applicable = contact.applicable(nodes, x, poses)
    within = np.zeros_like(applicable)
    starts = state.position[nodes], contact.motion.poses(state.time), BEYOND * contact.size
    for place, there, distance in ((x, poses, reach[:, None]), starts):
        within |= contact.distances(applicable, place, there)[1] < distance
    for k in contact.surfaces_of_triangles:  # whose other faces are found when nodes touch them
        slots = slice(contact.first[k], contact.first[k] + contact.walls[k].faces)
        within[:, slots] = within[:, slots].any(axis=1, keepdims=True)
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
            moved, *_ = contact.explicit(points, way, np.ones(owned), 0.0)
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


def check_start(contact: Contact, x: np.ndarray, length: float, adjusts: bool = True) -> None:
    """Check that no node starts beyond a wall by more than rounding of the model's size ``length`` [m]. Collective.

    ``adjusts``: whether ``adjust = true`` moves nodes at this start, as it does at that of the run.

    Raises
    ------
    InputError
        On all ranks; names the wall, the deepest node and its depth.
    """
    found = contact.deepest(x, 0.0, ON_BOUND * length) if contact.any else None
    if found is not None:
        depth, node, wall, count = found
        remedy = "let 'adjust = true' move the nodes" if adjusts else "let an earlier stage move the nodes"
        side = "turn the normal to the allowed side" if contact.walls[wall].flat else "choose the other 'side'"
        raise InputError(
            f"{contact.source}: wall {contact.names[wall]!r}: node {node} starts {depth:.6g} "
            f"m beyond the wall ({count} node{'s' if count > 1 else ''} in all); move the wall or the mesh, "
            f"{side}, name the nodes that it applies to with 'node_set', or {remedy}"
        )

"""Walls and the nodes that they stop: search, candidates of implicit steps, nodes that start or come beyond walls."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from ..errors import InputError, SimulationFailure
from ..integrators.base import Balance, State
from ..parallel.agreement import agreed
from ..tolerances import BEYOND, ON_BOUND
from .explicit import ExplicitContact
from .frames import MIN_VOLUME, NodalFrames, Planes, RelativeCoordinates, build_frames
from .node_walls import WallForces, held_by_supports
from .surfaces import OTHER
from .tied import FreshTies
from .wall_motion import Poses

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..mesh.distribution import DistributedMesh


class Contact(ExplicitContact):
    """All walls of a case and this rank's nodes, in explicit and implicit steps."""

    @property
    def special(self) -> np.ndarray:
        """(slots,) bool: of walls other than plain planes with prescribed displacements: curved, turning, with mass,
        friction or restitution, or tied."""
        massive = np.isin(self.wall_of, self.motion.bodies.at)
        return ~self.flat | (self.restitution > 0.0) | (self.static_friction > 0.0) | self.ties.tying | massive

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
        balance: Balance,
        slots: int,
        relative: RelativeCoordinates | None,
        least: float = MIN_VOLUME,
    ) -> NodalFrames:
        """Build coordinates and bounds of candidates from their planes at positions (owned, 3). Collective.

        ``slots`` : of walls and of tables of rows; ``relative`` : coordinates of the latter, None if they have none;
        ``least`` : see :func:`~pfem_petsc.contact.frames.build_frames`.
        """
        nodes, poses, tolerance = candidates.nodes, self.motion.poses(balance.time), ON_BOUND * self.size
        places, walls = x[nodes], len(self.wall_of)
        self.find_faces(nodes, places, poses, tolerance)
        acting = self.acting(nodes, places, poses, balance.acting)
        normals, offsets = np.zeros((len(nodes), slots, 3)), np.full((len(nodes), slots), -np.inf)
        normals[:, :walls], offsets[:, :walls] = self.planes(candidates.applicable, places, poses, acting, nodes)
        if relative is not None:
            places = relative.positions(x)[nodes]
            relative.put_planes(x, nodes, normals[:, walls:], offsets[:, walls:])
        rank = np.einsum("iwk,ik->iw", normals, places) - offsets
        if candidates.priority is not None:
            rank[:, :walls] = candidates.priority
        frames = build_frames(nodes, Planes(self.fixed[nodes], normals, offsets, rank, places), tolerance, least)
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
        strengths, every = np.zeros(frames.rows.shape), np.arange(len(frames.nodes))
        left = np.where(active != 0, residual, 0.0)
        for k in range(frames.rows.shape[1]):
            safe, ratio = np.maximum(frames.rows[:, k], 0), frames.ratios[:, k]
            sign = np.sign(ratio)
            touching = (frames.rows[:, k] >= 0) & (active[every, safe] == -sign)
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
        wider = self.beside(joined)
        nodes, applicable = wider.nodes, wider.applicable
        applicable[np.searchsorted(nodes, joined)] |= broken
        _, priority = contact.distances(applicable, x[nodes], poses, nodes)
        pressed, slot = np.nonzero(strengths > 0.0)
        shares = strengths[pressed, slot] / strengths.max(initial=1e-300)
        priority[np.searchsorted(nodes, self.nodes[pressed]), slot] = -largest_rank * (1.0 + shares)
        return Candidates(nodes, applicable, priority)

    def beside(self, nodes: np.ndarray) -> Candidates:
        """Return the candidates and further nodes (k,) that no wall stops, for rows; there are some anywhere."""
        every = np.union1d(self.nodes, nodes)
        at, shape = np.searchsorted(every, self.nodes), (len(every), self.applicable.shape[1])
        applicable, priority = np.zeros(shape, dtype=bool), np.zeros(shape)
        applicable[at], priority[at] = self.applicable, 0.0 if self.priority is None else self.priority
        return Candidates(every, applicable, None if self.priority is None else priority)


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
    x = state.position[nodes] + move[nodes]
    applicable = contact.applicable(nodes, x, poses)
    within = np.zeros_like(applicable)  # walls that they touch or come within reach of
    starts = state.position[nodes], contact.motion.poses(state.time), BEYOND * contact.size
    for place, there, distance in ((x, poses, reach[nodes, None]), starts):
        within |= contact.distances(applicable, place, there)[1] < distance
    # other faces of surfaces of triangles are found when nodes touch them
    within = np.logical_or.reduceat(within, contact.first, axis=1)[:, contact.wall_of]
    return Candidates(nodes, within & applicable)


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


def check_positions(model: Any, x: np.ndarray, time: float, where: str) -> None:
    """Check that no node lies beyond a wall, with one pass over the nodes and one reduction. Collective.

    Parameters
    ----------
    model : Model
    x : (owned, 3) positions [m] at a time [s] at which contact holds
    where : the step, for the message

    Raises
    ------
    SimulationFailure
        On all ranks, with the wall, its deepest node and depth, the number of nodes, the step, and the remedy.
    """
    contact, comm = model.contact, model.comm
    found = contact.deepest(x, time, BEYOND * max(model.size, model.reach)) if contact.any else None
    if found is None:
        return
    depth, node, wall, count = found
    own = np.flatnonzero(model.mesh.node_ids[: len(x)] == node)
    if comm.allreduce(len(own) > 0 and _prescribed(contact, own[0], wall, x, time)):
        raise SimulationFailure(_told(contact, where, node, wall, (depth, count)))
    treatment = model.case.contact.treatment
    others = f'contact.treatment = "scheme" instead of "{treatment}"'
    others = others if treatment != "scheme" else "another contact.treatment or time.integrator"
    raise SimulationFailure(
        f"{where}: node {node} is {depth:.3g} m beyond wall {contact.names[wall]!r} "
        f"({count} node{'s' if count > 1 else ''} in all), which contact did not prevent: results since it "
        f"passed the wall are wrong; reduce time.step, or use {others}"
    )


def _told(contact: Contact, where: str, node: int, wall: int, found: tuple[float, int]) -> str:
    """Return the message about nodes that supports move or hold beyond a wall: the deepest, and ``found``: its depth
    [m] and how many there are."""
    (depth, count), cause = found, "moved there by its supports"
    remedy = "let the wall move with the supports, name the nodes that it stops with 'node_set', or do not tie them"
    if wall in contact.motion.bodies.at:
        cause = "held there by its supports, and a wall with mass is stopped only by nodes that can move"
        remedy = "free the node, and hold it by a bar or a [[spring]]"
    return (
        f"{where}: node {node} is {depth:.3g} m beyond wall {contact.names[wall]!r} "
        f"({count} node{'s' if count > 1 else ''} in all), {cause}; {remedy}"
    )


class CarriedNodes:
    """Nodes of this rank whose motion along the normal of a rectangle is prescribed, so that contact cannot stop them.

    Only the step in which a node crosses shows that it did not come from beside or behind, so every step is checked.

    Attributes
    ----------
    of : index of each rectangle that applies to such nodes, to these nodes (k,)
    """

    def __init__(self, contact: Contact) -> None:
        self._contact = contact
        self._before: dict[int, np.ndarray] = {}
        self.of: dict[int, np.ndarray] = {}
        for k, wall in enumerate(contact.walls):
            if wall.partial:
                held = held_by_supports(contact.fixed, wall.normal) | (
                    contact.fixed.any(axis=1) & contact.motion.turning[k]
                )
                nodes = np.flatnonzero(contact.members[:, contact.first[k]] & held)
                self.of |= {k: nodes} if len(nodes) else {}

    def start(self, x: np.ndarray, time: float) -> None:
        """Keep where they are at the start of a step, from all positions (owned, 3) [m] at a time [s]."""
        if self.of:
            self._before = self._places(x, time)

    def _places(self, x: np.ndarray, time: float) -> dict[int, np.ndarray]:
        """Return their positions (k, 3) [m] relative to the rectangles, from all positions (owned, 3)."""
        poses = self._contact.motion.poses(time)
        return {k: poses.rest(k, x[nodes]) for k, nodes in self.of.items()}

    def crossing(self, x: np.ndarray, time: float, where: str) -> str | None:
        """Return the message about nodes that have crossed a rectangle since :meth:`start`, None if there are none."""
        contact, tolerance = self._contact, BEYOND * self._contact.size
        after = self._places(x, time)
        for k, nodes in self.of.items():
            wall = contact.walls[k]
            depth = wall.offset - after[k] @ wall.normal
            crossed = (depth > tolerance) & wall.stops(self._before[k], after[k], np.full(len(nodes), tolerance))
            if crossed.any():
                at = int(np.argmax(np.where(crossed, depth, 0.0)))
                node = int(contact.mesh.node_ids[nodes[at]])
                return _told(contact, where, node, k, (float(depth[at]), int(crossed.sum())))
        return None


def _prescribed(contact: Contact, node: int, wall: int, x: np.ndarray, time: float) -> bool:
    """Return whether supports prescribe an owned node along a wall's normal, or some components of a tied node.

    ``x`` (owned, 3) : positions [m]
    """
    if contact.ties.any and contact.ties.held[node] and contact.fixed[node].any():
        return True
    normals, _ = contact.planes(np.ones((1, len(contact.wall_of)), dtype=bool), x[[node]], contact.motion.poses(time))
    return bool(held_by_supports(contact.fixed[node], normals[0, contact.first[wall]]))

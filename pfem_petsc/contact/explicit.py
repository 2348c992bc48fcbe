"""Contact in explicit steps: a small problem per node, with flat and curved walls, walls with mass, friction and
restitution.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..errors import SimulationFailure
from ..mechanics.compiled import borrowing, kernel
from ..mesh.ordering import NODE_BLOCK
from ..tolerances import FIXED_POINT, PROJECTED, RANK
from .friction import Rubbing, add_friction, jam
from .node_walls import NodeWalls, WallForces
from .projection import project
from .tied import Ties

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..mesh.distribution import DistributedMesh
    from .walls.base import WallKeys


class FlatWalls(NamedTuple):
    """Planes n . x >= d and the nodes (n,) of a rank, in a step.

    Attributes
    ----------
    fixed : (n, 3) bool, components that supports prescribe
    normals, offsets : (w, 3), (w,) [m]
    all_nodes : (w,) bool, whether a plane applies to all nodes; members : (n, w) bool, to which nodes otherwise
    tolerance : a plane violated by at most this counts as satisfied [m]
    room : (n,) int64, workspace
    way : (w, 3) displacements of the planes in the step [m]
    friction : (2, w) coefficients of dynamic and static friction; (2, 0) if all are zero
    restitution : (w,) coefficients, (0,) if all are zero
    rebound, arrival : (n, w) memory of the last step of nodes that hit planes, updated, see :func:`impact_square`;
        (0, w) without restitution
    touching : (n, w) bool, contacts of the last step
    """

    fixed: np.ndarray
    normals: np.ndarray
    offsets: np.ndarray
    all_nodes: np.ndarray
    members: np.ndarray
    tolerance: float
    room: np.ndarray
    way: np.ndarray
    friction: np.ndarray
    restitution: np.ndarray
    rebound: np.ndarray
    arrival: np.ndarray
    touching: np.ndarray


class Arrivals(NamedTuple):
    """Nodes (m,) at walls: their positions at the start of the step, and how far they would move without forces (m, 3)
    [m]; the force for a displacement of each (m,) [N/m]."""

    start: np.ndarray
    drift: np.ndarray
    stiffness: np.ndarray


class WallSums(NamedTuple):
    """Of each wall ``force`` (w, 3) [N], number of ``contacts`` (w,), and ``moment`` about the origin (w, 3) [N m]."""

    force: np.ndarray
    contacts: np.ndarray
    moment: np.ndarray


@borrowing
def find_beyond(first, free, walls, found, returning):
    """Write the nodes, from node ``first`` on, whose positions ``free`` (3 m,) lie beyond planes of :class:`FlatWalls`
    to ``found``; return their number. With ``returning`` nodes, those that rebound are among them."""
    normals, offsets, all_nodes, members = walls.normals, walls.offsets, walls.all_nodes, walls.members
    n = len(free) // 3
    beyond = 0
    for k in range(len(offsets)):  # without branches
        nx, ny, nz, offset = normals[k, 0], normals[k, 1], normals[k, 2], offsets[k]
        for i in range(n):
            gap = -offset + nx * free[3 * i] + ny * free[3 * i + 1] + nz * free[3 * i + 2]
            beyond += 1 if gap < 0.0 else 0
    if beyond == 0 and not returning:
        return 0
    m = 0
    for i in range(n):
        for k in range(len(offsets)):
            gap = -offsets[k]
            for c in range(3):
                gap += normals[k, c] * free[3 * i + c]
            if (gap < 0.0 and (all_nodes[k] or members[first + i, k])) or (
                returning and walls.rebound[first + i, k] > 0.0
            ):
                found[m] = first + i
                m += 1
                break
    return m


@kernel
def press_nodes(nodes, places, given, walls, sums):
    """Project ``nodes`` (m,) at ``places`` (m, 3) [m], in place, onto planes of :class:`FlatWalls`, with friction and
    restitution, and add the forces of the planes to ``sums``, see :class:`WallSums`; ``given``: :class:`Arrivals`.

    Returns the index of the first infeasible node among them, and of the first whose friction was not found, or -1;
    their offsets (m, w), -inf where a plane does not apply; the total force (m, 3) [N]; planes that they touch (m, w);
    and the energy that friction dissipates [J].
    """
    fixed, normals, offsets, way = walls.fixed, walls.normals, walls.offsets, walls.way
    all_nodes, members, tolerance = walls.all_nodes, walls.members, walls.tolerance
    rebound, arrival, restitution = walls.rebound, walls.arrival, walls.restitution
    force, contacts, moment = sums.force, sums.contacts, sums.moment
    start, drift, stiffness = given.start, given.drift, given.stiffness
    w, m = len(offsets), len(nodes)
    rough, bounces = walls.friction.shape[1] > 0, len(restitution) > 0
    free = places.copy()
    held = np.empty((m, 3), dtype=np.bool_)
    all_normals = np.empty((m, w, 3))
    all_offsets = np.empty((m, w))
    pull = np.zeros((m if bounces else 0, w))  # by forces, towards the walls
    for j in range(m):
        i = nodes[j]
        for c in range(3):
            held[j, c] = fixed[i, c]
        for k in range(w):
            for c in range(3):
                all_normals[j, k, c] = normals[k, c]
            all_offsets[j, k] = offsets[k] if all_nodes[k] or members[i, k] else -math.inf
            if bounces:
                for c in range(3):
                    pull[j, k] -= normals[k, c] * (free[j, c] - start[j, c] - drift[j, c])
                if rebound[i, k] > 0.0:
                    q = pull[j, k]
                    whole = max(rebound[i, k] + q * arrival[i, k] + 0.25 * q * q, 0.0)
                    all_offsets[j, k] += max(restitution[k] * math.sqrt(whole) - 0.5 * q, 0.0)
    strengths = np.zeros((m, w))
    infeasible = project(places, held, all_normals, all_offsets, tolerance, strengths)
    for j in range(m):
        for k in range(w):
            if bounces:
                i = nodes[j]
                fresh = strengths[j, k] > 0.0 and not walls.touching[i, k] and restitution[k] > 0.0
                approach = arrived = 0.0
                for c in range(3):
                    approach -= normals[k, c] * (free[j, c] - start[j, c] - way[k, c])
                    arrived -= normals[k, c] * (places[j, c] - start[j, c] - way[k, c])
                square = max(approach * approach - pull[j, k] * (approach - arrived), 0.0)
                rebound[i, k] = square if fresh and approach > 0.0 else 0.0
                arrival[i, k] = arrived if fresh else 0.0
            strengths[j, k] *= stiffness[j]
    drag = np.zeros((m, w, 3))
    unsettled = -1
    if rough:
        rubbing = Rubbing(start, way, held, all_normals, all_offsets, walls.friction[0], walls.friction[1], stiffness)
        unsettled = add_friction(rubbing, places, strengths, drag)
    total = np.zeros((m, 3))
    touching = np.zeros((m, w), dtype=np.bool_)
    dissipated = 0.0
    for j in range(m):
        x, y, z = places[j, 0], places[j, 1], places[j, 2]
        for k in range(w):
            strength = strengths[j, k]
            if strength == 0.0:
                continue
            fx, fy, fz = strength * normals[k, 0], strength * normals[k, 1], strength * normals[k, 2]
            if rough:
                fx += drag[j, k, 0]
                fy += drag[j, k, 1]
                fz += drag[j, k, 2]
                for c in range(3):
                    dissipated -= drag[j, k, c] * (places[j, c] - start[j, c] - way[k, c])
            total[j, 0] += fx
            total[j, 1] += fy
            total[j, 2] += fz
            force[k, 0] += fx
            force[k, 1] += fy
            force[k, 2] += fz
            moment[k, 0] += y * fz - z * fy
            moment[k, 1] += z * fx - x * fz
            moment[k, 2] += x * fy - y * fx
            touching[j, k] = True
            contacts[k] += 1
    return infeasible, unsettled, all_offsets, total, touching, dissipated


@kernel
def find_pressed(predictor, u, walls, returning):
    """Return the nodes (m,) to press: those whose positions predictor + u, (n, 3) both, lie beyond planes of
    :class:`FlatWalls`, or that rebound if any are ``returning``."""
    n, room = len(u), walls.room
    free = np.empty(3 * NODE_BLOCK)
    m = 0
    for first in range(0, n, NODE_BLOCK):
        last = min(first + NODE_BLOCK, n)
        where, more = predictor[first:last].reshape(-1), u[first:last].reshape(-1)
        for j in range(len(where)):
            free[j] = where[j] + more[j]
        m += find_beyond(first, free[: len(where)], walls, room[m:], returning)
    return room[:m].copy()


def impact_square(approach: np.ndarray, arrival: np.ndarray, pull: np.ndarray) -> np.ndarray:
    """Return the part of I^2 [m2] that is known in the step of the impact, zero for nodes that do not approach.

    Parameters
    ----------
    approach : a, displacement towards the wall without contact [m]
    arrival : d, distance to the wall [m]
    pull : p, contribution of forces to the approach [m]
    """
    square = approach * approach - pull * (approach - arrival)
    return np.where(approach > 0.0, np.maximum(square, 0.0), 0.0)


def rebound_way(
    restitution: np.ndarray | float, square: np.ndarray, arrival: np.ndarray, pull: np.ndarray
) -> np.ndarray:
    """Return w + q/2, the rebound velocity times the step [m]; 0 where ``square`` is 0.

    Parameters
    ----------
    restitution : e
    square, arrival : of the step of the impact, see :func:`impact_square`
    pull : q, towards the wall, by the forces at the position of impact [m]
    """
    whole = np.maximum(square + pull * arrival + 0.25 * pull * pull, 0.0)
    return np.where(square > 0.0, restitution * np.sqrt(whole), 0.0)


_CURVED_ROUNDS = 100  # projections of a step until tangent planes and positions agree


class ExplicitContact(NodeWalls):
    """Walls that project free positions onto the region that they allow.

    Attributes
    ----------
    ties : Ties
    plain : infinite flat walls without ties, and if they have mass without restitution: compiled passes handle them
    """

    def __init__(
        self,
        case: Case,
        nodes: dict[str, np.ndarray],
        mesh: DistributedMesh,
        fixed: np.ndarray,
        parameters: Sequence[WallKeys] | None = None,
    ) -> None:
        super().__init__(case, nodes, mesh, fixed, parameters)
        self.ties = Ties(self, case.wall if parameters is None else parameters)
        heavy = any(wall.mass is not None for wall in (case.wall if parameters is None else parameters))
        bounces = bool(self.restitution.any())
        self.plain = bool(self.flat.all() and not (self.partial or self.ties.any or (heavy and bounces)))
        self._part = 1.0  # see :meth:`acting`
        self._room = np.empty(len(self.members) if self.plain else 0, dtype=np.int64)

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
        self._part = part
        if self.motion.bodies.any:
            self.push_walls(predictor + u, stiffness, time, tolerance)
        if self.plain:
            return self._press_planes(predictor, u, stiffness, time, tolerance)
        nodes, correction, force, walls = self.project(predictor + u, stiffness, time, tolerance)
        u[nodes] += correction
        return nodes, force, walls

    def _press_planes(
        self, predictor: np.ndarray, u: np.ndarray, stiffness: np.ndarray, time: float, tolerance: float
    ) -> tuple:
        w, state = len(self.walls), self.state
        walls = self.flat_walls(tolerance)
        walls.offsets[:] = self.plane_offsets(time)
        walls.way[:] = self.motion.displacements(time)
        sums = WallSums(np.zeros((w, 3)), np.zeros(w, int), np.zeros((w, 3)))
        nodes = find_pressed(predictor, u, walls, len(walls.restitution) > 0)
        start = places = predictor[nodes] + u[nodes]
        drift = np.zeros_like(places)
        if state is not None:
            start = state.position[nodes]
            walls.way[:] -= self.motion.displacements(state.time)
            if len(walls.restitution):
                drift = (time - state.time) * state.memory["half_velocity"][nodes]
        given, free = Arrivals(start, drift, stiffness[nodes]), places.copy()
        infeasible, unsettled, offsets, force, touching, friction = press_nodes(nodes, places, given, walls, sums)
        u[nodes] += places - free
        if infeasible >= 0:
            raise SimulationFailure(self.infeasible_message(nodes[infeasible], offsets[infeasible]))
        if unsettled >= 0:
            raise SimulationFailure(self.unsettled_friction(nodes[unsettled], self.normals))
        if len(nodes) == 0:
            return nodes, force, self.nothing
        return nodes, force, WallForces(*sums, nodes, touching, places, friction)

    def unsettled_friction(self, node: int, normals: np.ndarray) -> str:
        """Return the message about an owned node without a solution of its friction at walls with ``normals`` (w,
        3)."""
        return jam(self, node, normals) or (
            f"the friction of node {self.mesh.node_ids[node]} on several walls did not converge; reduce time.step"
        )

    def flat_walls(self, tolerance: float) -> FlatWalls:
        """Return plain walls for compiled passes, which set where these are; planes violated by at most the tolerance
        [m] count as satisfied."""
        w, members = self._offsets.size, self.members
        friction = np.array([self.friction, self.static_friction]) if self.has_friction else np.empty((2, 0))
        memory = 2 * [np.empty((0, w))]
        if self.rebounds:
            memory = [self.state.memory.setdefault(name, np.zeros(members.shape)) for name in ("rebound", "arrival")]
        return FlatWalls(
            self.fixed,
            self.normals,
            self._offsets.copy(),
            self.all_nodes,
            members,
            tolerance,
            self._room,
            np.zeros((w, 3)),
            friction,
            self.restitution if self.rebounds else np.empty(0),
            *memory,
            self.log.touching,
        )

    def push_walls(self, x: np.ndarray, stiffness: np.ndarray, time: float, tolerance: float) -> None:
        """Find the final positions of walls with mass in an explicit step. Collective."""
        free = self.motion.bodies
        failure: SimulationFailure | None = None

        def forces() -> tuple[np.ndarray, np.ndarray]:
            nonlocal failure
            try:
                nodes, correction, _, walls = self.project(x.copy(), stiffness, time, tolerance, booked=False)
            except SimulationFailure as met:  # raised once all ranks have left the iteration
                failure = failure or met
                return np.zeros((len(free.at), 3)), np.zeros((len(free.at), 3, 3))
            slope = self._slope(nodes, x[nodes], correction, stiffness[nodes], walls, time)
            if self.ties.any:
                tied, at = self.ties.nodes()
                gives = stiffness[tied, None] * ~self.fixed[tied]
                np.add.at(slope, at, gives[:, :, None] * np.eye(3))
            return walls.force[free.at], slope[free.at]

        found = free.solve(forces, FIXED_POINT * self.size)
        if failure is not None:
            raise failure
        if not found:
            raise SimulationFailure(self.unsettled_message())

    def unsettled_message(self) -> str:
        """Return the message about walls with mass for which no position balances the forces on them."""
        names = ", ".join(repr(self.names[k]) for k in self.motion.bodies.at)
        return (
            f"walls with mass ({names}) have no position at which the forces of the nodes balance: nodes alternate "
            "between walls that push them the same way; reduce time.step, remove one of these walls, or limit it by "
            "'node_set'"
        )

    def _slope(
        self,
        nodes: np.ndarray,
        free: np.ndarray,
        correction: np.ndarray,
        stiffness: np.ndarray,
        walls: WallForces,
        time: float,
    ) -> np.ndarray:
        """Return the derivatives (w, 3, 3) [N/m] of the walls' forces on untied nodes by the walls' positions.

        Nodes (m,) at ``free`` (m, 3) without walls are moved by ``correction`` (m, 3) [m]. The normal force of a node
        that slips drags it by mu times itself against the slip, which turns with the wall; one that sticks follows the
        wall in all directions. Exact for nodes at one wall.
        """
        touching = walls.touching
        displacements = self.motion.displacements(time)
        acting = self.acting(nodes, free, displacements, self._part)
        normals, _ = self.planes(touching, walls.places, displacements, acting)
        if self.ties.any:
            touching = touching & ~self.ties.held[nodes][:, None]
        held = touching[:, :, None] & ~self.fixed[nodes][:, None, :]
        active = np.where(held, normals, 0.0)
        inverse = np.linalg.pinv(active, rcond=RANK) if len(nodes) else np.zeros((0, 3, len(self.walls)))
        weight = stiffness[:, None] * (inverse * inverse).sum(axis=1)  # the diagonal of k (N N^T)^-1
        weight = np.where(touching, weight, 0.0)
        slope = np.einsum("mw,mwi,mwj->wij", weight, normals, normals)
        if not self.has_friction:
            return slope
        way = displacements - self.motion.displacements(self.state.time)
        slip = (walls.places - self.state.position[nodes])[:, None, :] - way
        slip -= np.einsum("mwi,mwi->mw", slip, normals)[:, :, None] * normals
        size = np.linalg.norm(slip, axis=2)
        slips = size > PROJECTED * self.size
        slip /= np.where(slips, size, np.inf)[:, :, None]
        rough = np.where(touching, self.friction, 0.0)
        slope -= np.einsum("mw,mwi,mwj->wij", rough * weight, slip, normals)
        drag = rough * np.maximum(np.einsum("mwi,mi->mw", normals, correction), 0.0)  # over k
        turning = np.where(slips, drag / np.where(slips, size + drag, 1.0), self.static_friction > 0.0)
        sideways = (
            np.eye(3) - normals[:, :, :, None] * normals[:, :, None, :] - slip[:, :, :, None] * slip[:, :, None, :]
        )
        return slope + np.einsum("mw,mwi,mwij->wij", stiffness[:, None] * turning, held.astype(float), sideways)

    def project(
        self, x: np.ndarray, stiffness: np.ndarray, time: float, tolerance: float, booked: bool = True
    ) -> tuple:
        """Project free positions (owned, 3), in place, onto the region that the walls allow.

        ``booked`` : whether the step is final and not a trial. Returns the nodes (m,), their corrections (m, 3) [m],
        the forces on them (m, 3) [N], and the sums per wall.
        """
        ties = self.ties
        nodes, moved, force, touching, friction = self._press(x, stiffness, time, tolerance, booked)
        if ties.any:
            tied, walls, places, pull = ties.hold(x, stiffness, time)
            every = np.zeros((len(tied), len(self.walls), 3))
            every[np.arange(len(tied)), walls] = pull
            own = np.zeros(every.shape[:2], dtype=bool)
            own[np.arange(len(tied)), walls] = True
            nodes, moved = np.append(nodes, tied), np.vstack([moved, places])
            force, touching = np.vstack([force, every]), np.vstack([touching, own])
        if len(nodes) == 0:
            return nodes, moved, np.empty((0, 3)), self.nothing
        correction = moved - x[nodes]
        x[nodes] = moved
        return nodes, correction, force.sum(axis=1), self.sums(nodes, force, moved, touching, friction)

    def _press(self, x: np.ndarray, stiffness: np.ndarray, time: float, tolerance: float, booked: bool) -> tuple:
        """Return nodes (m,) near walls that are not tied to them, positions (m, 3), forces (m, w, 3), touching (m, w),
        and the energy that friction dissipates [J]."""
        displacements = self.motion.displacements(time)
        near = self.near(x, displacements)
        if self.rebounds:
            near |= self._returning()
        if self.ties.any:
            near &= ~self.ties.held
        nodes = np.flatnonzero(near)
        if len(nodes) == 0:
            walls = len(self.walls)
            return nodes, np.empty((0, 3)), np.empty((0, walls, 3)), np.empty((0, walls), dtype=bool), 0.0
        free = x[nodes]
        applicable = self.applicable(nodes, free, displacements)
        at = free
        rebounds = self._returning()[nodes] if self.rebounds else np.zeros(len(nodes), dtype=bool)
        pull = self._pull(nodes, free, time) if self.rebounds else free
        acting = self.acting(nodes, free, displacements, self._part)
        for _ in range(_CURVED_ROUNDS):
            normals, offsets = self.planes(applicable, at, displacements, acting)
            if rebounds.any():
                offsets[rebounds] += self._rebound(nodes[rebounds], normals[rebounds], pull[rebounds])
            moved, multipliers = free.copy(), np.zeros(offsets.shape)
            infeasible = project(moved, self.fixed[nodes], normals, offsets, tolerance, multipliers)
            if infeasible >= 0:
                raise SimulationFailure(self.infeasible_message(nodes[infeasible], offsets[infeasible]))
            if self.flat.all() or np.abs(moved - at).max() <= tolerance:
                break
            at = moved
        else:
            node = self.mesh.node_ids[nodes[np.argmax(np.abs(moved - at).max(axis=1))]]
            raise SimulationFailure(
                f"the position of node {node} on curved walls did not converge in {_CURVED_ROUNDS} "
                "iterations: walls and supports may be infeasible together; move the walls apart, free the node, or "
                "reduce time.step"
            )
        strength = multipliers * stiffness[nodes][:, None]
        force = strength[:, :, None] * normals
        friction = 0.0
        if self.has_friction:
            moved, force, friction = self._apply_friction(
                nodes, free, displacements, (normals, offsets, acting), stiffness[nodes], moved, strength
            )
        if booked and self.rebounds:
            self._remember_impacts(nodes, free, moved, pull, displacements, normals, strength)
        return nodes, moved, force, np.einsum("mwi,mwi->mw", force, normals) > 0.0, friction

    def _returning(self) -> np.ndarray:
        """Return (owned,) bool: nodes that hit a wall with restitution in the last step."""
        squares = self.state.memory.get("rebound")
        return (squares > 0.0).any(axis=1) if squares is not None else np.zeros(len(self.members), dtype=bool)

    def _pull(self, nodes: np.ndarray, free: np.ndarray, time: float) -> np.ndarray:
        """Return the part (m, 3) of the nodes' displacements without walls that is due to forces [m]."""
        state = self.state
        as_before = state.memory["half_velocity"][nodes] * (time - state.time)
        return free - state.position[nodes] - as_before

    def _rebound(self, nodes: np.ndarray, normals: np.ndarray, pull: np.ndarray) -> np.ndarray:
        """Return the distances (m, walls) [m] that nodes reach in this step from walls they hit in the last one."""
        memory = self.state.memory
        squares, arrivals = memory["rebound"][nodes], memory["arrival"][nodes]
        towards = -np.einsum("mwi,mi->mw", normals, pull)
        way = rebound_way(self.restitution, squares, arrivals, towards) - 0.5 * towards
        return np.where(squares > 0.0, np.maximum(way, 0.0), 0.0)

    def _remember_impacts(
        self,
        nodes: np.ndarray,
        free: np.ndarray,
        moved: np.ndarray,
        pull: np.ndarray,
        displacements: np.ndarray,
        normals: np.ndarray,
        strength: np.ndarray,
    ) -> None:
        """Record which nodes hit a wall with restitution in this step; see :mod:`~pfem_petsc.contact.explicit`."""
        state = self.state
        shape = len(self.members), len(self.walls)
        squares, arrivals = (state.memory.setdefault(name, np.zeros(shape)) for name in ("rebound", "arrival"))
        way = displacements - self.motion.displacements(state.time)
        unpushed = way.copy()
        bodies = self.motion.bodies
        if bodies.any:  # use the motion without the recoil of the wall
            unpushed[bodies.at] = bodies.unpushed() - bodies.state.x
        start = state.position[nodes]
        approach = -np.einsum("mwi,mwi->mw", normals, (free - start)[:, None, :] - unpushed)
        arrival = -np.einsum("mwi,mwi->mw", normals, (moved - start)[:, None, :] - way)
        towards = -np.einsum("mwi,mi->mw", normals, pull)
        fresh = (strength > 0.0) & ~self.log.touching[nodes] & (self.restitution > 0.0)
        squares[:], arrivals[:] = 0.0, 0.0
        squares[nodes] = np.where(fresh, impact_square(approach, arrival, towards), 0.0)
        arrivals[nodes] = np.where(fresh, arrival, 0.0)

    def _apply_friction(
        self,
        nodes: np.ndarray,
        free: np.ndarray,
        displacements: np.ndarray,
        planes: tuple[np.ndarray, np.ndarray, np.ndarray | None],
        stiffness: np.ndarray,
        moved: np.ndarray,
        strength: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, float]:
        """Return positions (m, 3) and forces (m, w, 3) with friction, and the energy that it dissipates [J].

        Curved walls are represented by planes at the result, along the directions of ``acting``.
        """
        state = self.state
        way = displacements - self.motion.displacements(state.time)
        before, fixed = state.position[nodes], self.fixed[nodes]
        normals, offsets, acting = planes
        applicable = offsets > -np.inf
        tolerance = PROJECTED * self.size
        for _ in range(_CURVED_ROUNDS):
            at, normal_forces, drag = moved.copy(), strength.copy(), np.zeros(normals.shape)
            rough = self.friction, self.static_friction
            rubbing = Rubbing(before, way, fixed, normals, offsets, *rough, stiffness)
            unsettled = add_friction(rubbing, at, normal_forces, drag)
            if unsettled >= 0:
                raise SimulationFailure(self.unsettled_friction(nodes[unsettled], normals[unsettled]))
            if self.flat.all():
                break
            there, distances = self.planes(applicable, at, displacements, acting)
            apart = np.abs(distances[applicable] - offsets[applicable]).max(initial=0.0)
            if np.abs(there - normals).max() <= 1e-14 and apart <= tolerance:
                break
            normals, offsets = there, distances
            moved, multipliers = free.copy(), np.zeros(offsets.shape)
            project(moved, fixed, normals, offsets, tolerance, multipliers)
            strength = multipliers * stiffness[:, None]
        friction = -float((drag * (at[:, None, :] - before[:, None, :] - way)).sum())
        return at, normal_forces[:, :, None] * normals + drag, friction

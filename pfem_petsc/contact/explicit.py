"""Contact in explicit steps: a small problem per node, with curved walls, walls with mass, friction and restitution."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..errors import SimulationFailure
from ..tolerances import FIXED_POINT, PROJECTED, RANK
from .flat import press_planes
from .forces import WallForces
from .friction import add_friction
from .jamming import jam
from .projection import project
from .rebound import impact_square, rebound_way

if TYPE_CHECKING:
    from .contact import Contact

__all__ = ["ExplicitContact"]

_CURVED_ROUNDS = 100  # projections of a step until tangent planes and positions agree


class ExplicitContact:
    """Projects free positions onto the region that the walls of a :class:`~pfem_petsc.contact.contact.Contact` allow.

    Attributes
    ----------
    plain : infinite flat walls without friction, restitution or ties: one compiled pass handles them
    """

    def __init__(self, contact: Contact) -> None:
        self.contact = contact
        plain = contact.flat.all() and not (contact.has_friction or contact.partial or contact.ties.any)
        self.plain = bool(plain and not contact.restitution.any())
        self._part = 1.0  # see Contact.acting
        self._room = np.empty(len(contact.members) if plain else 0, dtype=np.int64)

    def press(
        self,
        predictor: np.ndarray,
        u: np.ndarray,
        stiffness: np.ndarray,
        time: float,
        tolerance: float,
        part: float,
    ) -> tuple[np.ndarray, np.ndarray, WallForces]:
        """See :meth:`~pfem_petsc.contact.contact.Contact.explicit`."""
        contact, self._part = self.contact, part
        if contact.motion.free is not None:
            self.push_walls(predictor + u, stiffness, time, tolerance)
        if self.plain:
            return self._press_planes(predictor, u, stiffness, time, tolerance)
        nodes, correction, force, walls = self.project(predictor + u, stiffness, time, tolerance)
        u[nodes] += correction
        return nodes, force, walls

    def _press_planes(
        self, predictor: np.ndarray, u: np.ndarray, stiffness: np.ndarray, time: float, tolerance: float
    ) -> tuple:
        contact = self.contact
        offsets = contact.plane_offsets(time)
        nodes, infeasible, offsets, force, touching, places, *sums = press_planes(
            predictor,
            u,
            contact.fixed,
            contact.normals,
            offsets,
            contact.all_nodes,
            contact.members,
            tolerance,
            stiffness,
            self._room,
        )
        if infeasible >= 0:
            raise SimulationFailure(contact.infeasible_message(nodes[infeasible], offsets[infeasible]))
        if len(nodes) == 0:
            return nodes, force, contact.nothing
        return nodes, force, WallForces(*sums, nodes, touching, places)

    def push_walls(self, x: np.ndarray, stiffness: np.ndarray, time: float, tolerance: float) -> None:
        """Find the final positions of walls with mass in an explicit step. Collective."""
        free = self.contact.motion.free
        failure: SimulationFailure | None = None

        def forces() -> tuple[np.ndarray, np.ndarray]:
            nonlocal failure
            try:
                nodes, correction, _, walls = self.project(x.copy(), stiffness, time, tolerance, booked=False)
            except SimulationFailure as met:  # raised once all ranks have left the iteration
                failure = failure or met
                return np.zeros((len(free.at), 3)), np.zeros((len(free.at), 3, 3))
            slope = self._slope(nodes, x[nodes], correction, stiffness[nodes], walls, time)
            if self.contact.ties.any:
                tied, at = self.contact.ties.nodes()
                gives = stiffness[tied, None] * ~self.contact.fixed[tied]
                np.add.at(slope, at, gives[:, :, None] * np.eye(3))
            return walls.force[free.at], slope[free.at]

        found = free.solve(forces, FIXED_POINT * self.contact.size)
        if failure is not None:
            raise failure
        if not found:
            raise SimulationFailure(self.contact.unsettled_message())

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
        contact, touching = self.contact, walls.touching
        displacements = contact.motion.displacements(time)
        acting = contact.acting(nodes, free, displacements, self._part)
        normals, _ = contact.planes(touching, walls.places, displacements, acting)
        if contact.ties.any:
            touching = touching & ~contact.ties.held[nodes][:, None]
        held = touching[:, :, None] & ~contact.fixed[nodes][:, None, :]
        active = np.where(held, normals, 0.0)
        inverse = np.linalg.pinv(active, rcond=RANK) if len(nodes) else np.zeros((0, 3, len(contact.walls)))
        weight = stiffness[:, None] * (inverse * inverse).sum(axis=1)  # the diagonal of k (N N^T)^-1
        weight = np.where(touching, weight, 0.0)
        slope = np.einsum("mw,mwi,mwj->wij", weight, normals, normals)
        if not contact.has_friction:
            return slope
        way = displacements - contact.motion.displacements(contact.state.time)
        slip = (walls.places - contact.state.position[nodes])[:, None, :] - way
        slip -= np.einsum("mwi,mwi->mw", slip, normals)[:, :, None] * normals
        size = np.linalg.norm(slip, axis=2)
        slips = size > PROJECTED * contact.size
        slip /= np.where(slips, size, np.inf)[:, :, None]
        rough = np.where(touching, contact.friction, 0.0)
        slope -= np.einsum("mw,mwi,mwj->wij", rough * weight, slip, normals)
        drag = rough * np.maximum(np.einsum("mwi,mi->mw", normals, correction), 0.0)  # over k
        turning = np.where(slips, drag / np.where(slips, size + drag, 1.0), contact.static_friction > 0.0)
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
        contact, ties = self.contact, self.contact.ties
        nodes, moved, force, touching, friction = self._press(x, stiffness, time, tolerance, booked)
        if ties.any:
            tied, walls, places, pull = ties.hold(x, stiffness, time)
            every = np.zeros((len(tied), len(contact.walls), 3))
            every[np.arange(len(tied)), walls] = pull
            own = np.zeros(every.shape[:2], dtype=bool)
            own[np.arange(len(tied)), walls] = True
            nodes, moved = np.append(nodes, tied), np.vstack([moved, places])
            force, touching = np.vstack([force, every]), np.vstack([touching, own])
        if len(nodes) == 0:
            return nodes, moved, np.empty((0, 3)), contact.nothing
        correction = moved - x[nodes]
        x[nodes] = moved
        return nodes, correction, force.sum(axis=1), contact.sums(nodes, force, moved, touching, friction)

    def _press(self, x: np.ndarray, stiffness: np.ndarray, time: float, tolerance: float, booked: bool) -> tuple:
        """Return nodes (m,) near walls that are not tied to them, positions (m, 3), forces (m, w, 3), touching (m, w),
        and the energy that friction dissipates [J]."""
        displacements = self.contact.motion.displacements(time)
        near = self.contact.near(x, displacements)
        if self.contact.rebounds:
            near |= self._returning()
        if self.contact.ties.any:
            near &= ~self.contact.ties.held
        nodes = np.flatnonzero(near)
        if len(nodes) == 0:
            walls = len(self.contact.walls)
            return nodes, np.empty((0, 3)), np.empty((0, walls, 3)), np.empty((0, walls), dtype=bool), 0.0
        free = x[nodes]
        applicable = self.contact.applicable(nodes, free, displacements)
        at = free
        rebounds = self._returning()[nodes] if self.contact.rebounds else np.zeros(len(nodes), dtype=bool)
        pull = self._pull(nodes, free, time) if self.contact.rebounds else free
        acting = self.contact.acting(nodes, free, displacements, self._part)
        for _ in range(_CURVED_ROUNDS):
            normals, offsets = self.contact.planes(applicable, at, displacements, acting)
            if rebounds.any():
                offsets[rebounds] += self._rebound(nodes[rebounds], normals[rebounds], pull[rebounds])
            moved, multipliers = free.copy(), np.zeros(offsets.shape)
            infeasible = project(moved, self.contact.fixed[nodes], normals, offsets, tolerance, multipliers)
            if infeasible >= 0:
                raise SimulationFailure(self.contact.infeasible_message(nodes[infeasible], offsets[infeasible]))
            if self.contact.flat.all() or np.abs(moved - at).max() <= tolerance:
                break
            at = moved
        else:
            node = self.contact.mesh.node_ids[nodes[np.argmax(np.abs(moved - at).max(axis=1))]]
            raise SimulationFailure(
                f"the position of node {node} on curved walls did not converge in {_CURVED_ROUNDS} "
                "iterations: walls and supports may be infeasible together; move the walls apart, free the node, or "
                "reduce time.step"
            )
        strength = multipliers * stiffness[nodes][:, None]
        force = strength[:, :, None] * normals
        friction = 0.0
        if self.contact.has_friction:
            moved, force, friction = self._apply_friction(
                nodes, free, displacements, (normals, offsets, acting), stiffness[nodes], moved, strength
            )
        if booked and self.contact.rebounds:
            self._remember_impacts(nodes, free, moved, pull, displacements, normals, strength)
        return nodes, moved, force, np.einsum("mwi,mwi->mw", force, normals) > 0.0, friction

    def _returning(self) -> np.ndarray:
        """Return (owned,) bool: nodes that hit a wall with restitution in the last step."""
        squares = self.contact.state.memory.get("rebound")
        return (squares > 0.0).any(axis=1) if squares is not None else np.zeros(len(self.contact.members), dtype=bool)

    def _pull(self, nodes: np.ndarray, free: np.ndarray, time: float) -> np.ndarray:
        """Return the part (m, 3) of the nodes' displacements without walls that is due to forces [m]."""
        state = self.contact.state
        as_before = state.memory["half_velocity"][nodes] * (time - state.time)
        return free - state.position[nodes] - as_before

    def _rebound(self, nodes: np.ndarray, normals: np.ndarray, pull: np.ndarray) -> np.ndarray:
        """Return the distances (m, walls) [m] that nodes reach in this step from walls they hit in the last one."""
        memory = self.contact.state.memory
        squares, arrivals = memory["rebound"][nodes], memory["arrival"][nodes]
        towards = -np.einsum("mwi,mi->mw", normals, pull)
        way = rebound_way(self.contact.restitution, squares, arrivals, towards) - 0.5 * towards
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
        """Record which nodes hit a wall with restitution in this step; see :mod:`~pfem_petsc.contact.rebound`."""
        state = self.contact.state
        shape = len(self.contact.members), len(self.contact.walls)
        squares, arrivals = (state.memory.setdefault(name, np.zeros(shape)) for name in ("rebound", "arrival"))
        way = displacements - self.contact.motion.displacements(state.time)
        unpushed = way.copy()
        if self.contact.motion.free is not None:  # use the motion without the recoil of the wall
            at = self.contact.motion.free.at
            unpushed[at] = self.contact.motion.free.unpushed() - self.contact.motion.free.state.x
        start = state.position[nodes]
        approach = -np.einsum("mwi,mwi->mw", normals, (free - start)[:, None, :] - unpushed)
        arrival = -np.einsum("mwi,mwi->mw", normals, (moved - start)[:, None, :] - way)
        towards = -np.einsum("mwi,mi->mw", normals, pull)
        fresh = (strength > 0.0) & ~self.contact.log.touching[nodes] & (self.contact.restitution > 0.0)
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
        contact, state = self.contact, self.contact.state
        way = displacements - self.contact.motion.displacements(state.time)
        before, fixed = state.position[nodes], self.contact.fixed[nodes]
        normals, offsets, acting = planes
        applicable = offsets > -np.inf
        tolerance = PROJECTED * self.contact.size
        for _ in range(_CURVED_ROUNDS):
            at, normal_forces, drag = moved.copy(), strength.copy(), np.zeros(normals.shape)
            unsettled = add_friction(
                at,
                before,
                way,
                fixed,
                normals,
                offsets,
                self.contact.friction,
                self.contact.static_friction,
                stiffness,
                normal_forces,
                drag,
            )
            if unsettled >= 0:
                raise SimulationFailure(
                    jam(contact, nodes[unsettled], normals[unsettled])
                    or f"the friction of node {contact.mesh.node_ids[nodes[unsettled]]} on several walls did not "
                    "converge; reduce time.step"
                )
            if self.contact.flat.all():
                break
            there, distances = self.contact.planes(applicable, at, displacements, acting)
            apart = np.abs(distances[applicable] - offsets[applicable]).max(initial=0.0)
            if np.abs(there - normals).max() <= 1e-14 and apart <= tolerance:
                break
            normals, offsets = there, distances
            moved, multipliers = free.copy(), np.zeros(offsets.shape)
            project(moved, fixed, normals, offsets, tolerance, multipliers)
            strength = multipliers * stiffness[:, None]
        friction = -float((drag * (at[:, None, :] - before[:, None, :] - way)).sum())
        return at, normal_forces[:, :, None] * normals + drag, friction

"""Contact in explicit steps: a small problem per node, with flat and curved walls, walls with mass, friction and
restitution.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..errors import SimulationFailure
from ..mechanics.compiled import NEEDED, inlined, kernel
from ..mechanics.records import by_reference, record
from ..mesh.ordering import NODE_BLOCK
from ..tolerances import FIXED_POINT, PROJECTED, RANK
from .friction import Rubbing, add_friction, jam
from .node_walls import TURN, NodeWalls, WallForces
from .projection import project
from .rotations import across
from .surfaces import OTHER, Surfaces, is_round, tangent
from .tied import Ties

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..integrators.base import Balance
    from ..mesh.distribution import DistributedMesh
    from .wall_motion import Poses
    from .walls.base import WallKeys


INFEASIBLE, ADRIFT, JAMMED = range(1, 4)
"""Why the place of a node is not found: no position satisfies its walls, the planes of round walls do not settle, or
its friction has no solution."""

_CURVED_ROUNDS = 100  # projections of a step until tangent planes and positions agree
_LEAST_PART, _LARGEST_PART = 0.02, 8.0  # of the way to the next position whose planes are tried
_ROOT = 1e-14  # relative error of squares, more than those of sums of three and of a root


@record
class PressedWalls(NamedTuple):
    """Slots (w,) of walls, see :class:`~pfem_petsc.contact.node_walls.NodeWalls`, and the nodes (n,) that they can stop
    in a step.

    Attributes
    ----------
    surfaces : Surfaces at its end
    part : see :meth:`~pfem_petsc.contact.node_walls.NodeWalls.acting`
    all_nodes : (w,) bool, whether a wall applies to all nodes; members : (n, w) bool, to which nodes otherwise
    tolerance : a wall violated by at most this counts as satisfied [m]
    room : (n,) int64, workspace
    wall_of : (w,) the wall of each slot
    way : (w, 3) displacements in the step [m] of walls that do not turn; pushed : how far nodes push them (w, 3) [m]
    friction : (2, w) coefficients of dynamic and static friction; (2, 0) if all are zero
    restitution : (w,) coefficients, (0,) if all are zero
    rebound, arrival : (n, w) memory of the last step of nodes that hit walls; (0, w) without restitution
    """

    surfaces: Surfaces
    part: float
    all_nodes: np.ndarray
    members: np.ndarray
    tolerance: float
    room: np.ndarray
    wall_of: np.ndarray
    way: np.ndarray
    pushed: np.ndarray
    friction: np.ndarray
    restitution: np.ndarray
    rebound: np.ndarray
    arrival: np.ndarray


class Arrivals(NamedTuple):
    """Nodes (m,) at walls (w,) in a step.

    Attributes
    ----------
    start : (m, 3) positions at its start [m]
    ways : (m, w, 3) how far walls carry their points from there [m]
    drift : (m, 3) how far they would move without forces [m]
    stiffness : (m,) force for a displacement of each [N/m]
    fixed : (m, 3) bool, components that supports prescribe
    applies : (m, w) bool, walls that can stop each
    touching : (m, w) bool, contacts of the last step
    rebound, arrival : (m, w) memory of the last step of nodes that hit walls, in which :func:`press_nodes` leaves that
        of this one, see :func:`impact_square`; (m, 0) without restitution
    normals, offsets : (m, w, 3), (m, w) tangent planes of walls of other shapes; (0, w, 3), (0, w) without such walls
    """

    start: np.ndarray
    ways: np.ndarray
    drift: np.ndarray
    stiffness: np.ndarray
    fixed: np.ndarray
    applies: np.ndarray
    touching: np.ndarray
    rebound: np.ndarray
    arrival: np.ndarray
    normals: np.ndarray
    offsets: np.ndarray


class WallSums(NamedTuple):
    """Of each wall ``force`` (w, 3) [N], number of ``contacts`` (w,), and ``moment`` about the origin (w, 3) [N m]."""

    force: np.ndarray
    contacts: np.ndarray
    moment: np.ndarray


@kernel
def find_penetrating(free, walls, marked):
    """Write the nodes whose positions ``free`` (3, n) lie beyond :class:`PressedWalls` to their room; return their
    number. Nodes that rebound are among them in blocks that are ``marked`` (blocks,) bool."""
    n, m = free.shape[1], np.int64(0)
    xs, ys, zs = free[0], free[1], free[2]
    for first in range(0, n, NODE_BLOCK):
        last, returning = min(first + NODE_BLOCK, n), marked[first // NODE_BLOCK]
        if returning or _any_beyond(xs, ys, zs, first, last, walls.surfaces):
            m = _list_penetrating(free, first, last, walls, returning, m)
    return m


@inlined
def _any_beyond(xs, ys, zs, first, last, surfaces):
    """Return whether any of consecutive nodes is beyond a wall, to whichever nodes it applies."""
    normals, offsets, radii = surfaces.normals, surfaces.offsets, surfaces.radii
    centres, axes = surfaces.centres, surfaces.axes
    beyond = 0
    for k in range(len(radii)):  # without branches
        if radii[k] == 0.0:
            nx, ny, nz, offset = normals[k, 0], normals[k, 1], normals[k, 2], offsets[k]
            for i in range(first, last):
                gap = -offset + nx * xs[i] + ny * ys[i] + nz * zs[i]
                beyond += 1 if gap < 0.0 else 0
            continue
        if not is_round(radii[k]):
            continue
        # without roots
        cx, cy, cz, ax, ay, az = centres[k, 0], centres[k, 1], centres[k, 2], axes[k, 0], axes[k, 1], axes[k, 2]
        side = 1.0 if radii[k] > 0.0 else -1.0
        limit = radii[k] * radii[k] * (1.0 + side * _ROOT)
        for i in range(first, last):
            x, y, z = xs[i] - cx, ys[i] - cy, zs[i] - cz
            along = x * ax + y * ay + z * az
            x -= along * ax
            y -= along * ay
            z -= along * az
            beyond += 1 if side * (x * x + y * y + z * z - limit) < 0.0 else 0
    return beyond > 0


@inlined
def _list_penetrating(free, first, last, walls, returning, m):
    """Append those of consecutive nodes that are beyond a wall that applies to them, or rebound, to the ``m`` found."""
    surfaces, all_nodes, members = walls.surfaces, walls.all_nodes, walls.members
    radii = surfaces.radii
    for i in range(first, last):
        for k in range(len(radii)):
            gap = 0.0
            if radii[k] != OTHER:
                _, _, _, gap = tangent(k, surfaces, free[0, i], free[1, i], free[2, i])
            if (gap < 0.0 and (all_nodes[k] or members[i, k])) or (returning and walls.rebound[i, k] > 0.0):
                walls.room[m] = i
                m += 1
                break
    return m


@inlined
def _directions(free, walls, given):
    """Return the directions (m, w, 3) of :meth:`~pfem_petsc.contact.node_walls.NodeWalls.acting` of nodes at (m, 3)."""
    surfaces, ways, part, start = walls.surfaces, given.ways, walls.part, given.start
    m, w = len(free), len(surfaces.radii)
    directions = np.zeros((m, w, 3))
    for j in range(m):
        x, y, z = free[j, 0], free[j, 1], free[j, 2]
        for k in range(w):
            if not is_round(surfaces.radii[k]):
                continue
            bx, by, bz = start[j, 0] + ways[j, k, 0], start[j, 1] + ways[j, k, 1], start[j, 2] + ways[j, k, 2]
            there = bx + part * (x - bx), by + part * (y - by), bz + part * (z - bz)
            nx, ny, nz, _ = tangent(k, surfaces, there[0], there[1], there[2])
            ex, ey, ez, _ = tangent(k, surfaces, x, y, z)
            if nx * ex + ny * ey + nz * ez > TURN:
                directions[j, k, 0], directions[j, k, 1], directions[j, k, 2] = nx, ny, nz
    return directions


class _Planes(NamedTuple):
    """Tangent planes at nodes (m,): see :class:`~pfem_petsc.contact.friction.Rubbing`; ``directions`` (m, w, 3) in
    which round walls push, zero for normals, (0, w, 3) for none; ``pull`` (m, w) by forces, towards the walls [m]."""

    normals: np.ndarray
    offsets: np.ndarray
    directions: np.ndarray
    pull: np.ndarray


@inlined
def _set_planes(j, at, free, walls, given, planes):
    """Set the planes of the j-th node at positions ``at`` (m, 3); it is ``free`` (m, 3) to move there."""
    surfaces, restitution, rebound, arrival = walls.surfaces, walls.restitution, given.rebound, given.arrival
    normals, offsets, directions, pull = planes
    start, drift, every = given.start, given.drift, surfaces.normals
    x, y, z = at[j, 0], at[j, 1], at[j, 2]
    for k in range(offsets.shape[1]):
        radius = surfaces.radii[k]
        if radius == 0.0:
            nx, ny, nz, offset = every[k, 0], every[k, 1], every[k, 2], surfaces.offsets[k]
        elif radius == OTHER:
            nx, ny, nz = given.normals[j, k, 0], given.normals[j, k, 1], given.normals[j, k, 2]
            offset = given.offsets[j, k]
        else:
            nx, ny, nz, gap = tangent(k, surfaces, x, y, z)
            if len(directions) > 0:
                dx, dy, dz = directions[j, k, 0], directions[j, k, 1], directions[j, k, 2]
                if dx != 0.0 or dy != 0.0 or dz != 0.0:
                    nx, ny, nz = dx, dy, dz
            offset = nx * x + ny * y + nz * z - gap
        normals[j, k, 0], normals[j, k, 1], normals[j, k, 2] = nx, ny, nz
        offsets[j, k] = offset if given.applies[j, k] else -math.inf
        if len(restitution) > 0:
            q = 0.0
            for c in range(3):
                q -= normals[j, k, c] * (free[j, c] - start[j, c] - drift[j, c])
            pull[j, k] = q
            if rebound[j, k] > 0.0:
                whole = max(rebound[j, k] + q * arrival[j, k] + 0.25 * q * q, 0.0)
                offsets[j, k] += max(restitution[k] * math.sqrt(whole) - 0.5 * q, 0.0)


@inlined
def _meets_round(j, x, strengths, walls, given):
    """Return whether a round wall pushes the j-th node to its position (m, 3), or would stop it there."""
    surfaces, bounces = walls.surfaces, len(walls.restitution) > 0
    for k in range(strengths.shape[1]):
        if is_round(surfaces.radii[k]) and given.applies[j, k]:
            _, _, _, gap = tangent(k, surfaces, x[j, 0], x[j, 1], x[j, 2])
            if strengths[j, k] > 0.0 or gap < 0.0 or (bounces and given.rebound[j, k] > 0.0):
                return True
    return False


@inlined
def _settle_on_round(j, x, free, strengths, walls, given, planes):
    """Move the j-th node, projected to x (m, 3), until tangent planes and positions agree; return ``INFEASIBLE``,
    ``ADRIFT``, or 0."""
    at = np.empty(3)
    for c in range(3):
        at[c] = free[j, c]
    fixed, normals, offsets = given.fixed[j : j + 1], planes.normals[j : j + 1], planes.offsets[j : j + 1]
    for _ in range(_CURVED_ROUNDS):
        change = 0.0
        for c in range(3):
            change = max(change, abs(x[j, c] - at[c]))
            at[c] = x[j, c]
        if change <= walls.tolerance or not _meets_round(j, x, strengths, walls, given):
            return 0
        _set_planes(j, x, free, walls, given, planes)
        for c in range(3):
            x[j, c] = free[j, c]
        if project(x[j : j + 1], fixed, normals, offsets, walls.tolerance, strengths[j : j + 1]) >= 0:
            return INFEASIBLE
    return ADRIFT


@inlined
def _rub_on_round(j, x, free, drag, strengths, walls, given, planes):
    """Repeat the friction of the j-th node, at x (m, 3), with the planes of other positions until it stays at the
    position of its planes; return whether it was found. Positions are those of Aitken's relaxation: in large steps, the
    positions of friction alone alternate or creep."""
    normals, offsets, stiffness = planes.normals[j : j + 1], planes.offsets[j : j + 1], given.stiffness[j : j + 1]
    rough = walls.friction[0], walls.friction[1]
    before, ways, fixed = given.start[j : j + 1], given.ways[j : j + 1], given.fixed[j : j + 1]
    rubbing = Rubbing(before, ways, fixed, normals, offsets, *rough, stiffness)
    at, last, part, near = np.empty(3), np.zeros(3), 1.0, False
    earlier, distances = np.empty((offsets.shape[1], 3)), np.empty(offsets.shape[1])
    for c in range(3):
        at[c] = x[j, c]
    for _ in range(_CURVED_ROUNDS):
        if not _meets_round(j, x, strengths, walls, given):
            return True
        for k in range(len(distances)):
            distances[k] = offsets[0, k]
            for c in range(3):
                earlier[k, c] = normals[0, k, c]
        _set_planes(j, x, free, walls, given, planes)
        turn, apart = 0.0, 0.0
        for k in range(len(distances)):
            for c in range(3):
                turn = max(turn, abs(normals[0, k, c] - earlier[k, c]))
            if distances[k] > -math.inf:
                apart = max(apart, abs(offsets[0, k] - distances[k]))
        if turn <= 1e-14 and apart <= walls.tolerance:
            return True
        along = square = largest = 0.0
        for c in range(3):
            change = x[j, c] - at[c] - last[c]
            along -= last[c] * change
            square += change * change
            last[c] += change
            largest = max(largest, abs(last[c]))
        if largest > 0.0 and largest <= walls.tolerance:
            if near:  # the rest is rounding
                return True
            near = True
        if along > 0.0:
            part = min(max(part * along / square, _LEAST_PART), _LARGEST_PART)
        elif along < 0.0:
            part = 0.5
        for c in range(3):
            at[c] += part * last[c]
            x[j, c] = at[c]
        _set_planes(j, x, free, walls, given, planes)
        for c in range(3):
            x[j, c] = free[j, c]
        project(x[j : j + 1], rubbing.fixed, normals, offsets, walls.tolerance, strengths[j : j + 1])
        for k in range(len(distances)):
            strengths[j, k] *= stiffness[0]
        if add_friction(rubbing, x[j : j + 1], strengths[j : j + 1], drag[j : j + 1]) >= 0:
            return False
    return False


def kind_of(walls: PressedWalls) -> tuple[Any, Any, Any]:
    """Return whether any walls are curved, whether any are rough, and whether there are several: ``NEEDED`` or None."""
    radii = walls.surfaces.radii
    return tuple(
        NEEDED if kind else None for kind in (is_round(radii).any(), walls.friction.shape[1] > 0, len(radii) > 1)
    )


@kernel
def press_nodes(places, given, walls, sums, curved, rough, several):
    """Project nodes at ``places`` (m, 3) [m], in place, onto :class:`PressedWalls`, with friction and restitution,
    and add the forces of the walls to ``sums``, see :class:`WallSums`; ``given``: :class:`Arrivals`;
    ``curved``, ``rough``, ``several``: see :func:`kind_of`.

    Each node is solved for by itself: its bits do not depend on the others. Returns the index of the first node
    without a place, or -1, and why; the planes at the nodes, with offset -inf where a wall does not apply; the
    total force (m, 3) [N]; walls that they touch (m, w); and the energy that friction dissipates [J].
    """
    wall_of, pushed, tolerance, restitution = walls.wall_of, walls.pushed, walls.tolerance, walls.restitution
    force, contacts, moment = sums.force, sums.contacts, sums.moment
    start, ways, stiffness, fixed = given.start, given.ways, given.stiffness, given.fixed
    m, w = given.applies.shape
    bounces = len(restitution) > 0
    free = places.copy()
    directions = np.empty((0, w, 3))
    if curved is not None:  # noqa: SIM102 - what is not needed is not compiled
        if walls.part < 1.0:
            directions = _directions(free, walls, given)
    planes = _Planes(np.empty((m, w, 3)), np.empty((m, w)), directions, np.empty((m if bounces else 0, w)))
    normals, pull = planes.normals, planes.pull
    for j in range(m):
        _set_planes(j, free, free, walls, given, planes)
    strengths = np.zeros((m, w))
    failed, why = project(places, fixed, normals, planes.offsets, tolerance, strengths, several), 0
    if failed >= 0:
        why = INFEASIBLE
    if curved is not None:
        for j in range(m):
            wrong = _settle_on_round(j, places, free, strengths, walls, given, planes)
            if wrong > 0 and (failed < 0 or wrong < why or (wrong == why and j < failed)):
                failed, why = j, wrong
    smooth, stopped = np.empty((m if bounces else 0, 3)), np.empty((m if bounces else 0, w), dtype=np.bool_)
    for j in range(len(stopped)):
        for c in range(3):
            smooth[j, c] = places[j, c]
        for k in range(w):
            stopped[j, k] = strengths[j, k] > 0.0
    for j in range(m):
        for k in range(w):
            strengths[j, k] *= stiffness[j]
    drag = np.zeros((m, w, 3))
    if rough is not None:
        rubbing = Rubbing(start, ways, fixed, normals, planes.offsets, walls.friction[0], walls.friction[1], stiffness)
        unsettled = add_friction(rubbing, places, strengths, drag)
        if curved is not None:
            for j in range(m if failed < 0 else 0):
                if not _rub_on_round(j, places, free, drag, strengths, walls, given, planes):
                    unsettled = min(unsettled, j) if unsettled >= 0 else j
        if unsettled >= 0 and failed < 0:
            failed, why = unsettled, JAMMED
    for j in range(m if bounces else 0):
        for k in range(w):
            fresh = stopped[j, k] and not given.touching[j, k] and restitution[k] > 0.0
            approach = arrived = 0.0
            for c in range(3):
                approach -= normals[j, k, c] * (free[j, c] - start[j, c] - (ways[j, k, c] - pushed[k, c]))
                arrived -= normals[j, k, c] * (smooth[j, c] - start[j, c] - ways[j, k, c])
            square = max(approach * approach - pull[j, k] * (approach - arrived), 0.0)
            given.rebound[j, k] = square if fresh and approach > 0.0 else 0.0
            given.arrival[j, k] = arrived if fresh else 0.0
    total = np.zeros((m, 3))
    touching = np.zeros((m, w), dtype=np.bool_)
    dissipated = 0.0
    arm = np.empty(3)
    for j in range(m):
        for c in range(3):  # where the forces of the balance act
            arm[c] = start[j, c] + walls.part * (places[j, c] - start[j, c])
        x, y, z = arm
        for k in range(w):
            strength = strengths[j, k]
            if strength == 0.0:
                continue
            fx, fy, fz = strength * normals[j, k, 0], strength * normals[j, k, 1], strength * normals[j, k, 2]
            if rough is not None:
                fx += drag[j, k, 0]
                fy += drag[j, k, 1]
                fz += drag[j, k, 2]
                for c in range(3):
                    dissipated -= drag[j, k, c] * (places[j, c] - start[j, c] - ways[j, k, c])
            total[j, 0] += fx
            total[j, 1] += fy
            total[j, 2] += fz
            wall = wall_of[k]
            force[wall, 0] += fx
            force[wall, 1] += fy
            force[wall, 2] += fz
            moment[wall, 0] += y * fz - z * fy
            moment[wall, 1] += z * fx - x * fz
            moment[wall, 2] += x * fy - y * fx
            touching[j, k] = True
            contacts[wall] += 1
            for earlier in range(k):  # a node in several slots of a wall counts once
                if wall_of[earlier] == wall and touching[j, earlier]:
                    contacts[wall] -= 1
                    break
    return failed, why, planes, total, touching, dissipated


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


class ExplicitContact(NodeWalls):
    """Walls that project free positions onto the region that they allow.

    Attributes
    ----------
    ties : Ties
    plain : infinite flat walls, spheres and cylinders without ties: compiled passes handle them alone
    room : (owned,) int64, where compiled passes list the nodes beyond the former; (0,) without walls
    called : (walls,) bool, other walls and those that turn; at_rest : Surfaces of all walls (walls,) if none turned
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
        self._unmoved = np.zeros((len(self.wall_of), 3))
        self.pushes = np.zeros((2, len(self.walls), 3))  # known forces of walls on bars, and their moments
        self.plain = bool((self.surfaces.radii != OTHER).all()) and not (self.partial or self.ties.any)
        self.called = self.surfaces.radii[self.first] == OTHER
        self.at_rest = Surfaces.of(self.walls, np.zeros(len(self.walls), dtype=bool))
        self._part = 1.0  # see :meth:`acting`
        self.room = np.empty(len(self.members) if self.any else 0, dtype=np.int64)

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
        self._part, x = part, predictor + u
        if self.motion.bodies.any:
            self.push_walls(x, stiffness, time, tolerance)
        try:
            nodes, correction, force, walls = self.project(x, stiffness, time, tolerance)
        except SimulationFailure:  # until other ranks know of it, the other nodes stay at walls
            u[:] = x - predictor
            raise
        u[nodes] += correction
        return nodes, force, walls

    def placeless(self, node: int, why: int, normals: np.ndarray, offsets: np.ndarray) -> str:
        """Return the message about an owned node whose place :func:`press_nodes` did not find; its planes (w, 3),
        (w,)."""
        if why == INFEASIBLE:
            return self.infeasible_message(node, offsets)
        if why == JAMMED:
            return self.unsettled_friction(node, normals)
        return (
            f"the position of node {self.mesh.node_ids[node]} on curved walls did not converge in {_CURVED_ROUNDS} "
            "iterations: walls and supports may be infeasible together; move the walls apart, free the node, or "
            "reduce time.step"
        )

    def unsettled_friction(self, node: int, normals: np.ndarray) -> str:
        """Return the message about an owned node without a solution of its friction at walls with ``normals`` (w,
        3)."""
        return jam(self, node, normals) or (
            f"the friction of node {self.mesh.node_ids[node]} on its walls did not converge; reduce time.step"
        )

    def pressed_walls(self, surfaces: Surfaces, part: float, tolerance: float, way: np.ndarray) -> PressedWalls:
        """Return walls for compiled passes, see :class:`PressedWalls`."""
        members = self.members
        friction = np.array([self.friction, self.static_friction]) if self.has_friction else np.empty((2, 0))
        memory = 2 * [np.empty((0, len(self.wall_of)))]
        if self.rebounds:
            memory = [self.state.memory.setdefault(name, np.zeros(members.shape)) for name in ("rebound", "arrival")]
        restitution, pushed = self.restitution if self.rebounds else np.empty(0), self._unmoved
        bodies = self.motion.bodies
        if bodies.any:
            pushes = np.zeros((len(self.walls), 3))
            pushes[bodies.at] = bodies.displacements(np.inf) - bodies.unpushed()[0]
            pushed = pushes[self.wall_of]
        sets, moved = (self.all_nodes, members), (self.wall_of, way, pushed)
        return PressedWalls(surfaces, part, *sets, tolerance, self.room, *moved, friction, restitution, *memory)

    def push_walls(self, x: np.ndarray, stiffness: np.ndarray, time: float, tolerance: float) -> None:
        """Find the final positions of walls with mass in an explicit step. Collective."""
        free = self.motion.bodies
        failure: SimulationFailure | None = None

        def forces() -> tuple[np.ndarray, np.ndarray]:
            nonlocal failure
            try:
                nodes, correction, _, walls = self.project(x, stiffness, time, tolerance, booked=False)
            except SimulationFailure as met:  # raised once all ranks have left the iteration
                failure = failure or met
                return np.zeros((2, len(free.at), 3)), np.zeros((len(free.at), 6, 6))
            slopes = self._slope(nodes, x[nodes], correction, stiffness[nodes], walls, time)
            pushes = np.stack([walls.force, walls.moment])
            return (pushes + self.pushes)[:, free.at], self._by_twists(slopes, nodes, walls.places)

        found = free.solve(forces, FIXED_POINT * self.size)
        if failure is not None:
            raise failure
        if not found:
            raise SimulationFailure(self.unsettled_message())

    def _set_rebounds(self, memory: list[np.ndarray], planes: Any, relative: np.ndarray) -> None:
        """Set the memory (m, slots) of nodes that hit walls with inertia; ``relative`` (m, slots, 3): their ways beside
        those of the walls without contact [m]."""
        bodies, (rebound, arrival) = self.motion.bodies, memory
        fresh = np.isin(self.wall_of, bodies.at[bodies.turners]) & ((arrival != 0.0) | (rebound > 0.0))
        approach = -np.einsum("mwi,mwi->mw", planes.normals, relative)
        np.copyto(rebound, impact_square(approach, arrival, planes.pull), where=fresh)

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
        """Return the derivatives (m, slots, 3, 3) [N/m] of the walls' forces on nodes by the walls' positions.

        Nodes (m,) at ``free`` (m, 3) without walls are moved by ``correction`` (m, 3) [m]. The normal force of a node
        that slips drags it by mu times itself against the slip, which turns with the wall; one that sticks follows the
        wall in all directions. Exact for nodes at one wall.
        """
        touching, tied = walls.touching, np.zeros(len(nodes), dtype=bool)
        poses = self.motion.poses(time)
        acting = self.acting(nodes, free, poses, self._part)
        normals, _ = self.planes(touching, walls.places, poses, acting, nodes)
        if self.ties.any:
            tied = self.ties.held[nodes]
            touching = touching & ~tied[:, None]
        held = touching[:, :, None] & ~self.fixed[nodes][:, None, :]
        active = np.where(held, normals, 0.0)
        inverse = np.linalg.pinv(active, rcond=RANK) if len(nodes) else np.zeros((0, 3, len(self.wall_of)))
        weight = stiffness[:, None] * (inverse * inverse).sum(axis=1)  # the diagonal of k (N N^T)^-1
        weight = np.where(touching, weight, 0.0)
        slope = np.einsum("mw,mwi,mwj->mwij", weight, normals, normals)
        gives = stiffness[:, None, None] * (walls.touching & tied[:, None])[:, :, None] * ~self.fixed[nodes][:, None, :]
        slope += gives[:, :, :, None] * np.eye(3)
        if not self.has_friction:
            return slope
        start = self.state.position[nodes]
        slip = (walls.places - start)[:, None, :] - self.ways(start, self._poses_before(), poses)
        slip -= np.einsum("mwi,mwi->mw", slip, normals)[:, :, None] * normals
        size = np.linalg.norm(slip, axis=2)
        slips = size > PROJECTED * self.size
        slip /= np.where(slips, size, np.inf)[:, :, None]
        rough = np.where(touching, self.friction, 0.0)
        slope -= np.einsum("mw,mwi,mwj->mwij", rough * weight, slip, normals)
        drag = rough * np.maximum(np.einsum("mwi,mi->mw", normals, correction), 0.0)  # over k
        turning = np.where(slips, drag / np.where(slips, size + drag, 1.0), self.static_friction > 0.0)
        sideways = (
            np.eye(3) - normals[:, :, :, None] * normals[:, :, None, :] - slip[:, :, :, None] * slip[:, :, None, :]
        )
        return slope + np.einsum("mw,mwi,mwij->mwij", stiffness[:, None] * turning, held.astype(float), sideways)

    def _by_twists(self, slopes: np.ndarray, nodes: np.ndarray, places: np.ndarray) -> np.ndarray:
        """Return the derivatives (f, 6, 6) of forces of walls with mass, and their moments about the centres, by
        displacements and small rotations of these from the ``slopes`` of :meth:`_slope` of nodes (m,) at ``places``."""
        bodies, start = self.motion.bodies, places if self.state is None else self.state.position[nodes]
        acts, result = start + self._part * (places - start), np.zeros((len(self.motion.bodies.at), 6, 6))
        for i, k in enumerate(bodies.at):
            each = slopes[:, self.wall_of == k].sum(axis=1)
            lever, turned = (across(at - bodies.pivots(part)[i]) for at, part in ((acts, self._part), (places, 1.0)))
            whole = np.concatenate([each, -each @ turned], axis=2)
            result[i] = np.concatenate([whole, lever @ whole], axis=1).sum(axis=0)
        return result

    def project(
        self, x: np.ndarray, stiffness: np.ndarray, time: float, tolerance: float, booked: bool = True
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, WallForces]:
        """Project free positions (owned, 3) onto the region that the walls allow; a failure leaves those found there.

        ``booked`` : whether the step is final and not a trial. Returns the nodes (m,), their corrections (m, 3) [m],
        the forces on them (m, 3) [N], and the sums per wall.
        """
        nodes, moved, force, sums = self._press(x, stiffness, time, tolerance, booked)
        if self.ties.any:
            tied, walls, places, pull = self.ties.hold(x, stiffness, time)
            every = np.zeros((len(tied), len(self.wall_of), 3))
            every[np.arange(len(tied)), self.first[walls]] = pull
            own = np.zeros(every.shape[:2], dtype=bool)
            own[np.arange(len(tied)), self.first[walls]] = True
            nodes, moved, force = np.append(nodes, tied), np.vstack([moved, places]), np.vstack([force, pull])
            touching = np.vstack([sums.touching, own])
            start = places if self.state is None else self.state.position[tied]
            held = self.sums(tied, every, (places, start + self._part * (places - start)), own)
            sums = WallForces(
                *(getattr(sums, name) + getattr(held, name) for name in WallForces.sums),
                nodes,
                touching,
                moved,
                sums.friction,
            )
        return nodes, moved - x[nodes], force, sums

    def _press(self, x: np.ndarray, stiffness: np.ndarray, time: float, tolerance: float, booked: bool) -> tuple:
        """Return nodes (m,) near walls that are not tied to them, positions (m, 3), forces (m, 3), and the sums per
        wall."""
        poses = self.motion.poses(time)
        walls = self.pressed_walls(self.surfaces.at(poses.shifts[self.wall_of]), self._part, tolerance, self._unmoved)
        self.forget_faces()
        marked = np.full(len(x) // NODE_BLOCK + 1, len(walls.restitution) > 0)
        nodes = walls.room[: find_penetrating(np.ascontiguousarray(x.T), by_reference(walls), marked)].copy()
        if (walls.surfaces.radii == OTHER).any():
            nodes = np.union1d(nodes, np.flatnonzero(self.near(x, poses)))
        if self.ties.any:
            nodes = nodes[~self.ties.held[nodes]]
        free = x[nodes]
        try:
            return self._press_some(nodes, free, stiffness[nodes], poses, walls, booked)
        except SimulationFailure:
            x[nodes] = free
            raise

    def press_some(
        self,
        some: tuple[np.ndarray, np.ndarray],
        x: np.ndarray,
        stiffness: np.ndarray,
        balance: Balance,
        tolerance: float,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, WallForces]:
        """Press ``some`` nodes, those (f,) that compiled loops have found beyond walls, and those (s,) of others that
        are beyond walls that these do not know, where :meth:`explicit` looks at all nodes.

        ``x`` (owned, 3), ``stiffness`` (owned,) : of these nodes, see :meth:`explicit`; ``balance`` : of the step

        Returns
        -------
        (nodes (m,), positions (m, 3) [m], forces (m, 3) [N], WallForces)
        """
        found, suspects = some
        self._part, poses = balance.acting, self.motion.poses(balance.time)
        walls = self.pressed_walls(self.surfaces.at(poses.shifts[self.wall_of]), self._part, tolerance, self._unmoved)
        self.forget_faces()
        nodes = np.union1d(found, suspects[self.near(x[suspects], poses, nodes=suspects)])
        return self._press_some(nodes, x[nodes], stiffness[nodes], poses, walls)

    def _press_some(
        self,
        nodes: np.ndarray,
        free: np.ndarray,
        stiffness: np.ndarray,
        poses: Poses,
        walls: PressedWalls,
        booked: bool = True,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, WallForces]:
        """As :meth:`_press` of nodes (m,) that are ``free`` to move to (m, 3), where a failure leaves what is found."""
        w, state, reference, tolerance = len(self.wall_of), self.state, by_reference(walls), walls.tolerance
        if len(nodes) == 0:
            return nodes, np.empty((0, 3)), np.empty((0, 3)), self.nothing
        before = poses if state is None else self._poses_before()
        bounces, others, at = len(walls.restitution) > 0, (walls.surfaces.radii == OTHER).any(), free
        start, drift = free if state is None else state.position[nodes], np.zeros_like(free)
        if bounces:
            drift = (poses.time - state.time) * state.memory["half_velocity"][nodes]
        applies = self.applicable(nodes, free, poses)
        planes = np.empty((0, w, 3)), np.empty((0, w))
        ways = self.ways(start, before, poses)
        self.find_faces(nodes, free, poses, 0.0)
        of_nodes = stiffness, self.fixed[nodes], applies, self.log.touching[nodes]
        for _ in range(_CURVED_ROUNDS):
            if others:
                planes = self.planes(applies, at, poses, self.acting(nodes, free, poses, self._part), nodes)
            memory = [
                array[nodes] if bounces else np.empty((len(nodes), 0)) for array in (walls.rebound, walls.arrival)
            ]
            sums, places = WallSums(*(getattr(self.nothing, name).copy() for name in WallForces.sums)), free.copy()
            given = Arrivals(start, ways, drift, *of_nodes, *memory, *planes)
            failed, why, found, force, touching, friction = press_nodes(places, given, reference, sums, *kind_of(walls))
            settled = failed >= 0 or not others or np.abs(places - at).max() <= tolerance
            if settled and not self.find_faces(nodes, places, poses, tolerance):
                break
            at = places
        else:
            failed, why = int(np.argmax(np.abs(places - at).max(axis=1))), ADRIFT
        if failed >= 0:
            free[:] = places
            raise SimulationFailure(self.placeless(nodes[failed], why, found.normals[failed], found.offsets[failed]))
        if bounces and booked:
            if len(self.motion.bodies.turners):
                unpushed = self.ways(start, before, self.motion.poses_without_contact(poses.time))
                self._set_rebounds(memory, found, (free - start)[:, None, :] - unpushed)
            walls.rebound[nodes], walls.arrival[nodes] = memory
        return nodes, places, force, WallForces(*sums, nodes, touching, places, friction)

"""Contact in explicit steps: a small problem per node, with flat and curved walls, walls with mass, friction and
restitution.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..errors import SimulationFailure
from ..mechanics.compiled import NEEDED, References, inlined, kernel, record
from ..mesh.ordering import NODE_BLOCK
from ..tolerances import FIXED_POINT, PROJECTED, RANK
from .friction import jam
from .node_walls import TURN, NodeWalls, WallForces
from .projection import INFEASIBLE, JAMMED, NodesAtPlanes, Planes, new_pressed, press
from .rotations import NOWHERE, across, add_to, along, cross, dot, free_components, minus, put, vector
from .surfaces import OTHER, Surfaces, beyond, is_round, tangent
from .tied import Ties

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..integrators.base import Balance
    from ..mesh.distribution import DistributedMesh
    from .wall_motion import Poses
    from .walls.base import WallKeys


ADRIFT = 3
"""Why the place of a node is not found, beside the reasons of a problem at planes: those of round walls do not
settle."""

_LEAST_WAY = 1e-3  # that walls with mass are assumed to move in a step by contact, relative to L; or to turn [rad]
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
    friction : (2, w) coefficients of dynamic and static friction
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
    free : (m, 3) positions at its end without walls [m]
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

    free: np.ndarray
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
    found = 0
    for k in range(len(surfaces.radii)):  # over nodes without branches and roots
        normal, offset, radius = vector(surfaces.normals, k), surfaces.offsets[k], surfaces.radii[k]
        if radius == 0.0:
            for i in range(first, last):
                found += 1 if beyond(normal, offset, (xs[i], ys[i], zs[i])) < 0.0 else 0
        elif is_round(radius):
            centre, axis, side = vector(surfaces.centres, k), vector(surfaces.axes, k), 1.0 if radius > 0.0 else -1.0
            limit = radius * radius * (1.0 + side * _ROOT)
            for i in range(first, last):
                arm = minus((xs[i], ys[i], zs[i]), centre)
                arm = along(arm, -dot(arm, axis), axis)
                found += 1 if side * (dot(arm, arm) - limit) < 0.0 else 0
    return found > 0


@inlined
def _list_penetrating(free, first, last, walls, returning, m):
    """Append those of consecutive nodes that are beyond a wall that applies to them, or rebound, to the ``m`` found."""
    surfaces, all_nodes, members = walls.surfaces, walls.all_nodes, walls.members
    for i in range(first, last):
        place = free[0, i], free[1, i], free[2, i]
        for k in range(len(surfaces.radii)):
            gap = tangent(k, surfaces, place)[1] if surfaces.radii[k] != OTHER else 0.0
            if (gap < 0.0 and (all_nodes[k] or members[i, k])) or (returning and walls.rebound[i, k] > 0.0):
                walls.room[m] = i
                m += 1
                break
    return m


@inlined
def _read(walls):
    """Return the fields of :class:`PressedWalls` as a tuple: loops that read those of a record are slower."""
    at = walls.surfaces
    surfaces = Surfaces(at.normals, at.offsets, at.centres, at.axes, at.radii)
    sets = walls.all_nodes, walls.members, walls.tolerance, walls.room, walls.wall_of, walls.way, walls.pushed
    return PressedWalls(surfaces, walls.part, *sets, walls.friction, walls.restitution, walls.rebound, walls.arrival)


@inlined
def impact_square(approach: Any, arrival: Any, pull: Any) -> Any:
    """Return the part of I^2 [m2] that is known in the step of the impact, zero for nodes that do not approach.

    Parameters
    ----------
    approach : a, displacement towards the wall without contact [m]; a number or an array, like the others
    arrival : d, distance to the wall [m]
    pull : p, contribution of forces to the approach [m]
    """
    return (approach > 0.0) * np.maximum(approach * approach - pull * (approach - arrival), 0.0)


@inlined
def rebound_way(restitution: Any, square: Any, arrival: Any, pull: Any) -> Any:
    """Return w + q/2, the rebound velocity times the step [m]; 0 where ``square`` is 0.

    Parameters
    ----------
    restitution : e; a number or an array, like the others
    square, arrival : of the step of the impact, see :func:`impact_square`
    pull : q, towards the wall, by the forces at the position of impact [m]
    """
    return (square > 0.0) * restitution * np.sqrt(np.maximum(square + pull * arrival + 0.25 * pull * pull, 0.0))


@inlined
def rebound_lift(restitution: Any, square: Any, arrival: Any, pull: Any) -> Any:
    """Return w [m], by which a node is off the wall after the step that follows the impact; see :func:`rebound_way`."""
    return (square > 0.0) * np.maximum(rebound_way(restitution, square, arrival, pull) - 0.5 * pull, 0.0)


@inlined
def _acting(j, k, normal, walls, given):
    """Return the direction in which a round wall pushes the j-th node, see
    :meth:`~pfem_petsc.contact.node_walls.NodeWalls.acting`; ``normal`` is the one where it ends."""
    end, start = vector(given.free, j), along(vector(given.start, j), 1.0, vector(given.ways[j], k))
    there, _ = tangent(k, walls.surfaces, along(start, walls.part, minus(end, start)))
    ending, _ = tangent(k, walls.surfaces, end)
    return there if walls.part < 1.0 and dot(there, ending) > TURN else normal


@inlined
def _set_planes(j, at, pushed, walls, given, planes, pulls):
    """Set the planes of the j-th node at positions ``at`` (m, 3), and the ``pulls`` (m, w) of forces towards walls with
    restitution [m], by which it would move to ``pushed`` (m, 3) without walls."""
    surfaces, restitution, place = walls.surfaces, walls.restitution, vector(at, j)
    start, free = vector(given.start, j), vector(given.free, j)
    for k in range(planes.gaps.shape[1]):
        if surfaces.radii[k] == OTHER:
            normal = vector(given.normals[j], k)
            gap = beyond(normal, given.offsets[j, k], place)
        else:
            normal, gap = tangent(k, surfaces, place)
            if surfaces.radii[k] != 0.0:
                normal = _acting(j, k, normal, walls, given)
        gap += dot(normal, minus(free, place))
        put(planes.normals[j], k, normal)
        if len(restitution) > 0:
            pulls[j, k] = -dot(normal, minus(minus(vector(pushed, j), start), vector(given.drift, j)))
            gap -= rebound_lift(restitution[k], given.rebound[j, k], given.arrival[j, k], pulls[j, k])
        planes.gaps[j, k] = gap if given.applies[j, k] else math.inf
        if len(planes.friction) > 0:
            planes.friction[j, k, 0], planes.friction[j, k, 1] = walls.friction[0, k], walls.friction[1, k]
            put(planes.slips[j], k, minus(minus(free, start), vector(given.ways[j], k)))


@inlined
def _meets_round(j, found, walls, given):
    """Return whether a round wall pushes the j-th node to its position, or would stop it there."""
    surfaces, bounces = walls.surfaces, len(walls.restitution) > 0
    for k in range(found.normal.shape[1]):
        if is_round(surfaces.radii[k]) and given.applies[j, k]:
            _, gap = tangent(k, surfaces, vector(found.x, j))
            if found.normal[j, k] > 0.0 or gap < 0.0 or (bounces and given.rebound[j, k] > 0.0):
                return True
    return False


@inlined
def _settle(j, at, nodes, found, walls, given, pulls):
    """Press the j-th of :class:`NodesAtPlanes` again, whose planes were those at ``at`` (m, 3), until planes
    of round walls and position agree. Returns why it has no place, or 0.

    With friction, the positions of planes are those of Aitken's relaxation: in large steps, those of friction alone
    alternate or creep.
    """
    last, part, rubs = NOWHERE, 1.0, len(nodes.planes.friction) > 0
    for _ in range(_CURVED_ROUNDS):
        if not _meets_round(j, found, walls, given):
            return 0
        before, last = last, minus(vector(found.x, j), vector(at, j))
        if max(abs(last[0]), abs(last[1]), abs(last[2])) <= walls.tolerance:
            return 0
        change = minus(last, before)
        less = -dot(before, change)
        if rubs and less != 0.0:
            part = min(max(part * less / dot(change, change), _LEAST_PART), _LARGEST_PART) if less > 0.0 else 0.5
        add_to(at, j, part, last)
        put(found.x, j, vector(at, j))
        _set_planes(j, found.x, given.free, walls, given, nodes.planes, pulls)
        _, why = press((j, j + 1), nodes, walls.tolerance, found, NEEDED)
        if why > 0:
            return why
    return JAMMED if rubs else ADRIFT


@kernel
def _press_all(nodes, found, walls, given, pulls, curved, several):
    """Press :class:`NodesAtPlanes` whose planes are those where they are in ``found``; return the first without a
    place, or -1, and why."""
    at = found.x.copy()
    failed, why = press((0, len(at)), nodes, walls.tolerance, found, several)
    if curved is not None:
        for j in range(len(at)):
            wrong = why if j == failed else _settle(j, at, nodes, found, walls, given, pulls)
            if wrong > 0 and (failed < 0 or j < failed):
                failed, why = j, wrong
    return failed, why


@inlined
def _remember(found, planes, pulls, walls, given):
    """Set the memory of nodes at walls with restitution that they now hit."""
    for j in range(len(found.x)):
        for k in range(len(walls.restitution)):
            fresh = found.normal[j, k] > 0.0 and not given.touching[j, k] and walls.restitution[k] > 0.0
            normal, start = vector(planes.normals[j], k), along(vector(given.start, j), 1.0, vector(given.ways[j], k))
            approach = -dot(normal, along(minus(vector(given.free, j), start), 1.0, vector(walls.pushed, k)))
            arrived = -dot(normal, minus(vector(found.x, j), start))
            given.rebound[j, k] = impact_square(approach, arrived, pulls[j, k]) if fresh else 0.0
            given.arrival[j, k] = arrived if fresh else 0.0


@kernel
def planes_of(at, pushed, given, walls):
    """Return the :class:`~pfem_petsc.contact.projection.Planes` at positions ``at`` (m, 3) of nodes that would move to
    ``pushed`` (m, 3) without walls, and the pulls (m, w) [m] of forces towards walls with restitution; ``given``:
    :class:`Arrivals`, ``walls``: :class:`PressedWalls`."""
    (m, w), n, read = given.applies.shape, 0, _read(walls)
    for k in range(w):
        n = m if read.friction[1, k] > 0.0 else n
    planes = Planes(np.empty((m, w, 3)), np.empty((m, w)), np.empty((n, w, 2)), np.empty((n, w, 3)))
    pulls = np.empty((m, w))
    for j in range(m):
        _set_planes(j, at, pushed, read, given, planes, pulls)
    return planes, pulls


def kind_of(radii: np.ndarray, friction: np.ndarray) -> tuple[Any, Any, Any]:
    """Return whether any walls are curved, whether any are rough, and whether these or several are: ``NEEDED`` or
    None; ``radii`` (w,) of Surfaces, ``friction`` (2, w) of PressedWalls."""
    curved, rough = is_round(radii).any(), friction.any()
    return tuple(NEEDED if kind else None for kind in (curved, rough, rough or len(radii) > 1))


@kernel
def press_nodes(given, walls, sums, curved, rough, several):
    """Project nodes onto :class:`PressedWalls`, with friction and restitution, and add the forces of the walls to
    ``sums``, see :class:`WallSums`; ``given``: :class:`Arrivals`; ``curved``, ``rough``, ``several``: see
    :func:`kind_of`.

    Each node is solved for by itself: its bits do not depend on the others. Returns the index of the first node
    without a place, or -1, and why; the positions and forces of the nodes, see
    :class:`~pfem_petsc.contact.projection.Pressed`; the total force (m, 3) [N]; walls that they touch (m, w); and the
    energy that friction dissipates [J].
    """
    (m, w), start, ways, wall_of = given.applies.shape, given.start, given.ways, walls.wall_of
    planes, pulls = planes_of(given.free, given.free, given, walls)
    normals, found, of_nodes = planes.normals, new_pressed(m, w), (given.free, given.fixed, given.stiffness)
    found.x[:] = given.free
    without = Planes(normals, planes.gaps, np.empty((0, w, 2)), np.empty((0, w, 3)))
    failed, why = -1, 0
    if rough is None or curved is not None or len(walls.restitution) > 0:
        failed, why = _press_all(NodesAtPlanes(*of_nodes, without), found, walls, given, pulls, curved, several)
        _remember(found, planes, pulls, walls, given)
    if rough is not None:  # noqa: SIM102 - what is not needed is not compiled
        if failed < 0:
            failed, why = _press_all(NodesAtPlanes(*of_nodes, planes), found, walls, given, pulls, curved, several)
    total, touching, dissipated = np.zeros((m, 3)), np.zeros((m, w), dtype=np.bool_), 0.0
    for j in range(m):
        way = minus(vector(found.x, j), vector(start, j))
        acts, last = along(vector(start, j), walls.part, way), -1  # where the forces of the balance do
        for k in range(w):
            if found.normal[j, k] == 0.0:
                continue
            touching[j, k], wall = True, wall_of[k]
            sums.contacts[wall] += 1 if wall != last else 0  # a node in several slots of a wall counts once
            last = wall
            drag = vector(found.drag[j], k)
            dissipated -= dot(drag, minus(way, vector(ways[j], k)))
            force = along(drag, found.normal[j, k], vector(normals[j], k))
            add_to(total, j, 1.0, force)
            add_to(sums.force, wall, 1.0, force)
            add_to(sums.moment, wall, 1.0, cross(acts, force))
    return failed, why, found, total, touching, dissipated


class Held(NamedTuple):
    """Nodes (m,) that walls (w,) stop or that are tied to them, and walls with mass (f,).

    Attributes
    ----------
    stiffness : (m,) [N/m]
    fixed, touching : (m, 3), (m, w) bool, components that supports prescribe, and walls that they touch
    acts, places : (m, 3) positions where the forces of the balance act, and at the end of the step [m]
    body : (w,) the wall with mass of each slot, -1 for none
    pivots : (2, f, 3) those of walls with mass, where the forces of the balance act and at the end of the step [m]
    """

    stiffness: np.ndarray
    fixed: np.ndarray
    touching: np.ndarray
    acts: np.ndarray
    places: np.ndarray
    body: np.ndarray
    pivots: np.ndarray


@inlined
def _slope_of_plane(j, k, weight, normal, given, held, walls):
    """Return the derivative (3, 3) of the force of wall k on the j-th node by the wall's position [N/m].

    The normal force of a node that slips drags it by mu times itself against the slip, which turns with the wall; one
    that sticks follows the wall in all directions. Exact for nodes at one wall.
    """
    slope = weight * np.outer(normal, normal)
    rough, static = walls.friction[0, k], walls.friction[1, k]
    if static > 0.0:
        slip = held.places[j] - given.start[j] - given.ways[j, k]
        slip -= (slip @ normal) * normal
        size = math.sqrt(slip @ slip)
        turning, drag = 1.0, rough * max(normal @ (held.places[j] - given.free[j]), 0.0)  # over k
        if size > walls.tolerance:
            slip /= size
            turning = drag / (size + drag)
        else:
            slip[:] = 0.0
        slope -= rough * weight * np.outer(slip, normal)
        across_slip = np.eye(3) - np.outer(normal, normal) - np.outer(slip, slip)
        slope += np.where(held.fixed[j], 0.0, held.stiffness[j] * turning).reshape(3, 1) * across_slip
    return slope


@kernel
def slopes_of_walls(given, held, walls):
    """Return the derivatives (f, 6, 6) of forces of walls with mass on nodes, and of the moments of these about the
    pivots, by displacements and small rotations of the walls.

    ``given`` are those of the first of the :class:`Held` nodes; the others are tied.
    """
    normals = planes_of(held.places[: len(given.free)], given.free, given, walls)[0].normals
    total, w = np.zeros((held.pivots.shape[1], 6, 6)), held.touching.shape[1]
    rows, whole = np.zeros((w, 3)), np.empty((3, 6))
    for j in range(len(held.places)):
        tied = j >= len(normals)
        for k in range(w):
            free = NOWHERE
            if held.touching[j, k] and not tied:
                free = free_components(vector(normals[j], k), held.fixed[j])
            put(rows, k, free)
        inverse = np.linalg.pinv(rows, RANK)
        for k in range(w):
            i = held.body[k]
            if not held.touching[j, k] or i < 0:
                continue
            slope = np.diag(np.where(held.fixed[j], 0.0, held.stiffness[j]))
            if not tied:
                weight = held.stiffness[j] * (inverse[:, k] ** 2).sum()  # of the diagonal of k (N N^T)^-1
                slope = _slope_of_plane(j, k, weight, normals[j, k].copy(), given, held, walls)
            arms = np.stack((held.acts[j] - held.pivots[0, i], held.places[j] - held.pivots[1, i]))
            lever = across(arms)
            whole[:, :3], whole[:, 3:] = slope, -(slope @ lever[1])
            total[i, :3] += whole
            total[i, 3:] += lever[0] @ whole
    return total


class OutOfReachError(Exception):
    """Walls with mass move farther in a step than was assumed when nodes near them were sought; on all ranks."""


class Stopped(NamedTuple):
    """Nodes (m,) that walls stop: forces (m, 3) on them [N], WallForces, and the Arrivals of those that are not tied;
    None for none."""

    force: np.ndarray
    walls: WallForces
    given: Arrivals | None


class ExplicitContact(NodeWalls):
    """Walls that project free positions onto the region that they allow.

    Attributes
    ----------
    ties : Ties
    room : (owned,) int64, where compiled passes list the nodes beyond the former; (0,) without walls
    known : (slots,) bool, planes, spheres and cylinders that do not turn, which compiled passes know
    called : (walls,) bool, other walls and those with mass
    limits : (2,) how far walls with mass are assumed to move [m] and to turn [rad] in a step by contact
    tolerance : depth beyond a wall that counts as none [m]
    at_rest : Surfaces of all walls (walls,) if none turned
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
        massive = [wall.mass is not None for wall in (case.wall if parameters is None else parameters)]
        self.called = (self.surfaces.radii[self.first] == OTHER) | np.array(massive, dtype=bool)
        self.tolerance, self.known = PROJECTED * self.size, self.surfaces.radii != OTHER
        self._coefficients = np.array([self.friction, self.static_friction])
        self._forgotten = np.empty(0), *np.empty((2, 0, len(self.wall_of)))
        self._placed, self._references = self.surfaces.copy(), References()
        self._kind = kind_of(self.surfaces.radii, self._coefficients)
        self.limits = np.array([_LEAST_WAY * self.size, _LEAST_WAY])
        self.at_rest = Surfaces.of(self.walls, np.zeros(len(self.walls), dtype=bool))
        self._part = 1.0  # see :meth:`acting`
        self.room = np.empty(len(self.members) if self.any else 0, dtype=np.int64)

    def explicit(
        self,
        predictor: np.ndarray,
        u: np.ndarray,
        stiffness: np.ndarray,
        time: float,
        part: float = 1.0,
        pushing: Balance | None = None,
    ) -> tuple[np.ndarray, np.ndarray, WallForces]:
        """Correct increments ``u`` (owned, 3), in place, so that the positions predictor + u satisfy the walls.

        Parameters
        ----------
        predictor, u : (owned, 3); their sum is the position at ``time`` without walls [m]
        stiffness : (owned,) alpha m + eta c: force for a displacement of the node [N/m]
        part : see :meth:`acting`; other parts than 1 need the state
        pushing : the balance of a step in which nodes push walls with mass, for :meth:`push_walls`

        Returns
        -------
        (nodes (m,), force (m, 3) [N] by the walls, WallForces)
        """
        self._part, x = part, predictor + u
        try:
            if pushing is None:
                found = self.project(x, stiffness, time)
            else:
                found = self.push_walls(lambda: x, stiffness, pushing)
            force, walls, _ = self.book(found, time)
        except SimulationFailure:  # until other ranks know of it, the other nodes stay at walls
            u[:] = x - predictor
            raise
        u[walls.nodes] += walls.places - x[walls.nodes]
        return walls.nodes, force, walls

    def placeless(self, node: int, why: int, x: np.ndarray, time: float) -> str:
        """Return the message about an owned node whose place near x (3,) at a time [s] :func:`press_nodes` did not
        find."""
        poses, at = self.motion.poses(time), np.array([node])
        normals, offsets = self.planes(self.applicable(at, x[None], poses), x[None], poses, nodes=at)
        if why == INFEASIBLE:
            return self.infeasible_message(node, offsets[0])
        if why == JAMMED:
            return jam(self, node, normals[0]) or (
                f"the friction of node {self.mesh.node_ids[node]} on its walls did not converge; reduce time.step"
            )
        return (
            f"the position of node {self.mesh.node_ids[node]} on curved walls did not converge in {_CURVED_ROUNDS} "
            "iterations: walls and supports may be infeasible together; move the walls apart, free the node, or "
            "reduce time.step"
        )

    def walls_at(self, poses: Poses, part: float) -> Any:
        """Return the walls at the end of a step that is not compiled, by reference, until they are placed anew."""
        placed, displacements = self._placed, poses.shifts[self.wall_of]
        placed.offsets[:] = self.surfaces.offsets + np.einsum("ij,ij->i", placed.normals, displacements)
        placed.centres[:] = self.surfaces.centres + displacements
        return self._references.of(self.pressed_walls(placed, part, self._unmoved))

    @property
    def _memory(self) -> list[np.ndarray]:
        """The memory (owned, slots) of nodes that have hit walls with restitution, see :class:`Arrivals`."""
        return [self.state.memory.setdefault(name, np.zeros(self.members.shape)) for name in ("rebound", "arrival")]

    def pressed_walls(self, surfaces: Surfaces, part: float, way: np.ndarray) -> PressedWalls:
        """Return walls for compiled passes, see :class:`PressedWalls`."""
        (restitution, *memory), pushed = self._forgotten, self._unmoved
        bodies = self.motion.bodies
        if self.rebounds:
            restitution, memory = self.restitution, self._memory
        if self.rebounds and bodies.begun:
            pushes = np.zeros((len(self.walls), 3))
            pushes[bodies.at] = bodies.displacements(np.inf) - bodies.unpushed()[0]
            pushed = pushes[self.wall_of]
        sets, moved = (self.all_nodes, self.members), (self.wall_of, way, pushed)
        return PressedWalls(
            surfaces, part, *sets, self.tolerance, self.room, *moved, self._coefficients, restitution, *memory
        )

    def push_walls(
        self,
        place: Callable[[], np.ndarray],
        stiffness: np.ndarray,
        balance: Balance,
        coupled: bool = False,
        some: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> Stopped:
        """Find the final positions of walls with mass, if any, in an explicit step; return the nodes that walls stop
        then, which :meth:`book` is to be told. Collective.

        Parameters
        ----------
        place : returns positions (owned, 3) of nodes without walls [m]
        stiffness : see :meth:`explicit`; balance : of the step
        coupled : whether these positions depend on where the walls are
        some : nodes among which those near the walls are, see :meth:`press_some`; None for all

        Raises
        ------
        OutOfReachError
            If ``some`` may not be all nodes that the walls meet.
        """
        bodies, time, self._part = self.motion.bodies, balance.time, balance.acting
        failure: SimulationFailure | None = None
        sought, first, found = None, True, None

        def forces() -> tuple[np.ndarray, Callable[[], np.ndarray] | None]:
            nonlocal failure, sought, first, found
            fresh, first = first, False
            try:
                x = place()
                sought = bodies.way if sought is None else sought
                if some is not None and bodies.strays(sought, self.limits):
                    self.limits *= 2.0
                    raise OutOfReachError
                found = self.project(x, stiffness, time, some)
            except SimulationFailure as met:  # raised once all ranks have left the iteration
                failure = failure or met
                return np.zeros((2, len(bodies.at), 3)), lambda: np.zeros((len(bodies.at), 6, 6))
            pushes = np.stack([found.walls.force, found.walls.moment]) + self.pushes
            slopes = None if coupled and not fresh else lambda: self._slopes(found, stiffness, time)
            return pushes[:, bodies.at], slopes

        settled = bodies.solve(forces, FIXED_POINT * self.size)
        if failure is not None:
            raise failure
        if not settled:
            raise SimulationFailure(self.unsettled_message())
        return found

    def _slopes(self, found: Stopped, stiffness: np.ndarray, time: float) -> np.ndarray:
        """Return this rank's share of the derivatives of :func:`slopes_of_walls`."""
        bodies, nodes, places, given = self.motion.bodies, found.walls.nodes, found.walls.places, found.given
        if not len(nodes):
            return np.zeros((len(bodies.at), 6, 6))
        body = np.full(len(self.walls), -1)
        body[bodies.at] = np.arange(len(bodies.at))
        pivots = np.stack([bodies.pivots(part) for part in (self._part, 1.0)])
        start = places if self.state is None else self.state.position[nodes]
        acts = start + self._part * (places - start)
        of_nodes = stiffness[nodes], self.fixed[nodes], found.walls.touching, acts, places
        walls, w = self.walls_at(self.motion.poses(time), self._part), len(self.wall_of)
        if given is None:  # all are tied
            some, vectors, planes = np.empty((0, w)), np.empty((0, 3)), np.empty((0, w, 3))
            flags = vectors > 0.0, some > 0.0, some > 0.0
            given = Arrivals(
                vectors, vectors, planes, vectors, some[:, 0], *flags, some[:, :0], some[:, :0], planes, some
            )
        return slopes_of_walls(given, Held(*of_nodes, body[self.wall_of], pivots), walls)

    def _set_rebounds(self, given: Arrivals, normals: np.ndarray, unpushed: np.ndarray) -> None:
        """Set the memory of nodes that hit walls with inertia, at planes with normals (m, slots, 3); ``unpushed``
        (m, slots, 3): the ways of the walls without contact [m]."""
        bodies, rebound, arrival, way = self.motion.bodies, given.rebound, given.arrival, given.free - given.start
        fresh = np.isin(self.wall_of, bodies.at[bodies.turners]) & ((arrival != 0.0) | (rebound > 0.0))
        approach = -np.einsum("mwi,mwi->mw", normals, way[:, None, :] - unpushed)
        pull = -np.einsum("mwi,mi->mw", normals, way - given.drift)
        np.copyto(rebound, impact_square(approach, arrival, pull), where=fresh)

    def unsettled_message(self) -> str:
        """Return the message about walls with mass for which no position balances the forces on them."""
        names = ", ".join(repr(self.names[k]) for k in self.motion.bodies.at)
        return (
            f"walls with mass ({names}) have no position at which the forces of the nodes balance: nodes alternate "
            "between walls that push them the same way; reduce time.step, remove one of these walls, or limit it by "
            "'node_set'"
        )

    def project(
        self,
        x: np.ndarray,
        stiffness: np.ndarray,
        time: float,
        some: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> Stopped:
        """Project free positions (owned, 3) onto the region that the walls allow; a failure leaves those found there.

        ``some`` : see :meth:`press_some`, None for all nodes; :meth:`book` is to be told of the final positions.
        """
        poses = self.motion.poses(time)
        walls = self.walls_at(poses, self._part)
        self.forget_faces()
        if some is not None:
            nodes = np.union1d(some[0], some[1][self.near(x[some[1]], poses, nodes=some[1])])
        else:
            marked = np.full(len(x) // NODE_BLOCK + 1, self.rebounds)
            nodes = self.room[: find_penetrating(np.ascontiguousarray(x.T), walls, marked)].copy()
            if not self.known.all():
                nodes = np.union1d(nodes, np.flatnonzero(self.near(x, poses)))
        if self.ties.any:
            nodes = nodes[~self.ties.held[nodes]]
        free = x[nodes]
        try:
            found = self._press_some(nodes, free, stiffness[nodes], poses, walls)
        except SimulationFailure:
            x[nodes] = free
            raise
        return self._with_tied(found, x, stiffness, time) if self.ties.any else found

    def _with_tied(self, found: Stopped, x: np.ndarray, stiffness: np.ndarray, time: float) -> Stopped:
        """Add the nodes that are tied to walls."""
        tied, walls, places, pull = self.ties.hold(x, stiffness, time)
        every, sums = np.zeros((len(tied), len(self.wall_of), 3)), found.walls
        every[np.arange(len(tied)), self.first[walls]] = pull
        own = np.zeros(every.shape[:2], dtype=bool)
        own[np.arange(len(tied)), self.first[walls]] = True
        start = places if self.state is None else self.state.position[tied]
        held = self.sums(tied, every, (places, start + self._part * (places - start)), own)
        sums = WallForces(
            *(getattr(sums, name) + getattr(held, name) for name in WallForces.sums),
            np.append(sums.nodes, tied),
            np.vstack([sums.touching, own]),
            np.vstack([sums.places, places]),
            sums.friction,
        )
        return Stopped(np.vstack([found.force, pull]), sums, found.given)

    def press_some(
        self,
        some: tuple[np.ndarray, np.ndarray],
        x: np.ndarray,
        stiffness: np.ndarray,
        balance: Balance,
    ) -> Stopped:
        """Press ``some`` nodes, those (f,) that compiled loops have found beyond walls, and those (s,) of others that
        are beyond walls that these do not know, where :meth:`explicit` looks at all nodes.

        ``x`` (owned, 3), ``stiffness`` (owned,) : of these nodes, see :meth:`explicit`; ``balance`` : of the step
        """
        return self.book(self.push_walls(lambda: x, stiffness, balance, some=some), balance.time)

    def _press_some(
        self,
        nodes: np.ndarray,
        free: np.ndarray,
        stiffness: np.ndarray,
        poses: Poses,
        walls: Any,
    ) -> Stopped:
        """Press nodes (m,) that are ``free`` to move to (m, 3), where a failure leaves what is found."""
        w, state = len(self.wall_of), self.state
        if len(nodes) == 0:
            return Stopped(np.empty((0, 3)), self.nothing, None)
        before = poses if state is None else self._poses_before()
        bounces, others, at = self.rebounds, not self.known.all(), free
        start, drift = free if state is None else state.position[nodes], np.zeros_like(free)
        if bounces:
            drift = (poses.time - state.time) * state.memory["half_velocity"][nodes]
        applies = self.applicable(nodes, free, poses)
        planes, none = (np.empty((0, w, 3)), np.empty((0, w))), np.empty((len(nodes), 0))
        ways = self.ways(start, before, poses)
        self.find_faces(nodes, free, poses, 0.0)
        of_nodes = stiffness, self.fixed[nodes], applies, self.log.touching[nodes]
        acting = None
        for _ in range(_CURVED_ROUNDS):
            if others:
                if acting is None or self.surfaces_of_triangles:
                    acting = self.acting(nodes, free, poses, self._part)
                planes = self.planes(applies, at, poses, acting, nodes)
            memory = [array[nodes] for array in self._memory] if bounces else [none, none]
            sums = WallSums(*(getattr(self.nothing, name).copy() for name in WallForces.sums))
            given = Arrivals(free, start, ways, drift, *of_nodes, *memory, *planes)
            pressed = press_nodes(given, walls, sums, *self._kind)
            failed, why, (places, *_), force, touching, friction = pressed
            settled = failed >= 0 or not others or np.abs(places - at).max() <= self.tolerance
            if settled and not self.find_faces(nodes, places, poses, self.tolerance):
                break
            at = places
        else:
            failed, why = int(np.argmax(np.abs(places - at).max(axis=1))), ADRIFT
        if failed >= 0:
            free[:] = places
            raise SimulationFailure(self.placeless(nodes[failed], why, places[failed], poses.time))
        return Stopped(force, WallForces(*sums, nodes, touching, places, friction), given)

    def book(self, found: Stopped, time: float) -> Stopped:
        """Keep the memory of the nodes that walls stop at the end of a step, at a time [s]; return them."""
        given = found.given
        if not self.rebounds or given is None:
            return found
        nodes = found.walls.nodes[: len(given.free)]
        if len(self.motion.bodies.turners):
            poses, places = self.motion.poses(time), found.walls.places[: len(nodes)]
            unpushed = self.ways(given.start, self._poses_before(), self.motion.poses_without_contact(time))
            planes, _ = planes_of(places, given.free, given, self.walls_at(poses, self._part))
            self._set_rebounds(given, planes.normals, unpushed)
        for array, values in zip(self._memory, (given.rebound, given.arrival), strict=True):
            array[nodes] = values
        return found

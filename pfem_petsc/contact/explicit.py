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
from .rotations import across
from .surfaces import OTHER, Surfaces, is_round, tangent
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
    surfaces, part, start, ways, free = walls.surfaces, walls.part, given.start, given.ways, given.free
    bx, by, bz = start[j, 0] + ways[j, k, 0], start[j, 1] + ways[j, k, 1], start[j, 2] + ways[j, k, 2]
    there = bx + part * (free[j, 0] - bx), by + part * (free[j, 1] - by), bz + part * (free[j, 2] - bz)
    nx, ny, nz, _ = tangent(k, surfaces, there[0], there[1], there[2])
    ex, ey, ez, _ = tangent(k, surfaces, free[j, 0], free[j, 1], free[j, 2])
    return (nx, ny, nz) if part < 1.0 and nx * ex + ny * ey + nz * ez > TURN else normal


@inlined
def _set_planes(j, at, pushed, walls, given, planes, pulls):
    """Set the planes of the j-th node at positions ``at`` (m, 3), and the ``pulls`` (m, w) of forces towards walls with
    restitution [m], by which it would move to ``pushed`` (m, 3) without walls."""
    surfaces, restitution, start, free = walls.surfaces, walls.restitution, given.start, given.free
    x, y, z = at[j, 0], at[j, 1], at[j, 2]
    for k in range(planes.gaps.shape[1]):
        if surfaces.radii[k] == OTHER:
            n, gap = (given.normals[j, k, 0], given.normals[j, k, 1], given.normals[j, k, 2]), -given.offsets[j, k]
            gap += n[0] * x + n[1] * y + n[2] * z
        else:
            nx, ny, nz, gap = tangent(k, surfaces, x, y, z)
            n = (nx, ny, nz)
            if surfaces.radii[k] != 0.0:
                n = _acting(j, k, n, walls, given)
        gap += n[0] * (free[j, 0] - x) + n[1] * (free[j, 1] - y) + n[2] * (free[j, 2] - z)
        planes.normals[j, k, 0], planes.normals[j, k, 1], planes.normals[j, k, 2] = n
        if len(restitution) > 0:
            pull = 0.0
            for c in range(3):
                pull -= planes.normals[j, k, c] * (pushed[j, c] - start[j, c] - given.drift[j, c])
            pulls[j, k] = pull
            gap -= rebound_lift(restitution[k], given.rebound[j, k], given.arrival[j, k], pull)
        planes.gaps[j, k] = gap if given.applies[j, k] else math.inf
        if len(planes.friction) > 0:
            planes.friction[j, k, 0], planes.friction[j, k, 1] = walls.friction[0, k], walls.friction[1, k]
            for c in range(3):
                planes.slips[j, k, c] = free[j, c] - start[j, c] - given.ways[j, k, c]


@inlined
def _meets_round(j, found, walls, given):
    """Return whether a round wall pushes the j-th node to its position, or would stop it there."""
    surfaces, bounces = walls.surfaces, len(walls.restitution) > 0
    for k in range(found.normal.shape[1]):
        if is_round(surfaces.radii[k]) and given.applies[j, k]:
            _, _, _, gap = tangent(k, surfaces, found.x[j, 0], found.x[j, 1], found.x[j, 2])
            if found.normal[j, k] > 0.0 or gap < 0.0 or (bounces and given.rebound[j, k] > 0.0):
                return True
    return False


@inlined
def _settle(j, at, nodes, found, walls, given, pulls):
    """Press the j-th of :class:`NodesAtPlanes` again, whose planes were those at ``at`` (3,), until planes of round
    walls and position agree. Returns why it has no place, or 0.

    With friction, the positions of planes are those of Aitken's relaxation: in large steps, those of friction alone
    alternate or creep.
    """
    x, last, part, rubs = found.x[j], np.zeros(3), 1.0, len(nodes.planes.friction) > 0
    for _ in range(_CURVED_ROUNDS):
        if not _meets_round(j, found, walls, given):
            return 0
        along = square = largest = 0.0
        for c in range(3):
            change = x[c] - at[c] - last[c]
            along -= last[c] * change
            square += change * change
            last[c] += change
            largest = max(largest, abs(last[c]))
        if largest <= walls.tolerance:
            return 0
        if rubs and along != 0.0:
            part = min(max(part * along / square, _LEAST_PART), _LARGEST_PART) if along > 0.0 else 0.5
        for c in range(3):
            at[c] += part * last[c]
            x[c] = at[c]
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
            wrong = why if j == failed else _settle(j, at[j], nodes, found, walls, given, pulls)
            if wrong > 0 and (failed < 0 or j < failed):
                failed, why = j, wrong
    return failed, why


@inlined
def _remember(found, planes, pulls, walls, given):
    """Set the memory of nodes at walls with restitution that they now hit."""
    for j in range(len(found.x)):
        for k in range(len(walls.restitution)):
            fresh = found.normal[j, k] > 0.0 and not given.touching[j, k] and walls.restitution[k] > 0.0
            approach = arrived = 0.0
            for c in range(3):
                way = given.start[j, c] + given.ways[j, k, c]
                approach -= planes.normals[j, k, c] * (given.free[j, c] - way + walls.pushed[k, c])
                arrived -= planes.normals[j, k, c] * (found.x[j, c] - way)
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
    total, touching, arm, dissipated = np.zeros((m, 3)), np.zeros((m, w), dtype=np.bool_), np.empty(3), 0.0
    drag = found.drag
    for j in range(m):
        for c in range(3):  # where the forces of the balance act
            arm[c] = start[j, c] + walls.part * (found.x[j, c] - start[j, c])
        for k in range(w):
            strength, wall = found.normal[j, k], wall_of[k]
            if strength == 0.0:
                continue
            touching[j, k] = True
            sums.contacts[wall] += 1
            for earlier in range(k):  # a node in several slots of a wall counts once
                if wall_of[earlier] == wall and touching[j, earlier]:
                    sums.contacts[wall] -= 1
                    break
            for c in range(3):
                force = strength * normals[j, k, c] + drag[j, k, c]
                dissipated -= drag[j, k, c] * (found.x[j, c] - start[j, c] - ways[j, k, c])
                total[j, c] += force
                sums.force[wall, c] += force
                one, other = (c + 1) % 3, (c + 2) % 3
                sums.moment[wall, one] += arm[other] * force
                sums.moment[wall, other] -= arm[one] * force
    return failed, why, found, total, touching, dissipated


class Levers(NamedTuple):
    """Walls with mass (f,): that of each slot, ``body`` (w,), -1 for none; and their ``pivots`` (2, f, 3), where the
    forces of the balance act and at the end of the step [m]."""

    body: np.ndarray
    pivots: np.ndarray


class Held(NamedTuple):
    """Nodes (m,) that walls (w,) stop or that are tied to them: ``stiffness`` (m,) [N/m], components ``fixed`` by
    supports (m, 3) and walls that they are ``touching`` (m, w) bool, positions ``acts`` (m, 3) where the forces of the
    balance act, and ``places`` at the end of the step (m, 3) [m]."""

    stiffness: np.ndarray
    fixed: np.ndarray
    touching: np.ndarray
    acts: np.ndarray
    places: np.ndarray


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
        for c in range(3):
            slope[c] += (0.0 if held.fixed[j, c] else held.stiffness[j] * turning) * across_slip[c]
    return slope


@kernel
def slopes_of_walls(given, held, walls, levers):
    """Return the derivatives (f, 6, 6) of forces of walls with mass on nodes, and of the moments of these about the
    pivots, by displacements and small rotations of the walls.

    ``given`` are those of the first of the :class:`Held` nodes; the others are tied.
    """
    normals = planes_of(held.places[: len(given.free)], given.free, given, walls)[0].normals
    total, w = np.zeros((levers.pivots.shape[1], 6, 6)), held.touching.shape[1]
    rows, weights, whole = np.zeros((w, 3)), np.empty(w), np.empty((3, 6))
    for j in range(len(held.places)):
        count, stiffness, tied = 0, held.stiffness[j], j >= len(normals)
        for k in range(w):
            if held.touching[j, k]:
                for c in range(3):
                    rows[count, c] = 0.0 if held.fixed[j, c] or tied else normals[j, k, c]
                count += 1
        inverse = np.linalg.pinv(rows[: max(count, 1)].copy(), RANK)
        for k in range(count):  # the diagonal of k (N N^T)^-1
            weights[k] = stiffness * (inverse[0, k] ** 2 + inverse[1, k] ** 2 + inverse[2, k] ** 2)
        count = 0
        for k in range(w):
            if not held.touching[j, k]:
                continue
            count, i = count + 1, levers.body[k]
            if i < 0:
                continue
            if tied:
                slope = np.diag(np.where(held.fixed[j], 0.0, stiffness))
            else:
                slope = _slope_of_plane(j, k, weights[count - 1], normals[j, k].copy(), given, held, walls)
            arms = np.stack((held.acts[j] - levers.pivots[0, i], held.places[j] - levers.pivots[1, i]))
            lever = across(arms)
            whole[:, :3], whole[:, 3:] = slope, -(slope @ lever[1])
            total[i, :3] += whole
            total[i, 3:] += lever[0] @ whole
    return total


class OutOfReachError(Exception):
    """Walls with mass move farther in a step than was assumed when nodes near them were sought; on all ranks."""


class Stopped(NamedTuple):
    """Nodes (m,) that walls stop: positions and forces (m, 3) [m], [N], WallForces, and the Arrivals of those that are
    not tied; None for none."""

    nodes: np.ndarray
    places: np.ndarray
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
            nodes, places, force, walls, _ = self.book(found, time)
        except SimulationFailure:  # until other ranks know of it, the other nodes stay at walls
            u[:] = x - predictor
            raise
        u[nodes] += places - x[nodes]
        return nodes, force, walls

    def placeless(self, node: int, why: int, x: np.ndarray, time: float) -> str:
        """Return the message about an owned node whose place near x (3,) at a time [s] :func:`press_nodes` did not
        find."""
        poses, at = self.motion.poses(time), np.array([node])
        normals, offsets = self.planes(self.applicable(at, x[None], poses), x[None], poses, nodes=at)
        if why == INFEASIBLE:
            return self.infeasible_message(node, offsets[0])
        if why == JAMMED:
            return self.unsettled_friction(node, normals[0])
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
        """Find the final positions of walls with mass in an explicit step; return the nodes that walls stop then, which
        :meth:`book` is to be told. Collective.

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
        chosen, sought, first, found = some, None, True, None

        def forces() -> tuple[np.ndarray, Callable[[], np.ndarray] | None]:
            nonlocal failure, chosen, sought, first, found
            fresh, first = first, False
            try:
                x = place()
                if sought is None or bodies.strays(sought, self.limits):
                    if sought is not None:
                        self.limits *= 2.0
                    if some is not None and sought is not None:
                        raise OutOfReachError
                    sought = bodies.way
                    # coupled nodes may be anywhere in the next trial
                    chosen = self._near_bodies(x, time) if some is None and not coupled else some
                found = self.project(x, stiffness, time, chosen)
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

    def _near_bodies(self, x: np.ndarray, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the nodes that rebound, and those that walls may meet at a time [s] which move as far as is assumed,
        of nodes at (owned, 3)."""
        arms = np.zeros(len(x))
        for pivot in self.motion.bodies.pivots(1.0):
            np.maximum(arms, ((x - pivot) ** 2).sum(axis=1), out=arms)
        reach = self.limits[0] + self.limits[1] * np.sqrt(arms)
        near = np.flatnonzero(self.near(x, self.motion.poses(time), reach))
        return np.flatnonzero((self._memory[0] > 0.0).any(axis=1)) if self.rebounds else near[:0], near

    def _slopes(self, found: Stopped, stiffness: np.ndarray, time: float) -> np.ndarray:
        """Return this rank's share of the derivatives of :func:`slopes_of_walls`."""
        bodies, nodes, places, given = self.motion.bodies, found.nodes, found.places, found.given
        if not len(nodes):
            return np.zeros((len(bodies.at), 6, 6))
        body = np.full(len(self.walls), -1)
        body[bodies.at] = np.arange(len(bodies.at))
        levers = Levers(body[self.wall_of], np.stack([bodies.pivots(part) for part in (self._part, 1.0)]))
        start = places if self.state is None else self.state.position[nodes]
        acts = start + self._part * (places - start)
        held = Held(stiffness[nodes], self.fixed[nodes], found.walls.touching, acts, places)
        walls, w = self.walls_at(self.motion.poses(time), self._part), len(self.wall_of)
        if given is None:  # all are tied
            some, vectors, planes = np.empty((0, w)), np.empty((0, 3)), np.empty((0, w, 3))
            flags = vectors > 0.0, some > 0.0, some > 0.0
            given = Arrivals(
                vectors, vectors, planes, vectors, some[:, 0], *flags, some[:, :0], some[:, :0], planes, some
            )
        return slopes_of_walls(given, held, walls, levers)

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
        nodes, moved = np.append(found.nodes, tied), np.vstack([found.places, places])
        sums = WallForces(
            *(getattr(sums, name) + getattr(held, name) for name in WallForces.sums),
            nodes,
            np.vstack([sums.touching, own]),
            moved,
            sums.friction,
        )
        return Stopped(nodes, moved, np.vstack([found.force, pull]), sums, found.given)

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
        self._part = balance.acting
        if self.motion.bodies.any:
            return self.book(self.push_walls(lambda: x, stiffness, balance, some=some), balance.time)
        return self.book(self.project(x, stiffness, balance.time, some), balance.time)

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
            return Stopped(nodes, np.empty((0, 3)), np.empty((0, 3)), self.nothing, None)
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
        return Stopped(nodes, places, force, WallForces(*sums, nodes, touching, places, friction), given)

    def book(self, found: Stopped, time: float) -> Stopped:
        """Keep the memory of the nodes that walls stop at the end of a step, at a time [s]; return them."""
        given = found.given
        if not self.rebounds or given is None:
            return found
        nodes = found.nodes[: len(given.free)]
        if len(self.motion.bodies.turners):
            poses, places = self.motion.poses(time), found.places[: len(nodes)]
            unpushed = self.ways(given.start, self._poses_before(), self.motion.poses_without_contact(time))
            planes, _ = planes_of(places, given.free, given, self.walls_at(poses, self._part))
            self._set_rebounds(given, planes.normals, unpushed)
        for array, values in zip(self._memory, (given.rebound, given.arrival), strict=True):
            array[nodes] = values
        return found

"""The walls of a case and the nodes of a rank: distances, tangent planes, which walls can stop which nodes, forces on
them, and the log of contact times and releases.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from mpi4py import MPI

from ..mechanics.compiled import kernel
from ..parallel.agreement import agreed
from ..tolerances import BEYOND, FREE_PART, resolvable
from .surfaces import Surfaces
from .triangles import TouchedFaces
from .wall_motion import Poses, WallMotion
from .walls.base import made_wall

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..mesh.distribution import DistributedMesh
    from .walls.base import WallKeys


@dataclass
class WallForces:
    """Sums over this rank's nodes for each wall, and these nodes.

    Attributes
    ----------
    force : (walls, 3) on the truss [N]
    contacts : (walls,) nodes in contact
    moment : (walls, 3) of the force about the origin [N m]
    nodes : (m,) owned nodes near walls
    touching : (m, slots) bool, planes of walls that they touch
    places : (m, 3) their positions [m]
    friction : energy that friction on these nodes dissipates in the step solved for [J]
    sums : names of the attributes that are sums
    """

    sums: ClassVar[tuple[str, ...]] = ("force", "contacts", "moment")

    force: np.ndarray
    contacts: np.ndarray
    moment: np.ndarray
    nodes: np.ndarray
    touching: np.ndarray
    places: np.ndarray
    friction: float = 0.0


def free_squares(fixed: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return squared lengths (...,) of unit normals (..., 3) restricted to components that are not ``fixed``."""
    return (np.where(fixed, 0.0, normals) ** 2).sum(axis=-1)


def held_by_supports(fixed: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return (...,) bool: only supports determine the motion of a node along these unit normals."""
    return free_squares(fixed, normals) <= FREE_PART


NOTED = 4096
"""Steps whose contacts are buffered before ranks combine them."""


@kernel
def compare_contacts(touching, before, nodes, now, present, releases, wall_of):
    """Update ``touching`` (owned, s) from the nodes that touched ``before`` to the planes of walls that ``nodes`` (m,)
    touch ``now`` (m, s), and count ``releases`` (w,); ``wall_of`` (s,): the wall of each.

    ``present`` (owned,) bool is workspace, all False. Returns the number of changes and the nodes that touch walls.
    """
    changes, count, after = 0, 0, np.empty_like(nodes)
    for i in nodes:
        present[i] = True
    for i in before:
        for k in range(touching.shape[1] if not present[i] else 0):
            changes += touching[i, k]
            releases[wall_of[k]] += touching[i, k]
            touching[i, k] = False
    for j in range(len(nodes)):
        i, met = nodes[j], False
        present[i] = False
        for k in range(touching.shape[1]):
            if touching[i, k] != now[j, k]:
                changes += 1
                releases[wall_of[k]] += touching[i, k]
                touching[i, k] = now[j, k]
            met = met or now[j, k]
        if met:
            after[count] = i
            count += 1
    return changes, after[:count].copy()


class ContactLog:
    """Sums over the steps of a run.

    Attributes
    ----------
    touching : (owned, slots) bool, contacts after the last step
    closed : (owned, slots) bool, nodes that have touched a wall and not left it since
    releases : (walls,) number of releases of this rank's nodes from each wall
    changes : number of contacts of this rank that closed or opened since the last row of the history
    last : (m,) nodes that touch any wall after the last step
    present : (owned,) bool, workspace of :func:`compare_contacts`
    noted : number of steps whose touched walls are not in ``time`` yet
    time : (walls,) time during which any node of the model touched each wall [s]; the same on all ranks
    """

    def __init__(self, n_owned: int, n_walls: int, wall_of: np.ndarray) -> None:
        self.touching, self.closed = np.zeros((2, n_owned, len(wall_of)), dtype=bool)
        self._wall_of = wall_of
        self.releases = np.zeros(n_walls, dtype=np.int64)
        self.changes = 0
        self.time = np.zeros(n_walls)
        self.last = np.empty(0, dtype=np.int64)
        self.present = np.zeros(n_owned, dtype=bool)
        self.noted = 0
        self._steps = np.empty(NOTED)
        self._flags = np.empty((NOTED, n_walls), dtype=np.uint8)

    def book(self, walls: WallForces, step: float, comm: MPI.Comm) -> None:
        """Record the contacts of a step of size ``step`` [s]. Collective whenever the buffer is full."""
        self.note(walls.contacts[None] > 0, step, comm)
        if len(walls.nodes) == 0 and len(self.last) == 0:
            return
        changes, self.last = compare_contacts(
            self.touching, self.last, walls.nodes, walls.touching, self.present, self.releases, self._wall_of
        )
        self.changes += changes

    def note(self, touched: np.ndarray, step: float, comm: MPI.Comm) -> int:
        """Record the walls (steps, walls) bool that were touched in some steps of one size; return how many steps were
        noted before. Collective whenever the buffer is full."""
        if self.noted + len(touched) > NOTED:
            self.meet(comm)
        begin, end = self.noted, self.noted + len(touched)
        self._steps[begin:end], self._flags[begin:end], self.noted = step, touched, end
        return begin

    def meet(self, comm: MPI.Comm, contacts: np.ndarray | None = None) -> np.ndarray:
        """Update the contact times on all ranks; return those (noted + 1, walls) before and after each noted step [s].
        Collective.

        ``contacts`` (walls,): number of nodes of all ranks in contact after the last step, if known.
        """
        n, self.noted = self.noted, 0
        flags = self._flags[:n]
        if n == 1 and contacts is not None:
            flags[0] = contacts > 0
        elif comm.size > 1 and n and len(self.time):
            comm.Allreduce(MPI.IN_PLACE, flags, op=MPI.MAX)
        times = np.cumsum(np.vstack([self.time, self._steps[:n, None] * flags]), axis=0)
        self.time[:] = times[-1]
        return times

    def share(self) -> dict[str, Any]:
        """Return this rank's sums for a checkpoint."""
        return {
            "wall_releases": self.releases.tolist(),
            "contact_changes": self.changes,
        }

    def times(self, comm: MPI.Comm) -> dict[str, Any]:
        """Return contact times, and the steps not yet added to them, for a checkpoint. Collective.

        Only :meth:`meet` adds them: other partial sums would round differently.
        """
        flags = self._flags[: self.noted].copy()
        comm.Allreduce(MPI.IN_PLACE, flags, op=MPI.MAX)
        return {"sum": self.time.tolist(), "steps": self._steps[: self.noted].tolist(), "flags": flags.tolist()}

    def load_state(self, share: dict[str, Any], times: dict[str, Any], touching: np.ndarray) -> None:
        """Restore this rank's sums, the contact times and the contacts from a checkpoint."""
        self.releases[:] = np.array(share["wall_releases"], dtype=np.int64)
        self.changes = int(share["contact_changes"])
        self.time[:] = times["sum"]
        self.noted = n = len(times["steps"])
        self._steps[:n] = times["steps"]
        self._flags[:n] = np.array(times["flags"], dtype=np.uint8).reshape(n, len(self.time))
        self.touching = touching
        self.last = np.flatnonzero(touching.any(axis=1))


_ZERO, _ALL = np.zeros(1), slice(None)
TURN = 0.8
"""Cosine between normals in a step, below which forces act along that at the new position."""


class NodeWalls:
    """All walls of a case and this rank's nodes. A node touches a wall along one plane at a time, or several faces of a
    surface of triangles: these are slots, one or three of each wall.

    Attributes
    ----------
    names : of the walls, in the order of the case
    any : whether the case has walls
    moving : (walls,) bool
    wall_of, first : (slots,) and (walls,): the wall of each slot, and the first slot of each wall
    members : (owned, slots) bool, nodes that a wall can stop
    flat : (slots,) bool, planes that never turn
    surfaces : Surfaces of the walls at rest
    centres : (walls, 3) points at rest whose positions are recorded, of walls with inertia the centres of mass [m]
    log : ContactLog
    restitution, friction, static_friction : (slots,); has_friction : whether any wall has friction
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
        self.source, self.state = case.source, None
        self.mesh, self.fixed = mesh, fixed
        self.names = [wall.name for wall in walls]
        self.any = bool(walls)
        with agreed(mesh.comm):
            x, numbers = mesh.points[: mesh.n_owned], {wall.name: k for k, wall in enumerate(case.wall)}
            keys = [f"{case.source}: wall[{numbers[wall.name]}]" for wall in walls]
            self.walls = [made_wall(wall, x, key) for wall, key in zip(walls, keys, strict=True)]
        own = [wall.centre_of_mass for wall in walls]
        self.centres = np.array([wall.centre if at is None else at for wall, at in zip(self.walls, own, strict=True)])
        self.centres = self.centres.reshape(-1, 3)
        self.motion = WallMotion(walls, self.centres, case.holds("wall"))
        self.moving = self.motion.moving
        faces = np.array([wall.faces for wall in self.walls], dtype=np.int64)
        self.wall_of, self.first = np.repeat(np.arange(len(walls)), faces), np.cumsum(faces) - faces
        self.all_nodes = np.array([wall.node_set is None for wall in walls], dtype=bool)[self.wall_of]
        self.members = np.ones((mesh.n_owned, len(self.wall_of)), dtype=bool)
        for s in np.flatnonzero(~self.all_nodes):
            self.members[:, s] = False
            self.members[nodes[walls[self.wall_of[s]].node_set], s] = True
        self.log = ContactLog(mesh.n_owned, len(walls), self.wall_of)
        friction = np.array([wall.friction_coefficients for wall in walls], dtype=np.float64).reshape(-1, 2)
        self.friction, self.static_friction = np.ascontiguousarray(friction[self.wall_of].T)
        self.restitution = np.array([wall.restitution for wall in walls], dtype=np.float64)[self.wall_of]
        self.rebounds = False
        self.has_friction = bool(self.static_friction.any())
        self.flat = (np.array([wall.flat for wall in self.walls], dtype=bool) & ~self.motion.turning)[self.wall_of]
        self.surfaces = Surfaces.of([self.walls[k] for k in self.wall_of], self.motion.turning[self.wall_of])
        self.partial = any(wall.partial for wall in self.walls)
        surfaces = ((k, wall) for k, wall in enumerate(self.walls) if wall.faces > 1)
        self._faces = {k: TouchedFaces(wall.compiled, wall.planes, mesh.n_owned) for k, wall in surfaces}
        ends = np.stack([-mesh.points.min(axis=0, initial=np.inf), mesh.points.max(axis=0, initial=-np.inf)])
        mesh.comm.Allreduce(MPI.IN_PLACE, ends, op=MPI.MAX)
        coordinates = float(np.abs(ends).max()), float(np.abs(self.centres).max(initial=0.0))
        self.size = resolvable(float(ends.sum(axis=0).max()), *coordinates)

    @cached_property
    def nothing(self) -> WallForces:
        """Zero contact forces, shared by all steps without contact; the sums are read-only."""
        vectors, nobody, slots = np.zeros((len(self.walls), 3)), np.empty(0, dtype=np.int64), len(self.wall_of)
        sums = vectors, np.zeros(len(self.walls), dtype=np.int64), vectors
        for array in sums:
            array.flags.writeable = False
        return WallForces(*sums, nobody, np.empty((0, slots), dtype=bool), np.empty((0, 3)))

    def of_walls(self, sums: np.ndarray) -> np.ndarray:
        """Return sums over the slots of each wall (walls, ...) from those of slots (slots, ...)."""
        return np.add.reduceat(sums, self.first, axis=0)

    def positions(self, time: float) -> np.ndarray:
        """Return the positions of the walls' centres, of mass for walls with inertia (walls, 3) [m]."""
        return self.motion.poses(time).carried(np.arange(len(self.walls)), self.centres)

    def velocities(self, time: float) -> np.ndarray:
        """Return the velocities of the walls' centres (walls, 3) [m/s]."""
        every = np.arange(len(self.walls))
        return self.motion.rates_at(self.positions(time), time)[every, every]

    def ways(self, x: np.ndarray, before: Poses, after: Poses) -> np.ndarray:
        """Return how far walls carry their points at (m, 3) from earlier to later poses, (m, slots, 3) [m]."""
        return before.ways(after, x)[:, self.wall_of]

    def rates(self, x: np.ndarray, time: float, ahead: bool = False) -> np.ndarray:
        """Return the velocities of the walls' points at (m, 3), (m, slots, 3) [m/s]; see :meth:`WallMotion.rates`."""
        return self.motion.rates_at(x, time, ahead)[:, self.wall_of]

    def gaps(self, x: np.ndarray, time: float, nodes: np.ndarray | None = None) -> np.ndarray:
        """Return distances (m, walls) [m] of owned nodes at (m, 3) from walls, infinite where a wall does not apply.

        ``nodes`` (m,) : indices of these nodes; default: all owned nodes.
        """
        members = self.members if nodes is None else self.members[nodes]
        poses = self.motion.poses(time)
        gaps = [self.gap(k, x, poses) for k in range(len(self.walls))]
        return np.where(members[:, self.first], np.transpose(gaps), np.inf)

    def gap(self, k: int, x: np.ndarray, poses: Poses) -> np.ndarray:
        """Return distances (m,) [m] of positions (m, 3) from wall k."""
        return self.walls[k].gaps(poses.rest(k, x))

    def near(
        self, x: np.ndarray, poses: Poses, reach: np.ndarray = _ZERO, nodes: np.ndarray | slice = _ALL
    ) -> np.ndarray:
        """Return (m,) bool: nodes (m,) at positions (m, 3) within ``reach``, (m,) or (1,) [m], of a wall; default: all
        owned nodes.

        With a reach of zero these are the nodes beyond a wall.
        """
        near, members = np.zeros(len(x), dtype=bool), self.members[nodes]
        if self._faces:
            start, earlier, slack = self._starts(nodes, x, poses)
        for k, s in enumerate(self.first):
            if k in self._faces:
                close = self._faces[k].near(earlier.rest(k, start), poses.rest(k, x), reach, slack)
            else:
                close = self.gap(k, x, poses) < reach
            near |= close & members[:, s]
        return near

    def applicable(self, nodes: np.ndarray, x: np.ndarray, poses: Poses) -> np.ndarray:
        """Return (m, slots) bool: walls that can stop nodes that move to positions (m, 3)."""
        applicable = self.members[nodes]
        if self.partial and self.state is not None:
            before, earlier, _ = self._starts(nodes, x, poses)
            for k, wall in enumerate(self.walls):
                if wall.partial:
                    # a node in contact may lie beyond the wall, because the balance need not hold at its position
                    held = self.state.contact[nodes] @ earlier.turned(k, wall.normal) > 0.0
                    slack = np.where(held, 0.1 * wall.half.min(), BEYOND * self.size)
                    applicable[:, self.first[k]] &= wall.stops(earlier.rest(k, before), poses.rest(k, x), slack)
        return applicable

    def slots(self, k: int) -> slice:
        """Return the slots of wall k."""
        return slice(self.first[k], self.first[k] + self.walls[k].faces)

    @property
    def surfaces_of_triangles(self) -> list[int]:
        """The walls that are surfaces of triangles."""
        return list(self._faces)

    def forget_faces(self) -> None:
        """Begin a step: find the faces of surfaces that nodes touch anew."""
        for faces in self._faces.values():
            faces.forget()

    def find_faces(self, nodes: np.ndarray, x: np.ndarray, poses: Poses, tolerance: float) -> bool:
        """Find the faces of surfaces that stop nodes (m,) which move to (m, 3), beside those found in this step; return
        whether there are other ones now. ``tolerance``: depth that counts as zero [m]."""
        if not self._faces:
            return False
        start, earlier, slack = self._starts(nodes, x, poses)
        found = False
        for k, faces in self._faces.items():
            mine = self.members[nodes, self.first[k]]
            ways = (
                earlier.rest(k, start[mine]),
                poses.rest(k, x[mine]),
                self.fixed[nodes[mine]] & ~self.motion.turning[k],
                slack[mine],
            )
            memory = {} if self.state is None else self.state.memory
            if (name := f"faces_{k}") not in memory:
                memory[name] = np.zeros((self.mesh.n_owned, 9))
            slots = self.slots(k)
            occupied = self.log.touching[nodes[mine], slots] | self.log.closed[nodes[mine], slots]
            found |= faces.find(nodes[mine], ways, tolerance, (memory[name], occupied))
        return found

    def _starts(self, nodes: np.ndarray | slice, x: np.ndarray, poses: Poses) -> tuple[np.ndarray, Poses, np.ndarray]:
        """Return where nodes that move to (m, 3) were at the start of the step, the poses of the walls there, and by
        how much they may have been behind a wall (m,) [m]."""
        if self.state is None:  # they are where they should not be
            return x, poses, np.full(len(x), np.inf)
        start = self.state.position[nodes]
        # a node in contact may lie beyond the wall, because the balance need not hold at its position
        held = (self.state.contact[nodes] != 0.0).any(axis=1)
        slack = np.where(held, np.linalg.norm(x - start, axis=1), 0.0) + BEYOND * self.size
        return start, self._poses_before(), slack

    def _poses_before(self) -> Poses:
        return self.motion.poses(self.state.time)

    def planes(
        self,
        applicable: np.ndarray,
        x: np.ndarray,
        poses: Poses,
        acting: np.ndarray | None = None,
        nodes: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return planes (m, slots, 3), (m, slots) at positions (m, 3), with offset -inf for walls that do not apply.

        ``acting`` : result of :meth:`acting`. Planes of curved walls then have these normals, at the same distance.
        ``nodes`` (m,) : owned nodes, whose faces of surfaces are those that :meth:`find_faces` has found; default: the
        face nearest to each position.
        """
        normals = np.zeros((len(x), len(self.wall_of), 3))
        offsets = np.full((len(x), len(self.wall_of)), -np.inf)
        for k, wall in enumerate(self.walls):
            s, rest, slots = self.first[k], poses.rest(k, x), self.slots(k)
            if self.flat[s]:
                normals[:, s], offsets[:, s] = wall.normal, wall.offset + wall.normal @ poses.shifts[k]
                continue
            if k in self._faces:
                own, distances = self._faces[k].planes(nodes, rest)
            else:
                own, distances = wall.planes(rest)[0][:, None], wall.gaps(rest)[:, None]
            normals[:, slots] = poses.turned(k, own)
            if acting is not None:
                np.copyto(normals[:, slots], acting[:, slots], where=acting[:, slots].any(axis=2, keepdims=True))
            along = np.einsum("mwi,mi->mw", normals[:, slots], x)
            offsets[:, slots] = np.where(np.isfinite(distances), along - distances, -np.inf)
        offsets[~applicable] = -np.inf
        return normals, offsets

    def distances(
        self, applicable: np.ndarray, x: np.ndarray, poses: Poses, nodes: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return normals (m, slots, 3) at positions (m, 3), and distances (m, slots) along them, infinite for walls
        that do not apply; ``nodes``: see :meth:`planes`."""
        normals, offsets = self.planes(applicable, x, poses, nodes=nodes)
        return normals, np.einsum("mwi,mi->mw", normals, x) - offsets

    def deepest(self, x: np.ndarray, time: float, tolerance: float) -> tuple[float, int, int, int] | None:
        """Return depth [m], mesh number and wall of the node farthest beyond a wall, and how many nodes are beyond that
        wall; None if none is by more than the tolerance. Nodes can pass beside partial walls, which do not count.
        Collective.

        ``x`` (owned, 3) : positions at a time [s]
        """
        comm, gaps = self.mesh.comm, self.gaps(x, time)
        gaps[:, [wall.partial for wall in self.walls]] = np.inf
        # a NaN has its own message elsewhere
        suspects = np.flatnonzero((gaps < -tolerance).any(axis=1))
        if comm.allreduce(len(suspects), op=MPI.MAX) == 0:
            return None
        lowest = (0.0, -1, -1)
        if len(suspects):
            at, wall = np.unravel_index(int(gaps[suspects].argmin()), (len(suspects), len(self.walls)))
            lowest = (float(gaps[suspects[at], wall]), int(self.mesh.node_ids[suspects[at]]), int(wall))
        depth, node, wall = min(comm.allgather(lowest))
        return -depth, node, wall, comm.allreduce(int((gaps[:, wall] < -tolerance).sum()))

    def acting(self, nodes: np.ndarray, x: np.ndarray, poses: Poses, part: float) -> np.ndarray | None:
        """Return the directions (m, slots, 3) in which curved walls push nodes (m,) that move to (m, 3) in a step.

        These are the normals where the forces of the step's balance act, at the fraction ``part`` of the way
        (:attr:`~pfem_petsc.integrators.base.Balance.acting`). None: all are the normals at the end. So are those that
        are zero in the result: of flat walls, of triangles, and where the normal turns by more than 37 degrees on the
        way, because a force along the earlier normal may not reach the surface.

        ``poses`` : of the walls at the end
        """
        if part == 1.0 or self.flat.all():
            return None
        return self.acting_from(self.state.position[nodes], x, poses, part, nodes)

    def acting_from(
        self, start: np.ndarray, x: np.ndarray, poses: Poses, part: float, nodes: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the directions of :meth:`acting` of nodes that move from ``start`` to x (m, 3)."""
        earlier = self._poses_before()
        acting = np.zeros((len(x), len(self.wall_of), 3))
        between = self.motion.poses(earlier.time + part * (poses.time - earlier.time)) if len(poses.turns) else poses
        for k, s in enumerate(self.first):
            if k in self._faces:  # faces are flat: their normals are those of where the body is there
                own, _ = self._faces[k].planes(nodes, poses.rest(k, x))
                acting[:, self.slots(k)] = between.turned(k, own)
            elif not self.flat[s]:
                end, before = poses.rest(k, x), earlier.rest(k, start)
                there = between.turned(k, self.walls[k].planes(before + part * (end - before))[0])
                turn = np.einsum("mi,mi->m", there, poses.turned(k, self.walls[k].planes(end)[0]))
                acting[:, s] = np.where((turn > TURN)[:, None], there, 0.0)
        return acting

    def sums(
        self,
        nodes: np.ndarray,
        force: np.ndarray,
        at: tuple[np.ndarray, np.ndarray],
        touching: np.ndarray,
        friction: float = 0.0,
    ) -> WallForces:
        """Return sums of forces (m, slots, 3) on nodes, ``at`` their positions and where the forces of the balance act
        (m, 3); ``friction``: energy dissipated in the step [J]."""
        x, acts = at
        moment = self.of_walls(np.cross(acts[:, None, :], force).sum(axis=0))
        contacts = np.logical_or.reduceat(touching, self.first, axis=1).sum(axis=0)
        return WallForces(self.of_walls(force.sum(axis=0)), contacts, moment, nodes, touching, x, friction)

    def infeasible_message(self, node: int, offsets: np.ndarray) -> str:
        """Return the message about a node (owned index) whose planes (slots,) are infeasible together."""
        touched = dict.fromkeys(self.names[k] for k in self.wall_of[offsets > -np.inf])
        return (
            f"no position of node {self.mesh.node_ids[node]} satisfies all walls "
            f"({', '.join(touched) or 'and contact pairs'}) and its supports: they are infeasible together; move the "
            "walls apart, or free the node"
        )

"""Coulomb friction of nodes at walls: the local problem of a node in an implicit step, nodes that friction jams, and
which nodes stick or slip, at walls or in the relative coordinates of rows.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..integrators.base import Balance, State
from ..tolerances import FREE_PART, ON_BOUND, PROJECTED
from .frames import NodalFrames, RelativeCoordinates, Sliding, SlipForces
from .node_walls import free_squares
from .projection import NodesAtPlanes, Planes, Pressed, pressed

if TYPE_CHECKING:
    from ..mechanics.mass import Inertia
    from .node_walls import NodeWalls


FAST = 1e16
"""Weight of velocities relative to accelerations in the direction of slip of nodes at rest on walls."""


def planes_at_rest(
    contact: NodeWalls, rests: np.ndarray, motion: tuple[np.ndarray, np.ndarray, np.ndarray], still: float
) -> Planes:
    """Return the planes that bound the accelerations of nodes (n,) at rest on walls, with slips along their velocity
    where they slide, else along their acceleration.

    Parameters
    ----------
    contact : NodeWalls, at the time of its state
    rests : (n, w) bool, walls that each rests on
    motion : positions, velocities and accelerations (n, 3)
    still : velocity that counts as none [m/s]
    """
    (x, v, a), time = motion, contact.state.time
    normals, _ = contact.planes(rests, x, contact.motion.poses(time))
    rates = contact.rates(x, time, ahead=True)
    relative = a[:, None, :] - contact.motion.accelerations_at(x, time)[:, contact.wall_of]
    gaps = np.where(rests, np.einsum("nwi,nwi->nw", normals, relative), np.inf)
    fast = FAST * np.abs(a).max(initial=0.0) / max(np.abs(v).max(initial=0.0), np.abs(rates).max(initial=0.0), still)
    friction = np.tile(np.stack([contact.friction, contact.static_friction], axis=1), (len(x), 1, 1))
    return Planes(normals, gaps, friction, relative + fast * sliding(v[:, None, :] - rates, normals, still))


def sliding(rates: np.ndarray, normals: np.ndarray, still: float) -> np.ndarray:
    """Return the parts of velocities (..., 3) across unit vectors (..., 3), zero where they are at most ``still``."""
    across = rates - np.einsum("...i,...i->...", rates, normals)[..., None] * normals
    return np.where(np.linalg.norm(across, axis=-1, keepdims=True) > still, across, 0.0)


def jam(contact: NodeWalls, node: int, normals: np.ndarray) -> str:
    """Return why the friction of an owned node has no solution, and the remedy; empty if the node is not jammed.

    Parameters
    ----------
    contact : NodeWalls
    normals : (w, 3) of the walls at the node
    """
    fixed = contact.fixed[node]
    if not fixed.any():
        return ""
    square = free_squares(fixed, normals)
    least = np.sqrt(square / np.maximum(1.0 - square, 1e-300))
    jams = contact.members[node] & (square > FREE_PART) & (contact.static_friction >= np.maximum(least, 1e-300))
    if not jams.any():
        return ""
    wall = int(np.flatnonzero(jams)[0])
    name = contact.names[contact.wall_of[wall]]
    return (
        f"friction jams node {contact.mesh.node_ids[node]}: its supports let it move only at an angle at which wall "
        f"{name!r} cannot push it if the coefficient of friction is {least[wall]:.3g} or more, and it "
        f"is {contact.static_friction[wall]:.3g}; reduce the friction, free the node, or name the nodes that the wall "
        "stops with 'node_set'"
    )


# Weight of the known direction relative to the one solved for, multiplied by ten after each failure. 0.01 saves a fifth
# of the solves at first, but fails if nodes slip by micrometres.
_FIRM = 0.1
# The error of directions falls by about the weight from solve to solve. Once they are all that changes, the weight
# falls as well, from this number of solves on.
_STEADY = 2
_SOFTER, _LEAST = 0.1, 1e-4


class StepFriction:
    """Friction in one implicit step, at the slots of walls and, behind them, of tables of rows.

    Positions are those of nodes, at carriers of rows relative ones, see
    :class:`~pfem_petsc.contact.frames.RelativeCoordinates`.

    Parameters
    ----------
    contact : walls
    inertia : of the nodes
    stiffness : (owned,) of the bars at each node [N/m]
    state : at the start of the step
    balance : of the step
    relative : coordinates of rows with friction; None if the case has none

    Attributes
    ----------
    slots : of walls and tables
    drag : (m, slots, 3) friction forces on the nodes of the frames, after :meth:`check` [N]
    unsettled : owned nodes whose solution violated the law in :meth:`check`
    """

    def __init__(
        self,
        contact: NodeWalls,
        inertia: Inertia,
        stiffness: np.ndarray,
        state: State,
        balance: Balance,
        relative: RelativeCoordinates | None = None,
    ) -> None:
        self.contact, self.comm = contact, contact.mesh.comm
        self.state = state
        self._poses = contact.motion.poses(state.time), contact.motion.poses(balance.time)
        inertial = balance.alpha * inertia.mass + balance.eta * inertia.damping
        self._nodal = inertial, inertial + balance.weight * stiffness
        self._inertial, self._stiffness = self._nodal
        self._start, self._reaction = state.position, state.contact
        self._friction, self._static = contact.friction, contact.static_friction
        self._carried = np.full(len(state.position), -1)  # the row that each owned node carries, -1 for none
        if relative is not None:
            self._friction = np.append(self._friction, relative.friction)
            self._static = np.append(self._static, relative.static)
        self.slots = walls = len(self._static)
        self._rubs = bool(self._static.any())
        owned = len(contact.members) * self._rubs  # without friction no node sticks or slips
        # guessed; known to slip along their direction; found not to stick
        self._guessed, self._slips, self._failed = np.zeros((3, owned), dtype=bool)
        self._sticks = np.full(owned, -1)  # the slot of what a node sticks to, -1 for none
        self._directions = np.zeros((owned, walls, 3))  # d a of slipping nodes
        self._forces = np.zeros((owned, 3))  # friction force on each node in its last local solution
        self._firmness = _FIRM
        self._steady = 0  # solves in which no node has begun or ceased to stick or to slip
        self._lagged = False  # friction is treated as a known force
        self.drag = np.zeros((0, walls, 3))
        self.unsettled = np.empty(0, dtype=np.int64)

    def relate(self, relative: RelativeCoordinates) -> None:
        """Take the carriers of rows in the next solves; nodes that carry other rows than before begin anew.
        Collective."""
        carried = np.full_like(self._carried, -1)
        carried[relative.nodes] = relative.at
        changed = carried != self._carried
        if not self.comm.allreduce(int(changed.any()), op=MPI.MAX):
            return
        self._carried = carried
        if self._rubs:
            self._guessed[changed] = self._slips[changed] = self._failed[changed] = False
            self._sticks[changed], self._directions[changed] = -1, 0.0
        self._inertial, self._stiffness = (relative.stiffness(nodal) for nodal in self._nodal)
        self._start = relative.positions(self.state.position)
        self._reaction = relative.forces(self.state.contact)

    def dissipated(self, nodes: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Return the energy that friction dissipates in each slot, on nodes (m,) of the frames at (m, 3) [J]."""
        return -(self.drag * ((x - self._start[nodes])[:, None, :] - self._ways(nodes))).sum(axis=(0, 2))

    def _ways(self, nodes: np.ndarray) -> np.ndarray:
        """Return how far walls carry nodes (k,) that stick to them in the step, (k, slots, 3) [m]."""
        ways = np.zeros((len(nodes), self.slots, 3))
        ways[:, : len(self.contact.wall_of)] = self.contact.ways(self.state.position[nodes], *self._poses)
        return ways

    def apply(self, frames: NodalFrames) -> None:
        """Fix the sticking nodes of the frames and apply friction to the slipping ones, at the places of the frames."""
        if not self._rubs:
            return
        nodes = frames.nodes
        has_friction = self._has_friction(frames)
        at = np.flatnonzero(has_friction & ~self._guessed[nodes])
        if len(at):
            x, slipping = frames.places[at], np.zeros(len(at), dtype=bool)
            own = self._local(frames, at, x, self._reaction[nodes[at]], slipping)
            self._forces[nodes[at]] = own.drag.sum(axis=1)
            self._decide(frames, at, x, slipping, own)
            self._guessed[nodes[at]] = True
        self._hold(frames, np.flatnonzero(has_friction & (self._sticks[nodes] >= 0)))
        moving = has_friction & (self._sticks[nodes] < 0) & (self._directions[nodes] != 0.0).any(axis=(1, 2))
        frames.sliding = self._slide(frames, np.flatnonzero(moving))

    def check(
        self,
        frames: NodalFrames,
        x: np.ndarray,
        reaction: np.ndarray,
        strengths: np.ndarray,
        noise: float,
        tolerance: float,
    ) -> np.ndarray:
        """Find the nodes that violate the law; return normal forces (m, slots) of all nodes of the frames [N].

        Parameters
        ----------
        x, reaction : (m, 3) positions and forces by walls of the frames' nodes [m], [N]
        strengths : (m, slots) normal forces without friction; used for nodes at frictionless walls only
        noise : force below which a force counts as zero [N]
        tolerance : of the forces [N]
        """
        nodes, contact = frames.nodes, self.contact
        self.drag = np.zeros((*strengths.shape, 3))
        if not self._rubs:
            return strengths
        strengths = strengths.copy()
        at = np.flatnonzero(self._has_friction(frames))
        slipping = self._sticks[nodes[at]] < 0
        own = self._local(frames, at, x[at], reaction[at], slipping)
        moved, normal_forces, drag = own
        stiffness = self._stiffness[nodes[at]]
        self._forces[nodes[at]] = drag.sum(axis=1)
        before = self._sticks.copy(), self._slips.copy()
        apart = stiffness * np.linalg.norm(moved - x[at], axis=1)
        # rounding of positions, and of the frames' coordinates on the way to them
        floor = 2e-14 * stiffness * (np.abs(x[at]).sum(axis=1) + contact.size)
        kept = apart <= np.maximum(max(tolerance, 2.0 * noise), floor)
        wrong = np.flatnonzero(~kept)
        if len(wrong):
            self._decide(frames, at[wrong], x[at[wrong]], slipping[wrong], Pressed(*(each[wrong] for each in own)))
        may = self._may_stick(nodes[at], slipping & kept, x[at], normal_forces, frames.normals[at])
        trying = may.any(axis=1)
        self._sticks[nodes[at[trying]]] = may[trying].argmax(axis=1)
        self.unsettled = nodes[np.union1d(at[wrong], at[trying])]
        self._soften(before)
        none = normal_forces <= noise
        normal_forces[none], drag[none] = 0.0, 0.0
        strengths[at], self.drag[at] = normal_forces, drag
        return strengths

    def _soften(self, before: tuple[np.ndarray, np.ndarray]) -> None:
        """Reduce the weight of known directions if statuses, ``before`` and now, are the same. Collective."""
        changed = any((now != was).any() for now, was in zip((self._sticks, self._slips), before, strict=True))
        self._steady = 0 if self.comm.allreduce(int(changed)) else self._steady + 1
        if self._steady >= _STEADY:
            self._firmness = max(_SOFTER * self._firmness, _LEAST)

    def relax(self) -> bool:
        """Simplify the next solve after a failure; return whether it could be simplified. Collective.

        First the directions are fixed, then friction forces are fixed as well.
        """
        slips, moves = bool(self._slips.any()), bool((self._directions != 0.0).any())
        turning, moving = self.comm.allreduce(np.array([slips, moves], dtype=np.int64)) > 0
        self._slips[:] = False
        self._firmness *= 10.0
        self._steady = 0
        if turning:
            return True
        lagged, self._lagged = self._lagged, True
        return moving and not lagged

    def jams(self, nodes: np.ndarray, x: np.ndarray) -> list[str]:
        """Return messages about nodes (k,) at (owned, 3) that are jammed in a self-locking wedge by friction."""
        normals, _ = self.contact.planes(self.contact.members[nodes], x[nodes], self._poses[1], nodes=nodes)
        return [text for node, n in zip(nodes, normals, strict=True) if (text := jam(self.contact, node, n))]

    def _has_friction(self, frames: NodalFrames) -> np.ndarray:
        """Return (m,) bool: frames with a wall that has friction."""
        return ((frames.rows >= 0) & (self._static > 0.0)).any(axis=1)

    def _local(
        self, frames: NodalFrames, at: np.ndarray, x: np.ndarray, reaction: np.ndarray, slipping: np.ndarray
    ) -> Pressed:
        """Solve the local problems of some of the frames' nodes, at (k, 3) with forces by walls (k, 3), at tangent
        planes. Slipping nodes (k,) use the dynamic coefficient only; whether they stick is determined by a trial."""
        nodes, contact = frames.nodes[at], self.contact
        fixed, stiffness, normals = contact.fixed[nodes], self._stiffness[nodes], frames.normals[at]
        free = x - np.where(fixed, 0.0, reaction) / stiffness[:, None]
        gaps = np.einsum("mwi,mi->mw", normals, free) - frames.offsets[at]
        static = np.where(slipping[:, None], self._friction, self._static)
        friction = np.stack([np.broadcast_to(self._friction, static.shape), static], axis=-1)
        planes = Planes(normals, gaps, friction, (free - self._start[nodes])[:, None, :] - self._ways(nodes))
        return pressed(NodesAtPlanes(free, fixed, stiffness, planes), PROJECTED * contact.size)

    def _may_stick(
        self, nodes: np.ndarray, slipping: np.ndarray, x: np.ndarray, normal_forces: np.ndarray, normals: np.ndarray
    ) -> np.ndarray:
        """Return (k, w) bool: walls whose static coefficient may stop slipping nodes, which is tried once."""
        slip = self._slip(nodes, x, normals)
        # if the rest of the truss moves along, inertia alone resists
        needed = self._friction * normal_forces + self._inertial[nodes, None] * np.linalg.norm(slip, axis=2)
        may = (self._static > self._friction) & (needed <= self._static * normal_forces)
        return may & (normal_forces > 0.0) & (slipping & ~self._failed[nodes])[:, None]

    def _slip(self, nodes: np.ndarray, x: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Return the slip of nodes at (k, 3) on their walls (k, w, 3) [m]."""
        slip = x[:, None, :] - self._start[nodes][:, None, :] - self._ways(nodes)
        return slip - np.einsum("kwi,kwi->kw", slip, normals)[:, :, None] * normals

    def _decide(self, frames: NodalFrames, at: np.ndarray, x: np.ndarray, slipping: np.ndarray, own: Pressed) -> None:
        """Decide which nodes stick or slip in the next solve, from positions x and the solutions of local problems."""
        nodes = frames.nodes[at]
        moved, normal_forces, drag = own
        slip = self._slip(nodes, moved, frames.normals[at])
        size = np.linalg.norm(drag, axis=2)
        # a normal force within rounding neither sticks nor causes friction
        rubbing = (normal_forces > (1e-9 * normal_forces.max(axis=1, initial=0.0))[:, None]) & (self._static > 0.0)
        needed = np.linalg.norm(drag - self._stiffness[nodes, None, None] * slip, axis=2)
        limit = np.where(slipping[:, None], self._friction, self._static) * normal_forces
        slips = rubbing & (needed > (1.0 + 1e-13) * limit)
        was = self._sticks[nodes] >= 0
        forwards = np.einsum("kwi,kwi->kw", self._slip(nodes, x, frames.normals[at]), self._directions[nodes])
        # friction has reversed the slip, so it is large enough to stop it
        slips &= (forwards >= 0.0) | was[:, None]
        holds = rubbing & ~slips
        infeasible = holds.any(axis=1)
        unit = np.where(slips[:, :, None], -drag / np.maximum(size, 1e-300)[:, :, None], 0.0)
        self._slips[nodes] = ~infeasible & ~was & (forwards > 0.0).any(axis=1)
        self._failed[nodes] |= was & ~infeasible
        self._sticks[nodes] = np.where(infeasible, holds.argmax(axis=1), -1)
        self._directions[nodes] = unit * np.maximum(self._friction * normal_forces, 1e-300)[:, :, None]

    def _hold(self, frames: NodalFrames, at: np.ndarray) -> None:
        """Fix sticking nodes at zero slip."""
        nodes = frames.nodes[at]
        wall = self._sticks[nodes]
        row = frames.rows[at, wall]
        place = self._start[nodes] + self._ways(nodes)[np.arange(len(at)), wall]
        n = frames.normals[at, wall]
        place += (frames.offsets[at, wall] - np.einsum("ki,ki->k", n, place))[:, None] * n
        held = np.einsum("kij,kj->ki", frames.basis[at], place)
        which = ~self.contact.fixed[nodes] & (np.arange(3) != row[:, None])
        slack = ON_BOUND * self.contact.size
        fits = (held >= frames.lower[at] - slack) & (held <= frames.upper[at] + slack)
        # another wall pushes the node along, or its wall has no row: it cannot stick
        possible = (fits | ~which).all(axis=1) & (row >= 0)
        self._sticks[nodes[~possible]] = -1
        frames.pin(at[possible], held[possible], which[possible])

    def _slide(self, frames: NodalFrames, at: np.ndarray) -> Sliding:
        nodes = frames.nodes[at]
        friction = np.where((self._directions[nodes] != 0.0).any(axis=2), self._friction, 0.0)
        friction = np.where(frames.rows[at] >= 0, friction, 0.0)
        for k in range(1, friction.shape[1]):
            # where walls share a bound, one takes the force
            shared = (frames.rows[at, :k] == frames.rows[at, k][:, None]) & (friction[:, :k] > 0.0)
            friction[shared.any(axis=1), k] = 0.0
        slips = self._slips[nodes]
        known = np.zeros((len(at), 3))
        if self._lagged:
            known, friction = self._forces[nodes], np.zeros_like(friction)
        start = np.where(slips[:, None, None], self._firmness, 1.0) * self._directions[nodes]
        origins = self._start[nodes][:, None, :] + self._ways(nodes)
        weight = np.where(slips, self._stiffness[nodes], 0.0)
        return Sliding(frames, at, SlipForces(known, friction, origins, start, weight))

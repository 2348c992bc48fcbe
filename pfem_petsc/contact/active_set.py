"""The active set of contact in an implicit step: bounded solves until all rows of walls and links hold, with Coulomb
friction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..errors import NotConverged
from ..integrators.base import Balance, State
from ..tolerances import BEYOND, ON_BOUND, PROJECTED
from .contact import Candidates, expected_candidates
from .explicit import LocalSolution, Rubbing, jam, solve_locally
from .frames import MIN_VOLUME, NodalFrames, Sliding
from .node_walls import WallForces, held_by_supports
from .projection import project
from .transform import RowCoordinates, Transform

if TYPE_CHECKING:
    from ..stepping.model import Model
    from ..stepping.problem import StepProblem
    from .contact import Contact


@dataclass(frozen=True)
class Bounds:
    """Lower and upper bounds that the rows of walls and links place on the unknowns.

    Attributes
    ----------
    arrays : lower and upper bounds (owned, 3) [m], infinite where there is no bound; None in free flight
    """

    arrays: tuple[np.ndarray, np.ndarray] | None = None

    def clip(self, w: np.ndarray) -> np.ndarray:
        """Return a guess (owned, 3) clipped exactly to the bounds."""
        return w if self.arrays is None else np.clip(w, *self.arrays)

    def project(self, w: np.ndarray, within: float) -> None:
        """Set unknowns (owned, 3) within ``within`` [m] of a bound to the bound, in place."""
        for bound in self.arrays or ():
            near = np.abs(w - bound) <= within
            w[near] = bound[near]

    def active(self, nodes: np.ndarray, w: np.ndarray, g: np.ndarray, noise: float) -> np.ndarray:
        """Return (m, 3) int8: -1 where an unknown of nodes (m,) is active at its lower bound, 1 at the upper, else 0.

        ``w`` (owned, 3); ``g`` (m, 3) residual of these nodes, zero up to ``noise`` [N].
        """
        lower, upper = self.arrays
        active = np.zeros((len(nodes), 3), dtype=np.int8)
        active[(w[nodes] <= lower[nodes]) & (g > noise)] = -1
        active[(w[nodes] >= upper[nodes]) & (g < -noise)] = 1
        return active


def broken_walls(
    contact: Contact,
    displacements: np.ndarray,
    candidates: Candidates,
    frames: NodalFrames,
    x: np.ndarray,
    tolerance: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes (k,) beyond walls that no bound of theirs represents, and these walls (k, walls) bool.

    Parameters
    ----------
    contact : Contact
    displacements : (walls, 3) of walls [m]
    candidates, frames : of the solve
    x : (owned, 3) solution [m]
    tolerance : depth that counts as zero [m]
    """
    beyond = np.flatnonzero(contact.near(x, displacements, np.array([-tolerance])))
    applicable = contact.applicable(beyond, x[beyond], displacements)
    normals, gaps = contact.distances(applicable, x[beyond], displacements)
    broken = gaps < -tolerance
    place = np.searchsorted(candidates.nodes, beyond)
    known = place < len(candidates.nodes)
    known[known] = candidates.nodes[place[known]] == beyond[known]
    # walls with their own bound are satisfied to rounding of the coordinates; supports override walls
    place = place[known]
    broken[known] &= (frames.rows[place] < 0) | frames.shared[place]
    broken &= ~contact.ties.held[beyond][:, None]
    broken &= ~held_by_supports(contact.fixed[beyond][:, None, :], normals)
    met = broken.any(axis=1)
    return beyond[met], broken[met]


def is_misaligned(frames: NodalFrames, strengths: np.ndarray) -> bool:
    """Return whether a wall presses through the row of an almost parallel wall, so that the force is off its normal."""
    normal_forces = strengths > 0.0
    astray = normal_forces & frames.shared
    for node, wall in np.argwhere(astray):
        own = (frames.rows[node] == frames.rows[node, wall]) & ~frames.shared[node]
        turn = np.abs(
            frames.normals[node, wall] - frames.signs[node, wall] * frames.basis[node, frames.rows[node, wall]]
        )
        if turn.max() > ON_BOUND and not (normal_forces[node] & own).any():
            return True
    return False


def is_off_surface(
    contact: Contact,
    displacements: np.ndarray,
    frames: NodalFrames,
    strengths: np.ndarray,
    x: np.ndarray,
    tolerance: float,
    part: float,
) -> bool:
    """Return whether a node in contact with a curved wall is off its surface or used the normal of another point.

    A node without contact force may satisfy the plane of another point and still lie beyond the wall. ``part``: see
    :meth:`~pfem_petsc.contact.contact.Contact.acting`.
    """
    at = frames.nodes
    acting = contact.acting(at, x[at], displacements, part)
    normals, _ = contact.planes(strengths > 0.0, x[at], displacements, acting)
    for k in np.flatnonzero(~contact.flat):
        pressed = strengths[:, k] > 0.0
        passed = ~pressed & (frames.rows[:, k] >= 0)
        if passed.any() and (contact.gap(k, x[at[passed]], displacements) < -tolerance).any():
            return True
        if pressed.any():
            turn = np.abs(normals[pressed, k] - frames.normals[pressed, k]).max(axis=1)
            # far from the origin, the rounding of positions turns normals by more
            moved = np.abs(x[at[pressed]] - frames.places[pressed]).max(axis=1)
            turned = (turn > ON_BOUND) & (moved > PROJECTED * contact.size)
            if np.abs(contact.gap(k, x[at[pressed]], displacements)).max() > tolerance or turned.any():
                return True
    return False


# Weight of the known direction relative to the one solved for, multiplied by ten after each failure. 0.01 saves a fifth
# of the solves at first, but fails if nodes slip by micrometres.
_FIRM = 0.1
# The error of directions falls by about the weight from solve to solve. Once they are all that changes, the weight
# falls as well, from this number of solves on.
_STEADY = 2
_SOFTER, _LEAST = 0.1, 1e-4


class StepFriction:
    """Friction in one implicit step.

    Parameters
    ----------
    model : Model
    state : at the start of the step
    balance : of the step

    Attributes
    ----------
    drag : (m, walls, 3) friction forces on the nodes of the frames, after :meth:`check` [N]
    unsettled : owned nodes whose solution violated the law in :meth:`check`
    """

    def __init__(self, model: Model, state: State, balance: Balance) -> None:
        self.model = model
        self.contact = model.contact
        self.state = state
        displacements = self.contact.motion.displacements
        self._way = displacements(balance.time) - displacements(state.time)
        inertia = model.inertia
        self._inertial = balance.alpha * inertia.mass + balance.eta * inertia.damping
        self._stiffness = self._inertial + balance.weight * model.nodal_stiffness
        owned, walls = self.contact.members.shape
        owned *= self.contact.has_friction  # without friction no node sticks or slips
        self._guessed = np.zeros(owned, dtype=bool)
        self._sticks = np.full(owned, -1)  # the wall that a node sticks to, -1 for none
        self._directions = np.zeros((owned, walls, 3))  # d a of slipping nodes
        self._slips = np.zeros(owned, dtype=bool)  # known to slip along their direction
        self._forces = np.zeros((owned, 3))  # friction force on each node in its last local solution
        self._firmness = _FIRM
        self._steady = 0  # solves in which no node has begun or ceased to stick or to slip
        self._lagged = False  # friction is treated as a known force
        self._failed = np.zeros(owned, dtype=bool)  # found not to stick
        self.drag = np.zeros((0, walls, 3))
        self.unsettled = np.empty(0, dtype=np.int64)

    def add(self, force: np.ndarray, nodes: np.ndarray, x: np.ndarray) -> float:
        """Add friction to the forces (m, walls, 3) on nodes (m,) at (m, 3) [N]; return the energy dissipated [J]."""
        force += self.drag
        slip = (x - self.state.position[nodes])[:, None, :] - self._way
        return -float((self.drag * slip).sum())

    def apply(self, frames: NodalFrames, x: np.ndarray) -> None:
        """Fix the sticking nodes of the frames and apply friction to the slipping ones, at a guess (owned, 3)."""
        if not self.contact.has_friction:
            return
        nodes = frames.nodes
        has_friction = self._has_friction(frames)
        fresh = has_friction & ~self._guessed[nodes]
        if fresh.any():
            at = np.flatnonzero(fresh)
            reaction = self.state.contact[nodes[at]]
            none = np.zeros(len(at), dtype=bool)
            own = self._local(frames, at, x[nodes[at]], reaction, none)
            self._forces[nodes[at]] = own.drag.sum(axis=1)
            self._decide(frames, at, x[nodes[at]], none, own)
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
        """Find the nodes that violate the law; return normal forces (m, walls) of all nodes of the frames [N].

        Parameters
        ----------
        x, reaction : (m, 3) positions and forces by walls of the frames' nodes [m], [N]
        strengths : (m, walls) normal forces without friction; used for nodes at frictionless walls only
        noise : force below which a force counts as zero [N]
        tolerance : of the forces [N]
        """
        nodes, contact = frames.nodes, self.contact
        self.drag = np.zeros((*strengths.shape, 3))
        if not contact.has_friction:
            return strengths
        strengths = strengths.copy()
        at = np.flatnonzero(self._has_friction(frames))
        slipping = self._sticks[nodes[at]] < 0
        own = self._local(frames, at, x[at], reaction[at], slipping)
        moved, normal_forces, drag, stiffness = own
        self._forces[nodes[at]] = drag.sum(axis=1)
        before = self._sticks.copy(), self._slips.copy()
        apart = stiffness * np.linalg.norm(moved - x[at], axis=1)
        # rounding of positions, and of the frames' coordinates on the way to them
        floor = 2e-14 * stiffness * (np.abs(x[at]).sum(axis=1) + contact.size)
        kept = apart <= np.maximum(max(tolerance, 2.0 * noise), floor)
        wrong = np.flatnonzero(~kept)
        if len(wrong):
            self._decide(frames, at[wrong], x[at[wrong]], slipping[wrong], own.of(wrong))
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
        self._steady = 0 if self.model.comm.allreduce(int(changed)) else self._steady + 1
        if self._steady >= _STEADY:
            self._firmness = max(_SOFTER * self._firmness, _LEAST)

    def relax(self) -> bool:
        """Simplify the next solve after a failure; return whether it could be simplified. Collective.

        First the directions are fixed, then friction forces are fixed as well.
        """
        slips, moves = bool(self._slips.any()), bool((self._directions != 0.0).any())
        turning, moving = self.model.comm.allreduce(np.array([slips, moves], dtype=np.int64)) > 0
        self._slips[:] = False
        self._firmness *= 10.0
        self._steady = 0
        if turning:
            return True
        lagged, self._lagged = self._lagged, True
        return moving and not lagged

    def jams(self, nodes: np.ndarray, x: np.ndarray, displacements: np.ndarray) -> list[str]:
        """Return messages about nodes (k,) at (owned, 3) that are jammed in a self-locking wedge by friction."""
        normals, _ = self.contact.planes(self.contact.members[nodes], x[nodes], displacements)
        return [text for node, n in zip(nodes, normals, strict=True) if (text := jam(self.contact, node, n))]

    def _has_friction(self, frames: NodalFrames) -> np.ndarray:
        """Return (m,) bool: frames with a wall that has friction."""
        return ((frames.rows >= 0) & (self.contact.static_friction > 0.0)).any(axis=1)

    def _local(
        self, frames: NodalFrames, at: np.ndarray, x: np.ndarray, reaction: np.ndarray, slipping: np.ndarray
    ) -> LocalSolution:
        """Solve the local problems of some nodes of the frames."""
        nodes, contact = frames.nodes[at], self.contact
        planes = contact.fixed[nodes], frames.normals[at], frames.offsets[at]
        rough = contact.friction, contact.static_friction
        rubbing = Rubbing(self.state.position[nodes], self._way, *planes, *rough, self._stiffness[nodes])
        return solve_locally(rubbing, x, reaction, slipping, contact.size)

    def _may_stick(
        self, nodes: np.ndarray, slipping: np.ndarray, x: np.ndarray, normal_forces: np.ndarray, normals: np.ndarray
    ) -> np.ndarray:
        """Return (k, w) bool: walls whose static coefficient may stop slipping nodes, which is tried once."""
        contact = self.contact
        slip = self._slip(nodes, x, normals)
        # if the rest of the truss moves along, inertia alone resists
        needed = contact.friction * normal_forces + self._inertial[nodes, None] * np.linalg.norm(slip, axis=2)
        may = (contact.static_friction > contact.friction) & (needed <= contact.static_friction * normal_forces)
        return may & (normal_forces > 0.0) & (slipping & ~self._failed[nodes])[:, None]

    def _slip(self, nodes: np.ndarray, x: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Return the slip of nodes at (k, 3) on their walls (k, w, 3) [m]."""
        slip = x[:, None, :] - self.state.position[nodes][:, None, :] - self._way
        return slip - np.einsum("kwi,kwi->kw", slip, normals)[:, :, None] * normals

    def _decide(
        self, frames: NodalFrames, at: np.ndarray, x: np.ndarray, slipping: np.ndarray, own: LocalSolution
    ) -> None:
        """Decide which nodes stick or slip in the next solve, from positions x and the solutions of local problems."""
        nodes, contact = frames.nodes[at], self.contact
        moved, normal_forces, drag, stiffness = own
        slip = self._slip(nodes, moved, frames.normals[at])
        size = np.linalg.norm(drag, axis=2)
        # a normal force within rounding neither sticks nor causes friction
        least = 1e-9 * normal_forces.max(axis=1, initial=0.0)
        rubbing = (normal_forces > least[:, None]) & (contact.static_friction > 0.0)
        needed = np.linalg.norm(drag - stiffness[:, None, None] * slip, axis=2)
        limit = np.where(slipping[:, None], contact.friction, contact.static_friction) * normal_forces
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
        self._directions[nodes] = unit * np.maximum(contact.friction * normal_forces, 1e-300)[:, :, None]

    def _hold(self, frames: NodalFrames, at: np.ndarray) -> None:
        """Fix sticking nodes at zero slip."""
        nodes = frames.nodes[at]
        wall = self._sticks[nodes]
        row = frames.rows[at, wall]
        place = self.state.position[nodes] + self._way[wall]
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
        friction = np.where((self._directions[nodes] != 0.0).any(axis=2), self.contact.friction, 0.0)
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
        return Sliding(
            nodes,
            at,
            known,
            frames.inverse[at],
            frames.rows[at],
            frames.signs[at],
            friction,
            frames.normals[at],
            self.state.position[nodes][:, None, :] + self._way,
            start,
            np.where(slips, self._stiffness[nodes], 0.0),
        )


_ITERATIONS = 50  # solves of a step
_PATIENCE = 5  # solves before deferred walls may take a row of smaller volume
_SMALL_VOLUME = 1e-3  # of rows: two planes can bound the same node from an angle of 0.06 degrees
_DESCENTS = 30  # descent steps from a guess at which Newton's method cycled


@dataclass(frozen=True)
class Trial:
    """The coordinates of one solve.

    Attributes
    ----------
    candidates : nodes near walls; frames : their frames; links : that may close; transform : built from both
    tied : of tied nodes, indices among the frames (k,), walls (k,) and positions (k, 3) [m]
    """

    candidates: Candidates
    frames: NodalFrames
    tied: tuple[np.ndarray, np.ndarray, np.ndarray]
    links: tuple[RowCoordinates, ...]
    transform: Transform


@dataclass(frozen=True)
class Outcome:
    """Result of the check of a solution.

    Attributes
    ----------
    settled : whether all rows are satisfied
    candidates, links : for the next solve
    trial : the trial that was solved
    normal_forces : (m, walls) on the candidates of the trial [N]; pull : (m, 3) force that walls must balance there [N]
    """

    settled: bool
    candidates: Candidates
    links: tuple[RowCoordinates, ...]
    trial: Trial
    normal_forces: np.ndarray
    pull: np.ndarray


class ActiveSet:
    """Contact in one implicit step. Construction is collective.

    Parameters
    ----------
    model : Model
    state : at the start of the step
    balance : of the step
    held : (owned,) bool, nodes in contact with walls in the last step
    links : coordinates of all links of the case
    remedy : what the user can do against steps that are too large

    Attributes
    ----------
    candidates, links : of the first solve
    """

    def __init__(
        self,
        model: Model,
        state: State,
        balance: Balance,
        held: np.ndarray,
        links: Sequence[RowCoordinates] = (),
        remedy: str = "reduce time.step",
    ) -> None:
        self.contact, self._remedy = model.contact, remedy
        self.model = model
        self.state = state
        self.balance = balance
        self._iterations = self._link_iterations = 0
        self._displacements = self.contact.motion.displacements(balance.time)
        self.friction = StepFriction(model, state, balance)
        self.candidates = expected_candidates(model.contact, state, balance, held, self._displacements)
        move, slack = (balance.time - state.time) * state.v, BEYOND * model.size
        self._all_links = tuple(links)
        self.links = tuple(link for link in links if link.reached(state, move, slack))

    def place(self, candidates: Candidates, links: Sequence[RowCoordinates], x: np.ndarray) -> Trial:
        """Build the coordinates of candidates and links at positions (owned, 3). Collective.

        Raises
        ------
        SimulationFailure
            On all ranks, if the walls and supports of a node are infeasible together.
        """
        contact, time = self.contact, self.balance.time
        frames, tied = NodalFrames(candidates.nodes, len(contact.walls)), contact.ties.nobody
        if candidates.anywhere:
            least = MIN_VOLUME if self._iterations < _PATIENCE else _SMALL_VOLUME
            untied = candidates.without(contact.ties.held)
            frames = contact.frames(untied, x, time, least, self.balance.acting)
            tied = contact.ties.pin(frames, x, time)
            self.friction.apply(frames, x)
        met = frames if candidates.anywhere else None
        for link in links:
            link.place(met, self.balance, self.state, x)
        return Trial(candidates, frames, tied, tuple(links), Transform(self.model.mesh, met, links))

    def feasible(self, trial: Trial, u: np.ndarray, stiffness: np.ndarray | None = None) -> np.ndarray:
        """Return the increment (owned, 3) nearest to a guess that satisfies the frames' planes and links. Collective.

        ``stiffness`` (owned,): weights of the nodes of links in the distance [N/m]; default: their masses.
        """
        u, frames, fixed = u.copy(), trial.frames, self.contact.fixed
        for link in trial.links:
            link.feasible(self.balance.predictor, u, self.model.inertia.mass if stiffness is None else stiffness)
        at = frames.nodes
        x = self.balance.predictor[at] + u[at]
        moved, multipliers = x.copy(), np.zeros(frames.offsets.shape)
        project(moved, fixed[at], frames.normals, frames.offsets, PROJECTED * self.model.size, multipliers)
        u[at] += moved - x
        tied, _, places = trial.tied
        nodes = at[tied]
        u[nodes] = np.where(fixed[nodes], u[nodes], places - self.balance.predictor[nodes])
        return u

    def approach(self, trial: Trial, problem: StepProblem, u: np.ndarray) -> np.ndarray:
        """Return a guess (owned, 3) with a better active set, by projected steepest descent. Collective.

        In oblique coordinates the active sets of Newton's method can cycle; projections onto the planes cannot.
        """
        model = self.model
        stiffness = problem.nodal + 2.0 * self.balance.weight * model.nodal_stiffness
        g = np.empty_like(u)
        u = self.feasible(trial, u, stiffness)
        for _ in range(_DESCENTS):
            problem.imbalance(u, g)
            model.supports.clear(g)
            u = self.feasible(trial, u - g / stiffness[:, None], stiffness)
        return u

    def relax(self, trial: Trial) -> bool:
        """Fix the directions of slip in the next solve; return whether the last solve solved for them. Collective."""
        return trial.candidates.anywhere and self.friction.relax()

    def bounds(self, trial: Trial, guess: np.ndarray, w: np.ndarray) -> Bounds:
        """Return bounds on w (owned, 3): those of the frames minus B predictor, and those of links. Collective.

        ``guess``, ``w`` (owned, 3): a guess of u with the prescribed components at their new values, and its w.
        """
        if not trial.transform.bounded:
            return Bounds()
        frames, at = trial.frames, trial.frames.nodes
        shape = (self.model.mesh.n_owned, 3)
        lower, upper = np.full(shape, -np.inf), np.full(shape, np.inf)
        base = np.einsum("nij,nj->ni", frames.basis, self.balance.predictor[at])
        lower[at] = frames.lower - base
        upper[at] = frames.upper - base
        for link in trial.links:
            link.bound(self.balance.predictor + guess, w, lower)
        return Bounds((lower, upper))

    def check(
        self, trial: Trial, bounds: Bounds, w: np.ndarray, u: np.ndarray, g: np.ndarray, noise: float, tolerance: float
    ) -> Outcome:
        """Check whether the solution satisfies all walls and links, and prepare the next solve if not. Collective.

        Parameters
        ----------
        w, u : (owned, 3) solution in the trial's coordinates and in x [m]
        g : (owned, 3) residual force at the solution [N]
        noise : residual force left at a free node [N]
        tolerance : residual force allowed at a free node [N]

        Raises
        ------
        NotConverged
            On all ranks, if the number of solves exceeds its limit.
        """
        contact, frames, candidates = self.contact, trial.frames, trial.candidates
        x, at = self.balance.predictor + u, trial.candidates.nodes
        slack = ON_BOUND * self.model.size
        settled, links, g = self._check_links(trial, bounds, w, x, g, noise, slack)
        normal_forces, pull = np.zeros((len(at), len(contact.walls))), np.where(contact.fixed[at], 0.0, g[at])
        if not contact.any:
            return Outcome(settled, candidates, links, trial, normal_forces, pull)
        if candidates.anywhere:
            turned = np.einsum("nji,nj->ni", frames.inverse, g[at])
            normal_forces = contact.strengths(frames, turned, bounds.active(at, w, turned, noise))
        joined, broken = broken_walls(contact, self._displacements, candidates, frames, x, slack)
        if candidates.anywhere:
            normal_forces = self.friction.check(frames, x[at], pull, normal_forces, noise, tolerance)
        left = np.union1d(joined, self.friction.unsettled)
        unsettled = is_misaligned(frames, normal_forces)
        part = self.balance.acting
        unsettled = unsettled or is_off_surface(contact, self._displacements, frames, normal_forces, x, slack, part)
        if self.model.comm.allreduce(int(unsettled or len(left) > 0), op=MPI.MAX):
            self._iterations += 1
            if self._iterations >= _ITERATIONS:
                raise NotConverged(self._why(left, x))
            rank = PROJECTED * self.model.size
            candidates = candidates.join(contact, self._displacements, joined, broken, x, normal_forces, rank)
            settled = False
        return Outcome(settled, candidates, links, trial, normal_forces, pull)

    def _why(self, left: np.ndarray, x: np.ndarray) -> str:
        """Return why the solves of nodes (k,) at (owned, 3) do not converge, and the remedy. Collective."""
        comm, jams = self.model.comm, self.friction.jams(left, x, self._displacements)
        jams = [text for part in comm.allgather(jams[:1]) for text in part]
        if jams:
            return jams[0]
        names = comm.allgather(self.model.mesh.node_ids[left[:3]].tolist())
        shown = ", ".join(str(node) for part in names for node in part)
        return (
            f"the active set of the walls did not converge in {_ITERATIONS} solves"
            f"{f' (nodes {shown})' if shown else ''}; {self._remedy}"
        )

    def _check_links(
        self, trial: Trial, bounds: Bounds, w: np.ndarray, x: np.ndarray, g: np.ndarray, noise: float, slack: float
    ) -> tuple[bool, tuple[RowCoordinates, ...], np.ndarray]:
        """Return whether rows over several nodes are satisfied at positions (owned, 3), those of the next solve, and
        part of the residual force that walls must balance. Collective."""
        if not trial.links:
            unexpected = tuple(rows for rows in self._all_links if rows.broken(x, slack))
            return not unexpected, unexpected, g
        (rows,), at = trial.links, trial.frames.nodes
        turned, g = g.copy(), g.copy()
        turned[at] = np.einsum("nji,nj->ni", trial.frames.inverse, g[at])
        rows.solve_forces(w, turned, bounds.arrays[0], noise)
        rows.constraints.add_forces(g, -1.0)
        satisfied = rows.satisfied(x, slack)
        self._link_iterations += not satisfied
        if self._link_iterations >= _ITERATIONS:
            raise NotConverged(f"constraints and positions did not agree in {_ITERATIONS} solves; {self._remedy}")
        return satisfied, trial.links, g

    def forces(self, outcome: Outcome, u: np.ndarray) -> tuple[np.ndarray, WallForces, np.ndarray]:
        """Return contact forces (owned, 3) [N], sums per wall, and the owned nodes in contact, at the solution."""
        total = np.zeros_like(u)
        for rows in self._all_links:
            if not outcome.links:
                rows.constraints.release()
            rows.constraints.add_forces(total)
        held = np.zeros(len(u), dtype=bool)
        if not outcome.trial.candidates.anywhere:
            return total, self.contact.nothing, held
        frames = outcome.trial.frames
        at, x = frames.nodes, (self.balance.predictor + u)[frames.nodes]
        force = outcome.normal_forces[:, :, None] * frames.normals
        friction = self.friction.add(force, at, x)
        touching = outcome.normal_forces > 0.0
        tied, owners, _ = outcome.trial.tied
        force[tied, owners] = outcome.pull[tied]
        touching[tied, owners] = True
        total[at] += force.sum(axis=1)
        held[at] = touching.any(axis=1)
        return total, self.contact.sums(at, force, x, touching, friction), held

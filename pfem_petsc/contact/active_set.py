"""The active set of contact in an implicit step: bounded solves until walls and rows hold, with Coulomb friction; and
the accelerations and contact forces of nodes that rest on walls or on each other.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..errors import NotConverged
from ..integrators.base import Balance, State
from ..tolerances import BEYOND, ON_BOUND, PROJECTED
from .contact import Candidates, expected_candidates
from .frames import MIN_VOLUME, NodalFrames
from .friction import StepFriction, planes_at_rest
from .node_walls import WallForces, held_by_supports
from .projection import NodesAtPlanes, pressed, project
from .transform import RowCoordinates, Transform
from .wall_motion import Poses

if TYPE_CHECKING:
    from ..mechanics.mass import Inertia
    from ..solvers.matrix import StepProblem
    from ..stepping.model import Model
    from .constraint_set import ConstraintSet
    from .contact import Contact


@dataclass(frozen=True)
class Bounds:
    """Lower and upper bounds that walls and rows place on the unknowns.

    Attributes
    ----------
    arrays : lower and upper bounds (owned, 3) [m], infinite where there is no bound; None in free flight
    """

    arrays: tuple[np.ndarray, np.ndarray] | None = None

    def clip(self, w: np.ndarray, within: float) -> np.ndarray:
        """Return a guess (owned, 3) within the bounds, on them where it is not farther than ``within`` [m] from them,
        as :meth:`project` requires of the solution."""
        if self.arrays is None:
            return w
        w = np.clip(w, *self.arrays)
        self.project(w, within)
        return w

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
    poses: Poses,
    candidates: Candidates,
    frames: NodalFrames,
    x: np.ndarray,
    tolerance: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes (k,) beyond walls that no bound of theirs represents, and these walls (k, slots) bool.

    Parameters
    ----------
    contact : Contact
    poses : of walls
    candidates, frames : of the solve
    x : (owned, 3) solution [m]
    tolerance : depth that counts as zero [m]
    """
    beyond = np.flatnonzero(contact.near(x, poses, np.array([-tolerance])))
    contact.find_faces(beyond, x[beyond], poses, tolerance)
    normals, gaps = contact.distances(contact.applicable(beyond, x[beyond], poses), x[beyond], poses, beyond)
    broken = gaps < -tolerance
    _, known, place = np.intersect1d(beyond, candidates.nodes, assume_unique=True, return_indices=True)
    # walls with their own bound are satisfied to rounding of the coordinates; supports override walls
    walls = broken.shape[1]
    broken[known] &= (frames.rows[place, :walls] < 0) | frames.shared[place, :walls]
    broken &= ~contact.ties.held[beyond][:, None]
    broken &= ~held_by_supports(contact.fixed[beyond][:, None, :], normals)
    met = broken.any(axis=1)
    return beyond[met], broken[met]


def is_misaligned(frames: NodalFrames, fixed: np.ndarray, strengths: np.ndarray) -> bool:
    """Return whether a wall presses through the row of an almost parallel wall, so that the force is off its normal on
    components that are not ``fixed`` (m, 3)."""
    normal_forces = strengths > 0.0
    for node, wall in np.argwhere(normal_forces & frames.shared):
        own = (frames.rows[node] == frames.rows[node, wall]) & ~frames.shared[node]
        along = frames.ratios[node, wall] * frames.basis[node, frames.rows[node, wall]]
        turn = np.abs(frames.normals[node, wall] - along)[~fixed[node]]
        if turn.max() > ON_BOUND and not (normal_forces[node] & own).any():
            return True
    return False


def is_off_surface(
    contact: Contact,
    poses: Poses,
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
    if contact.find_faces(at, x[at], poses, tolerance):
        return True
    normals, _ = contact.planes(strengths > 0.0, x[at], poses, contact.acting(at, x[at], poses, part), at)
    # far from the origin, the rounding of positions turns normals by more
    moved = np.abs(x[at] - frames.places).max(axis=1) > PROJECTED * contact.size
    for k in np.flatnonzero(~contact.flat):
        gaps, pressed = contact.gap(contact.wall_of[k], x[at], poses), strengths[:, k] > 0.0
        turned = moved & (np.abs(normals[:, k] - frames.normals[:, k]).max(axis=1) > ON_BOUND)
        passed = (frames.rows[:, k] >= 0) & (gaps < -tolerance)
        if np.where(pressed, turned | (np.abs(gaps) > tolerance), passed).any():
            return True
    return False


_ROUNDS = 60  # of the equilibrium at rest, each at least halves the error
_ITERATIONS = 50  # solves of a step
_PATIENCE = 5  # solves before deferred walls may take a row of smaller volume
_SMALL_VOLUME = 1e-3  # of rows: two planes can bound the same node from an angle of 0.06 degrees
_DESCENTS = 30  # descent steps from a guess at which Newton's method cycled


class ActiveSet:
    """Contact in one implicit step. Construction is collective.

    Parameters
    ----------
    model : Model
    state : at the start of the step
    balance : of the step
    held : (owned,) bool, nodes in contact with walls in the last step
    rows : coordinates of the rows over several nodes; None if the case has none
    remedy : what the user can do against steps that are too large

    Attributes
    ----------
    candidates : of the next solve, and carriers of rows after :meth:`place`
    rows : coordinates of rows that may close in the next solve; None if none may
    frames, transform : of the candidates, and of these and the rows, in the last solve
    """

    def __init__(
        self,
        model: Model,
        state: State,
        balance: Balance,
        held: np.ndarray,
        rows: RowCoordinates | None = None,
        remedy: str = "reduce time.step",
    ) -> None:
        self.model, self.contact, self._remedy = model, model.contact, remedy
        self.state, self.balance = state, balance
        self._iterations = self._row_iterations = 0
        self._poses = self.contact.motion.poses(balance.time)
        relative = None if rows is None else rows.relative
        self.friction = StepFriction(model.contact, model.inertia, model.nodal_stiffness, state, balance, relative)
        self.candidates = expected_candidates(model.contact, state, balance, held, self._poses)
        move, slack = (balance.time - state.time) * state.v, BEYOND * model.size
        self._all_rows = rows
        self.rows = rows if rows is not None and rows.reached(state, move, slack) else None

    def place(self, x: np.ndarray) -> None:
        """Build the coordinates of a solve, of candidates and rows at positions (owned, 3). Collective.

        Raises
        ------
        SimulationFailure
            On all ranks, if the walls and supports of a node are infeasible together.
        """
        contact, slots, candidates = self.contact, self.friction.slots, self.candidates
        relative = None if self.rows is None else self.rows.relative
        if relative is not None:
            stopped = np.zeros(len(x), dtype=bool)
            stopped[candidates.nodes] = candidates.applicable.any(axis=1)
            relative.choose(stopped, x)
            self.friction.relate(relative)
            self.candidates = candidates = candidates.beside(relative.nodes)
        self.frames, self._tied = NodalFrames(candidates.nodes, slots), contact.ties.nobody
        if candidates.anywhere:
            least = MIN_VOLUME if self._iterations < _PATIENCE else _SMALL_VOLUME
            tied_ones = contact.ties.held[candidates.nodes]
            untied = replace(candidates, applicable=candidates.applicable & ~tied_ones[:, None])
            self.frames = contact.frames(untied, x, self.balance, slots, relative, least)
            self._tied = contact.ties.pin(self.frames, x, self.balance.time)
            self.friction.apply(self.frames)
        met = self.frames if candidates.anywhere else None
        if self.rows is not None:
            self.rows.place(met, self.balance, self.state, x)
        self.transform = Transform(self.model.mesh, met, self.rows)

    def feasible(self, u: np.ndarray, stiffness: np.ndarray | None = None) -> np.ndarray:
        """Return the increment (owned, 3) nearest to a guess that satisfies the frames' planes and rows. Collective.

        ``stiffness`` (owned,): weights of the nodes of rows in the distance [N/m]; default: their masses.
        """
        u, frames, fixed = u.copy(), self.frames, self.contact.fixed
        stiffness = self.model.inertia.mass if stiffness is None else stiffness
        if self.transform.rows is not None:
            self.transform.rows.feasible(self.balance.predictor, u, stiffness)
        at, walls = frames.nodes, len(self.contact.wall_of)
        x = self.balance.predictor[at] + u[at]
        normals, offsets = (np.ascontiguousarray(array[:, :walls]) for array in (frames.normals, frames.offsets))
        moved, multipliers = x.copy(), np.zeros(offsets.shape)
        project(moved, fixed[at], normals, offsets, PROJECTED * self.model.size, multipliers)
        u[at] += moved - x
        tied, _, places = self._tied
        nodes = at[tied]
        u[nodes] = np.where(fixed[nodes], u[nodes], places - self.balance.predictor[nodes])
        return u

    def approach(self, problem: StepProblem, u: np.ndarray) -> np.ndarray:
        """Return a guess (owned, 3) with a better active set, by projected steepest descent. Collective.

        In oblique coordinates the active sets of Newton's method can cycle; projections onto the planes cannot.
        """
        model = self.model
        stiffness = problem.nodal + 2.0 * self.balance.weight * model.nodal_stiffness
        g = np.empty_like(u)
        u = self.feasible(u, stiffness)
        for _ in range(_DESCENTS):
            problem.imbalance(u, g)
            if not model.comm.allreduce(bool(np.isfinite(g).all()), op=MPI.LAND):  # bars have passed through others
                break
            model.supports.clear(g)
            u = self.feasible(u - g / stiffness[:, None], stiffness)
        return u

    def relax(self) -> bool:
        """Fix the directions of slip in the next solve; return whether the last solve solved for them. Collective."""
        return self.candidates.anywhere and self.friction.relax()

    def bounds(self, guess: np.ndarray, w: np.ndarray) -> Bounds:
        """Return bounds on w (owned, 3): those of the frames and of rows. Collective.

        ``guess``, ``w`` (owned, 3): a guess of u with the prescribed components at their new values, and its w.
        """
        if not self.transform.bounded:
            return Bounds()
        frames, at, x = self.frames, self.frames.nodes, self.balance.predictor + guess
        lower, upper = np.full(w.shape, -np.inf), np.full(w.shape, np.inf)
        base, rows = np.einsum("nij,nj->ni", frames.basis, self.balance.predictor[at]), self.transform.rows
        if rows is not None:  # where prescribed motions move bounds instead of other unknowns
            base = np.einsum("nij,nj->ni", frames.basis, self.transform.positions(x)[at]) - w[at]
        lower[at], upper[at] = frames.lower - base, frames.upper - base
        if rows is not None:
            rows.bound(x, w, lower)
        return Bounds((lower, upper))

    def check(
        self, bounds: Bounds, w: np.ndarray, u: np.ndarray, g: np.ndarray, noise: float, tolerance: float
    ) -> bool:
        """Return whether the solution satisfies all walls and rows, and prepare the next solve if not. Collective.

        Parameters
        ----------
        w, u : (owned, 3) solution in the coordinates of the solve and in x [m]
        g : (owned, 3) residual force at the solution [N]
        noise : residual force left at a free node [N]
        tolerance : residual force allowed at a free node [N]

        Raises
        ------
        NotConverged
            On all ranks, if the number of solves exceeds its limit.
        """
        contact, frames, candidates = self.contact, self.frames, self.candidates
        x, at, walls = self.balance.predictor + u, candidates.nodes, len(contact.wall_of)
        slack, relative = ON_BOUND * self.model.size, self.transform.relative
        settled, g = self._check_rows(bounds, w, x, g, noise, slack)
        if relative is not None:
            g = relative.forces(g)
        normal_forces, self._pull = np.zeros(frames.rows.shape), np.where(contact.fixed[at], 0.0, g[at])
        if not contact.any and not candidates.anywhere:
            return settled
        if candidates.anywhere:
            turned = np.einsum("nji,nj->ni", frames.inverse, g[at])
            normal_forces = contact.strengths(frames, turned, bounds.active(at, w, turned, noise))
        joined, broken = broken_walls(contact, self._poses, candidates, frames, x, slack)
        if candidates.anywhere:
            y = self.transform.positions(x)[at]
            normal_forces = self.friction.check(frames, y, self._pull, normal_forces, noise, tolerance)
        left = np.union1d(joined, self.friction.unsettled)
        unsettled = is_misaligned(frames, contact.fixed[at], normal_forces)
        by_walls, part = normal_forces[:, :walls], self.balance.acting
        unsettled = unsettled or is_off_surface(contact, self._poses, frames, by_walls, x, slack, part)
        if self.model.comm.allreduce(int(unsettled or len(left) > 0), op=MPI.MAX):
            self._iterations += 1
            if self._iterations >= _ITERATIONS:
                raise NotConverged(self._why(left, x))
            rank = PROJECTED * self.model.size
            self.candidates = candidates.join(contact, self._poses, joined, broken, x, by_walls, rank)
            settled = False
        self._normal_forces = normal_forces
        return settled

    def _why(self, left: np.ndarray, x: np.ndarray) -> str:
        """Return why the solves of nodes (k,) at (owned, 3) do not converge, and the remedy. Collective."""
        comm, jams = self.model.comm, self.friction.jams(left, x)
        jams = [text for part in comm.allgather(jams[:1]) for text in part]
        if jams:
            return jams[0]
        names = comm.allgather(self.model.mesh.node_ids[left[:3]].tolist())
        shown = ", ".join(str(node) for part in names for node in part)
        return (
            f"the active set of the walls did not converge in {_ITERATIONS} solves"
            f"{f' (nodes {shown})' if shown else ''}; {self._remedy}"
        )

    def _check_rows(
        self, bounds: Bounds, w: np.ndarray, x: np.ndarray, g: np.ndarray, noise: float, slack: float
    ) -> tuple[bool, np.ndarray]:
        """Return whether rows over several nodes are satisfied at positions (owned, 3), and the part of the residual
        force that walls must balance. Collective."""
        rows = self.rows
        if rows is None:
            if self._all_rows is not None and self._all_rows.broken(x, slack):
                self.rows = self._all_rows
            return self.rows is None, g
        own, g = g.copy(), g.copy()
        self.transform.adjoint(own)
        rows.solve_forces(w, own, bounds.arrays[0], noise)
        rows.constraints.add_forces(g, -1.0)
        satisfied = rows.satisfied(x, slack)
        self._row_iterations += not satisfied
        if self._row_iterations >= _ITERATIONS:
            raise NotConverged(f"constraints and positions did not agree in {_ITERATIONS} solves; {self._remedy}")
        return satisfied, g

    def forces(self, u: np.ndarray) -> tuple[np.ndarray, WallForces, np.ndarray]:
        """Return contact forces (owned, 3) [N], sums per wall, and the owned nodes in contact, at the solution."""
        total, x = np.zeros_like(u), self.balance.predictor + u
        frames, walls, relative = self.frames, len(self.contact.wall_of), self.transform.relative
        at, dissipated = frames.nodes, np.zeros(self.friction.slots)
        if self.candidates.anywhere:
            dissipated = self.friction.dissipated(at, self.transform.positions(x)[at])
        if self._all_rows is not None:
            constraints = self._all_rows.constraints
            if self.rows is None:
                constraints.release()
            elif relative is not None:
                self.rows.set_forces(at, self._normal_forces[:, walls:], self.friction.drag[:, walls:])
            constraints.friction = float(dissipated[walls:].sum())
            constraints.add_forces(total)
        held = np.zeros(len(u), dtype=bool)
        if not self.candidates.anywhere:
            return total, self.contact.nothing, held
        x = x[at]
        force = self._normal_forces[:, :walls, None] * frames.normals[:, :walls] + self.friction.drag[:, :walls]
        touching, friction = self._normal_forces[:, :walls] > 0.0, float(dissipated[:walls].sum())
        tied, owners, _ = self._tied
        owners = self.contact.first[owners]
        force[tied, owners] = self._pull[tied]
        touching[tied, owners] = True
        total[at] += force.sum(axis=1)
        held[at] = touching.any(axis=1)
        start = self.state.position[at]
        acts = start + self.balance.acting * (x - start)
        return total, self.contact.sums(at, force, (x, acts), touching, friction), held


def start_at_rest(
    links: ConstraintSet,
    inertia: Inertia,
    state: State,
    accelerate: Callable[[np.ndarray], np.ndarray],
    load: np.ndarray,
    still: float,
) -> WallForces | None:
    """Set acceleration and contact forces of nodes that rest on walls or on each other in the state; return the forces
    per wall. Collective.

    A node that touches a wall and does not move along its normal is not accelerated into it: with the walls' forces r
    and accelerations a_w,

        M a = f + r,   0 <= n . (a - a_w)  complementary to  the normal force in r,

    and likewise with n . (a_2 - a_1) of closed pairs. r includes friction: opposite to the velocity of a node that
    slides, else the force that prevents sliding, up to the limit of the wall. Without r a truss at rest on a floor
    would start with a velocity error of h g, which decays slowly with some schemes.

    The forces follow from projections with the lumped mass, in one iteration if the mass is lumped. The eigenvalues of
    a consistent mass are between one third and one times the lumped one, so projections with half the lumped mass
    halve the error in every iteration.

    Parameters
    ----------
    links : ConstraintSet, with the walls of the case
    inertia : Inertia
    state : with ``state.a`` without walls
    accelerate : returns the acceleration (owned, 3) with M a = load. Collective
    load : (owned, 3) without walls [N]
    still : velocity that counts as none [m/s]

    Returns
    -------
    WallForces or None
        None if no node of any rank rests on a wall or on another node, or if no contact force is needed.
    """
    contact, comm, mass = links.contact, links.contact.mesh.comm, inertia.mass
    x, v = state.position, state.v
    poses = contact.motion.poses(state.time)
    slack = ON_BOUND * contact.size
    nodes = np.flatnonzero(contact.near(x, poses, np.array([slack])))
    applicable = contact.members[nodes]
    normals, gaps = contact.distances(applicable, x[nodes], poses)
    away = np.einsum("mwi,mwi->mw", normals, v[nodes][:, None, :] - contact.rates(x[nodes], state.time, ahead=True))
    resting = applicable & (np.abs(gaps) <= slack) & (np.abs(away) <= still)
    # the plane of a partial wall extends beyond the wall, and walls with mass are not fixed
    partial = [k for k, wall in enumerate(contact.walls) if wall.partial]
    resting[:, np.isin(contact.wall_of, [*partial, *contact.motion.bodies.at])] = False
    kept = resting.any(axis=1)
    nodes, resting = nodes[kept], resting[kept]
    share = 0.5 if inertia.consistent else 1.0
    weight = share * mass[nodes]
    closed = links.resting(x, v, slack, still)
    held = np.zeros(contact.members.shape, dtype=bool)
    held[nodes] = resting

    hold = np.zeros((len(nodes), 3))  # free components of the walls' forces
    between = np.zeros_like(load)  # likewise for the links
    for _ in range(_ROUNDS if inertia.consistent else 1):
        apart = state.a - between / (share * mass[:, None])
        apart[nodes] -= hold / weight[:, None]
        earlier = between
        # links first, as in a step: they account for the walls
        between = links.rest(apart, share * mass, closed, held, still)
        free = apart[nodes] + between[nodes] / weight[:, None]
        planes = planes_at_rest(contact, resting, (x[nodes], v[nodes], free), still)
        found = pressed(NodesAtPlanes(free, contact.fixed[nodes], weight, planes), 0.0)
        before, hold = hold, weight[:, None] * (found.x - free)
        sizes = [np.abs(part).max(initial=0.0) for part in (hold - before, between - earlier, hold, between)]
        last_hold, last_between, *largest = np.max(comm.allgather(sizes), axis=0)
        if max(last_hold, last_between) <= 1e-13 * max(largest):
            break
        total = load + between
        total[nodes] += hold
        state.a = accelerate(total)
    if max(largest) == 0.0:
        return None
    force = found.normal[:, :, None] * planes.normals + found.drag
    state.contact = np.zeros_like(load)
    state.contact[nodes] = force.sum(axis=1)
    links.add_forces(state.contact)
    return contact.sums(nodes, force, (x[nodes], x[nodes]), found.normal > 0.0)

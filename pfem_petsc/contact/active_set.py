"""The active set of contact in an implicit step: bounded solves until all rows of walls and links are satisfied.

A step is solved with bounds for the nodes that may reach a wall and for the links that may close. Afterwards all rows
are checked: walls that nodes were not expected to reach, walls without a row among the three coordinates, curved walls
whose tangent plane was taken at another point, links that have closed, and rows whose gradients have turned. If any
check fails, the step is solved again from the current solution with updated candidates. Data flow:

    Candidates -> Trial (frames, transform) -> Bounds -> solution -> Outcome (forces, next Candidates) -> ...
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
from .bounds import Bounds
from .candidates import Candidates, expected_candidates
from .forces import WallForces
from .frames import MIN_VOLUME, NodalFrames
from .implicit_friction import StepFriction
from .links import LinkCoordinates
from .no_friction import NoStepFriction
from .projection import project
from .transform import Transform
from .wall_check import broken_walls, is_misaligned, is_off_surface

if TYPE_CHECKING:
    from ..stepping.model import Model
    from ..stepping.problem import StepProblem

__all__ = ["ActiveSet", "Outcome", "Trial"]

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
    links: tuple[LinkCoordinates, ...]
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
    links: tuple[LinkCoordinates, ...]
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
        links: Sequence[LinkCoordinates] = (),
        remedy: str = "reduce time.step",
    ) -> None:
        self.contact, self._remedy = model.contact, remedy
        self.model = model
        self.state = state
        self.balance = balance
        self._iterations = self._link_iterations = 0
        self._displacements = self.contact.motion.displacements(balance.time)
        kind = NoStepFriction if self.contact.symmetric else StepFriction
        self.friction = kind(model, state, balance)
        self.candidates = expected_candidates(model, state, balance, held, self._displacements)
        move, slack = (balance.time - state.time) * state.v, BEYOND * model.size
        self._all_links = tuple(links)
        self.links = tuple(link for link in links if link.reached(state, move, slack))

    def place(self, candidates: Candidates, links: Sequence[LinkCoordinates], x: np.ndarray) -> Trial:
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
        return Trial(candidates, frames, tied, tuple(links), Transform(self.model, met, links))

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
    ) -> tuple[bool, tuple[LinkCoordinates, ...], np.ndarray]:
        """Return whether links are satisfied at positions (owned, 3), the links of the next solve, and the part of the
        residual force that walls must balance. Collective."""
        kept, met, at = True, list(trial.links), trial.frames.nodes
        turned, g = g, g.copy() if trial.links else g
        if trial.links:
            turned = g.copy()
            turned[at] = np.einsum("nji,nj->ni", trial.frames.inverse, g[at])
        for link in self._all_links:
            if link not in trial.links:
                if link.broken(x, slack):  # it was not expected to close
                    met.append(link)
                continue
            link.solve_forces(w, turned, bounds.arrays[0], noise)
            link.push(g, -1.0)
            kept &= link.kept(x, slack)
        self._link_iterations += not kept
        if self._link_iterations >= _ITERATIONS:
            raise NotConverged(f"constraints and positions did not agree in {_ITERATIONS} solves; {self._remedy}")
        links = tuple(link for link in self._all_links if link in met)
        return kept and len(links) == len(trial.links), links, g

    def forces(self, outcome: Outcome, u: np.ndarray) -> tuple[np.ndarray, WallForces, np.ndarray]:
        """Return contact forces (owned, 3) [N], sums per wall, and the owned nodes in contact, at the solution."""
        total = np.zeros_like(u)
        for link in self._all_links:
            if link not in outcome.links:
                link.release()
            link.push(total)
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

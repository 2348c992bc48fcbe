"""Contact in an implicit step: candidate nodes, bounds, and repeated solves until no wall is violated.

A step is solved with bounds for the nodes that may reach a wall. Afterwards all walls are verified: nodes that were not
expected at a wall, walls that found no place among three coordinates, curved walls whose tangent plane was that of
another point, and pairs of nodes that met. Where something is left, the step is solved again, from where it is, with
what was learnt.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from mpi4py import MPI

from ..errors import NotConverged
from ..integrators.base import Balance, State
from ..solvers.newton import zero_tolerance
from .forces import WallForces
from .frames import MIN_VOLUME, NodalFrames
from .implicit_friction import StepFriction
from .jamming import jam
from .links import LinkCoordinates
from .projection import project
from .transform import Transform

__all__ = ["ContactRounds"]

_ROUNDS = 50  # solves of a step
_PATIENCE = 5  # of these, before walls that wait take a row of smaller volume
_SMALL_VOLUME = 1e-3  # of rows: two planes share a node from 0.06 degrees on
_DESCENTS = 30  # of a guess from which Newton's method went round in circles


class ContactRounds:
    """Contact in one implicit step.

    Parameters
    ----------
    model : Model
    state : at the start of the step
    balance : of the step
    held : (owned,) bool, nodes held by walls in the last step
    links : coordinates of all links of the case

    Attributes
    ----------
    links : those whose rows may be met in this step
    """

    def __init__(
        self, model, state: State, balance: Balance, held: np.ndarray, links: Sequence[LinkCoordinates] = ()
    ) -> None:
        self.contact = model.contact
        self.model = model
        self.state = state
        self.balance = balance
        self.held = held
        self.round = self._link_rounds = 0
        self._frames: NodalFrames | None = None
        self._rank: np.ndarray | None = None
        self._tied: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None  # in the frames, walls, places
        self.friction = StepFriction(model, state, balance) if self.contact.rough else None
        self.candidates = self._expected() if self.contact.any else None
        move, slack = (balance.time - state.time) * state.v, 1e-9 * model.length
        self._all_links = links
        self.links = [link for link in links if link.reached(state, move, slack)]

    def _expected(self) -> np.ndarray | None:
        """Owned nodes that may touch a wall in this step; None where no rank has any (free flight). Collective."""
        state, contact, time = self.state, self.contact, self.balance.time
        move = (time - state.time) * state.v
        reach = 0.5 * np.linalg.norm(move, axis=1) + 1e-9 * self.model.length
        self._shifts = contact.motion.shifts(time)
        near = self.held | contact.near(state.position + move, self._shifts, reach)
        if contact.ties.any:
            near |= contact.ties.held
        if self.model.comm.allreduce(int(near.any()), op=MPI.MAX) == 0:
            return None
        nodes = np.flatnonzero(near)
        self._concerned = self._within_reach(nodes, (state.position + move)[nodes], reach[nodes])
        return nodes

    def _within_reach(self, nodes: np.ndarray, x: np.ndarray, reach: np.ndarray) -> np.ndarray:
        """(m, walls) bool: walls that nodes (m,) on their way to (m, 3) come within reach (m,) [m] of, or are at."""
        contact, state = self.contact, self.state
        concerned = contact.concerned(nodes, x, self._shifts)
        within = np.zeros_like(concerned)
        starts = state.position[nodes], contact.motion.shifts(state.time), 1e-9 * self.model.length
        for place, shifts, distance in ((x, self._shifts, reach[:, None]), starts):
            normals, offsets = contact.planes(concerned, place, shifts)
            within |= np.einsum("mwi,mi->mw", normals, place) - offsets < distance
        return within & concerned

    @property
    def walls_near(self) -> bool:
        """Whether any node of any rank is a candidate for contact with a wall."""
        return self._frames is not None

    def transform(self, x: np.ndarray) -> Transform:
        """Coordinates of the candidates and links at positions (owned, 3). Collective."""
        self._frames = None
        if self.candidates is not None:
            concerned = self._concerned
            if self.contact.ties.any:
                concerned = concerned & ~self.contact.ties.held[self.candidates][:, None]
            self._frames = self.contact.frames(
                self.candidates,
                x,
                self.balance.time,
                concerned,
                self._rank,
                MIN_VOLUME if self.round < _PATIENCE else _SMALL_VOLUME,
            )
            if self.contact.ties.any:
                self._tied = self.contact.ties.pin(self._frames, x, self.balance.time)
            if self.friction is not None:
                self.friction.apply(self._frames, x)
        for link in self.links:
            link.place(self._frames, self.balance, self.state, x)
        return Transform(self.model, self._frames, self.links)

    def feasible(self, u: np.ndarray, stiffness: np.ndarray | None = None) -> np.ndarray:
        """The increment (owned, 3) nearest to a guess that keeps the frames' planes and the links. Collective.

        ``stiffness`` (owned,): how hard nodes of links are to move [N/m]; default: as their masses.
        """
        if self.links:
            u = u.copy()
        for link in self.links:
            link.feasible(self.balance.predictor, u, self.model.inertia.mass if stiffness is None else stiffness)
        frames = self._frames
        if frames is None or len(frames.nodes) == 0:
            return u
        at = frames.nodes
        x = self.balance.predictor[at] + u[at]
        moved, multipliers = x.copy(), np.zeros(frames.offsets.shape)
        tolerance = 1e-13 * self.model.length
        project(moved, self.contact.fixed[at], frames.normals, frames.offsets, tolerance, multipliers)
        u = u.copy()
        u[at] += moved - x
        if self._tied is not None:
            tied, _, places = self._tied
            nodes = at[tied]
            u[nodes] = np.where(self.contact.fixed[nodes], u[nodes], places - self.balance.predictor[nodes])
        return u

    def approach(self, problem, u: np.ndarray) -> np.ndarray:
        """A guess (owned, 3) with a better active set, by projected steepest descent. Collective.

        In oblique coordinates Newton's active sets can go round in a circle; projections onto the true planes cannot.
        """
        model = self.model
        stiffness = problem.nodal + 2.0 * self.balance.weight * model.nodal_stiffness
        g = np.empty_like(u)
        u = self.feasible(u, stiffness)
        for _ in range(_DESCENTS):
            problem.imbalance(u, g)
            g[model.supports.fixed] = 0.0
            u = self.feasible(u - g / stiffness[:, None], stiffness)
        return u

    def firm(self) -> bool:
        """Keep the directions of slip in the next solve; whether the last one solved for them. Collective."""
        return self.friction is not None and self._frames is not None and self.friction.firm()

    def bounds(self, guess: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Bounds on w (owned, 3): those of the frames less B predictor, and of links; None in free flight. Collective.

        ``guess``, ``w`` (owned, 3): of u, with prescribed components as they will be, and the same as w.
        """
        self._bounds = None
        frames = self._frames
        if frames is None and not self.links:
            return None
        shape = (self.model.mesh.n_owned, 3)
        lower, upper = np.full(shape, -np.inf), np.full(shape, np.inf)
        if frames is not None:
            at = frames.nodes
            base = np.einsum("nij,nj->ni", frames.basis, self.balance.predictor[at])
            lower[at] = frames.lower - base
            upper[at] = frames.upper - base
        for link in self.links:
            link.bound(self.balance.predictor + guess, w, lower)
        self._bounds = lower, upper
        return self._bounds

    def clipped(self, w: np.ndarray) -> np.ndarray:
        """A guess (owned, 3) within the bounds, to the last digit."""
        return w if self._bounds is None else np.clip(w, *self._bounds)

    def snap(self, w: np.ndarray) -> None:
        """Put unknowns that the solver counts as on a bound exactly there."""
        if self._bounds is None:
            return
        within = 2.0 * zero_tolerance(self.model.length)
        for bound in self._bounds:
            near = np.abs(w - bound) <= within
            w[near] = bound[near]

    def settled(self, w: np.ndarray, u: np.ndarray, g: np.ndarray, noise: float, tolerance: float) -> bool:
        """Whether the solution keeps all walls and links; if not, the next round knows better. Collective.

        Parameters
        ----------
        w, u : (owned, 3) solution in the frames' coordinates and in x [m]
        g : (owned, 3) imbalance there [N]
        noise : what a free node has left of it [N]
        tolerance : what it may have left [N]
        """
        contact = self.contact
        x = self.balance.predictor + u
        slack = 1e-12 * self.model.length
        settled, g = self._check_links(w, x, g, noise, slack)
        if not contact.any:
            return settled
        self.strengths = None
        if self._frames is not None:
            self.strengths = self._strengths(w, g, noise)
            self._pull = np.where(contact.fixed[self.candidates], 0.0, g[self.candidates])
        beyond = np.flatnonzero(contact.near(x, self._shifts, np.array([-slack])))
        joined, broken = self._unexpected(beyond, x, slack)
        left, unsettled = joined, False
        if self.friction is not None and self._frames is not None:
            at = self.candidates
            known = self._frames, x[at], self._pull, self.strengths
            self.strengths = self.friction.settle(*known, noise, tolerance)
            left = np.union1d(left, self.friction.unsettled)
        if self._frames is not None:
            unsettled = self._misaligned() or (not contact.flat.all() and self._off_surface(x, slack))
        unsettled = unsettled or len(left) > 0
        if self.model.comm.allreduce(int(unsettled), op=MPI.MAX) == 0:
            return settled
        self.round += 1
        if self.round >= _ROUNDS:
            raise NotConverged(f"step {self.state.step + 1}, t = {self.balance.time:.6g} s: {self._why(left, x)}")
        self._join(joined, broken, x)
        return False

    def _why(self, left: np.ndarray, x: np.ndarray) -> str:
        """Why solves of nodes (k,) at (owned, 3) come to no end, and what to do. Collective."""
        comm = self.model.comm
        jams = []
        if self.friction is not None and len(left):
            normals, _ = self.contact.planes(self.contact.members[left], x[left], self._shifts)
            jams = [text for node, n in zip(left, normals, strict=True) if (text := jam(self.contact, node, n))]
        jams = [text for part in comm.allgather(jams[:1]) for text in part]
        if jams:
            return jams[0]
        names = comm.allgather(self.model.mesh.node_ids[left[:3]].tolist())
        shown = ", ".join(str(node) for part in names for node in part)
        return (
            f"the active set of the walls did not converge in {_ROUNDS} solves"
            f"{f' (nodes {shown})' if shown else ''}; reduce time.step"
        )

    def _check_links(
        self, w: np.ndarray, x: np.ndarray, g: np.ndarray, noise: float, slack: float
    ) -> tuple[bool, np.ndarray]:
        """Whether links are kept at positions (owned, 3), and what of the imbalance walls must bear. Collective.

        Links that were not expected to be met, and were, are in the next solve.
        """
        settled, met = True, []
        if self.links:
            turned, g = g.copy(), g.copy()
            if self._frames is not None:
                at = self._frames.nodes
                turned[at] = np.einsum("nji,nj->ni", self._frames.inverse, g[at])
        for link in self._all_links:
            if link not in self.links:
                if link.broken(x, slack):
                    met.append(link)
                continue
            link.solve_forces(w, turned, self._bounds[0], noise)
            link.push(g, -1.0)
            try:
                settled &= link.kept(x, slack)
            except NotConverged as failure:
                raise NotConverged(f"step {self.state.step + 1}, t = {self.balance.time:.6g} s: {failure}") from failure
        self.links = [link for link in self._all_links if link in self.links or link in met]
        if not settled:
            self._link_rounds += 1
            if self._link_rounds >= _ROUNDS:
                raise NotConverged(
                    f"step {self.state.step + 1}, t = {self.balance.time:.6g} s: constraints and positions did not "
                    f"agree in {_ROUNDS} solves; reduce time.step"
                )
        return settled and not met, g

    def _strengths(self, w: np.ndarray, g: np.ndarray, noise: float) -> np.ndarray:
        frames = self._frames
        at = frames.nodes
        lower, upper = self._bounds
        active = np.zeros((len(at), 3), dtype=np.int8)
        turned = np.einsum("nji,nj->ni", frames.inverse, g[at])
        active[(w[at] <= lower[at]) & (turned > noise)] = -1
        active[(w[at] >= upper[at]) & (turned < -noise)] = 1
        return self.contact.strengths(frames, turned, active)

    def _unexpected(self, beyond: np.ndarray, x: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
        """Nodes (k,) beyond walls that no bound on them stands for, and which walls these are (k, walls)."""
        contact = self.contact
        concerned = contact.concerned(beyond, x[beyond], self._shifts)
        normals, offsets = contact.planes(concerned, x[beyond], self._shifts)
        gaps = np.einsum("iwk,ik->iw", normals, x[beyond]) - offsets
        broken = gaps < -tolerance
        if self._frames is not None:
            place = np.searchsorted(self.candidates, beyond)
            known = place < len(self.candidates)
            known[known] = self.candidates[place[known]] == beyond[known]
            # what a bound of its own keeps is kept to rounding of the coordinates; supports decide over walls
            place = place[known]
            broken[known] &= (self._frames.rows[place] < 0) | self._frames.shared[place]
            if contact.ties.any:
                broken &= ~contact.ties.held[beyond][:, None]
        thin = (np.where(contact.fixed[beyond][:, None, :], 0.0, normals) ** 2).sum(axis=2) <= 1e-12
        broken &= ~thin
        met = broken.any(axis=1)
        return beyond[met], broken[met]

    def _misaligned(self) -> bool:
        """Whether a wall presses on the row of an almost parallel one that does not: the force is off its normal."""
        frames, pressing = self._frames, self.strengths > 0.0
        astray = pressing & frames.shared
        if not astray.any():
            return False
        for node, wall in np.argwhere(astray):
            own = (frames.rows[node] == frames.rows[node, wall]) & ~frames.shared[node]
            turn = np.abs(
                frames.normals[node, wall] - frames.signs[node, wall] * frames.basis[node, frames.rows[node, wall]]
            )
            if turn.max() > 1e-12 and not (pressing[node] & own).any():
                return True
        return False

    def _off_surface(self, x: np.ndarray, tolerance: float) -> bool:
        """Whether a node pressed on a curved wall is off its surface, or was held by the plane of another point.

        One that the wall does not press may keep the plane of another point and be beyond the wall for all that.
        """
        at = self._frames.nodes
        for k in np.flatnonzero(~self.contact.flat):
            pressed = self.strengths[:, k] > 0.0
            passed = ~pressed & (self._frames.rows[:, k] >= 0)
            if passed.any() and (self.contact.gap(k, x[at[passed]], self._shifts) < -tolerance).any():
                return True
            if pressed.any():
                place = x[at[pressed]] - self._shifts[k]
                normals, offsets = self.contact.walls[k].planes(place)
                gap = np.einsum("ij,ij->i", normals, place) - offsets
                if np.abs(gap).max() > tolerance or np.abs(normals - self._frames.normals[pressed, k]).max() > 1e-12:
                    return True
        return False

    def _join(self, joined: np.ndarray, broken: np.ndarray, x: np.ndarray) -> None:
        """The candidates of the next round and the order of their walls: broken first, then the pressing ones."""
        contact = self.contact
        known = np.empty(0, dtype=np.int64) if self.candidates is None else self.candidates
        nodes = np.union1d(known, joined)
        concerned = np.zeros((len(nodes), len(contact.walls)), dtype=bool)
        concerned[np.searchsorted(nodes, joined)] = broken
        if self.candidates is not None:
            place = np.searchsorted(nodes, known)
            concerned[place] |= self._concerned
        normals, offsets = contact.planes(concerned, x[nodes], self._shifts)
        rank = np.einsum("iwk,ik->iw", normals, x[nodes]) - offsets
        if self.candidates is not None:
            pressing = self.strengths > 0.0
            largest = max(float(self.strengths.max(initial=0.0)), 1e-300)
            held = rank[place]
            held[pressing] = -1e-13 * self.model.length * (1.0 + self.strengths[pressing] / largest)
            rank[place] = held
        self.candidates, self._concerned, self._rank = nodes, concerned, rank

    def forces(self, u: np.ndarray) -> tuple[np.ndarray, WallForces, np.ndarray]:
        """Contact forces (owned, 3) [N], sums per wall, and which owned nodes walls hold, at the solution."""
        total = np.zeros_like(u)
        for link in self._all_links:
            if link not in self.links:
                link.release()
            link.push(total)
        held = np.zeros(len(u), dtype=bool)
        walls = self.contact.nothing
        if self._frames is not None:
            at = self._frames.nodes
            force = self.strengths[:, :, None] * self._frames.normals
            friction = 0.0
            if self.friction is not None:
                force += self.friction.drag
                friction = self.friction.dissipated(at, (self.balance.predictor + u)[at])
            touching = self.strengths > 0.0
            if self._tied is not None:
                tied, owners, _ = self._tied
                force[tied, owners] = self._pull[tied]
                touching[tied, owners] = True
            walls = self.contact.sums(at, force, (self.balance.predictor + u)[at], touching, friction)
            total[at] += force.sum(axis=1)
            held[at] = touching.any(axis=1)
        return total, walls, held

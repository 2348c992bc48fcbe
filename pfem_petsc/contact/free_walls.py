"""Walls with mass, which move under the contact forces; those with inertia also turn, freely or about a hinge."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np
from mpi4py import MPI

from ..errors import SimulationFailure
from ..integrators.base import Balance, Scheme, State
from ..tolerances import TIME
from .rotations import turn_bodies, turns_by, vectors_of

if TYPE_CHECKING:
    from .walls.base import WallKeys


_NONE = np.empty((0, 3))
_ITERATIONS = 200
_ROUNDED = 100.0  # moves of up to so many tolerances that do not get smaller are those of rounding
_FULL_MOVES = 20  # Newton's method converges after a few active sets, or else alternates between some of them


class TurnsTooFarError(SimulationFailure):
    """A wall turns too far in a step, which whoever makes the step names. Raised on all ranks."""


Answer = tuple[np.ndarray, Callable[[], np.ndarray] | None]


class BodyMotion(NamedTuple):
    """Walls with mass (f,) and those of them that turn (t,) at an instant: velocities of the centres and positions of
    the centres of mass (f, 3), angular momenta about the centres and angular velocities (t, 3)."""

    velocity: np.ndarray
    place: np.ndarray
    momentum: np.ndarray
    spin: np.ndarray


class FreeWalls:
    """The walls of a case that have a mass, if there are any; the same on all ranks.

    A wall without inertia is a particle of the scheme. One with inertia is a second one: its velocity is the angular
    momentum about the centre, which the moments of forces change as forces do that of a particle, and its position the
    integral of that over time. Divided by mass and radius of gyration, these are m/s and m. So the scheme conserves
    angular momentum as it does momentum. The turn of a step follows from the integral over it:
    :func:`~pfem_petsc.contact.rotations.steps_of_bodies`.

    Attributes
    ----------
    any : whether there are such walls
    at : (f,) indices of these walls among all walls of the case
    turners : (t,) those of them, from 0 to f, that have inertia
    hinged : (f,) bool, walls that only turn about an axis
    centres : (f, 3) centres of mass at rest, of hinged walls points of the axis [m]
    inertia : (t, 3, 3) about them [kg m2] in the axes of the wall at rest; of hinged walls that about the axis in all
        directions, of which the others do not matter
    state : of the particles (f + t, 3); x of the first f are displacements [m]
    turns : (t, 3, 3) from rest to the state
    weight : (f, 3) [N], zero where gravity does not act
    moves : how often the walls have been placed anew; none has moved while it is the same
    """

    def __init__(
        self,
        walls: Sequence[WallKeys],
        scheme: Scheme | None = None,
        comm: MPI.Comm | None = None,
        gravity: tuple[float, float, float] = (0.0, 0.0, 0.0),
        centres: np.ndarray = _NONE,  # of mass, of all walls at rest [m]
    ) -> None:
        self.at = np.array([k for k, wall in enumerate(walls) if wall.mass is not None], dtype=np.int64)
        mine = [walls[k] for k in self.at]
        self.any, n = len(mine) > 0, len(mine)
        self.scheme, self.comm = scheme, comm
        self.mass = np.array([wall.mass for wall in mine], dtype=float)
        self._names = [wall.name for wall in mine]
        self.hinged = np.array([wall.hinge is not None for wall in mine], dtype=bool)
        self.turners = np.array([i for i in range(n) if mine[i].inertia is not None], dtype=np.int64)
        heavy = np.array([wall.gravity for wall in mine], dtype=bool)
        self.weight = np.where(heavy, self.mass, 0.0)[:, None] * np.array(gravity)
        self.centres = centres[self.at].copy()
        self._arms = np.zeros((n, 3))  # of the centres of mass at rest
        tensors, self._along = np.zeros((len(self.turners), 3, 3)), np.tile(np.eye(3), (len(self.turners), 1, 1))
        for j, i in enumerate(self.turners):
            tensors[j] = mine[i].tensor
            if mine[i].hinge is not None:
                axis = np.array(mine[i].hinge.axis) / np.linalg.norm(mine[i].hinge.axis)
                self._arms[i] = self.centres[i] - mine[i].hinge.centre
                self.centres[i] = mine[i].hinge.centre
                about = axis @ tensors[j] @ axis + self.mass[i] * np.square(np.cross(axis, self._arms[i])).sum()
                tensors[j], self._along[j] = about * np.eye(3), np.outer(axis, axis)
        self.inertia, mass = tensors, self.mass[self.turners]
        radii = np.sqrt(np.linalg.eigvalsh(tensors).max(axis=1, initial=0.0) / mass)
        self._radii, self._scale = radii[:, None], (mass * radii)[:, None]
        self._masses = np.append(self.mass, mass)[:, None]
        self._rows = [np.arange(3 * i, 3 * i + 3) for i in range(n)]  # of the unknowns of each wall
        for j, i in enumerate(self.turners):
            self._rows[i] = np.append(self._rows[i], np.arange(3 * (n + j), 3 * (n + j) + 3))
        self.turns = np.tile(np.eye(3), (len(self.turners), 1, 1))
        speeds = np.array([wall.velocity or (0.0, 0.0, 0.0) for wall in mine], dtype=float).reshape(-1, 3)
        spins = np.array([mine[i].angular_velocity or (0.0, 0.0, 0.0) for i in self.turners], dtype=float)
        v = np.vstack([speeds, np.einsum("tij,tj->ti", tensors, spins.reshape(-1, 3)) / self._scale])
        self.state = State(np.zeros_like(v), v, *(np.zeros_like(v) for _ in range(5)))
        self._balance: Balance | None = None
        self._u = np.zeros_like(v)
        self._times, self._ends = (0.0, 0.0), (self.state.x, self.state.x)  # of the step
        self._start, self._vectors = self.turns, np.zeros((len(self.turners), 3))  # turns at its start, and in it
        self._slopes = np.zeros_like(self.turns)  # of small rotations at its end by the unknowns
        self.moves = self._state_moves = int(self.any)

    def follow(self, earlier: Self) -> None:
        """Go on from the motion of the same walls in an earlier stage."""
        for name in ("x", "v"):
            setattr(self.state, name, getattr(earlier.state, name).copy())
        self._ends = self.state.x, self.state.x
        self.turns = self._start = earlier.turns.copy()
        self._place()

    def start(self, h: float) -> None:
        """Initialise the acceleration and the scheme's memory."""
        if not self.any:
            return
        self.state.a = self._load(0.0) / self._masses
        self.scheme.start(self.state, h)

    @property
    def begun(self) -> bool:
        """Whether a step has begun since the start or a restart."""
        return self._balance is not None

    def begin(self, time: float, h: float) -> None:
        """Set the balance of a step from ``time``; schemes that solve for the next position move the walls first."""
        if not self.any:
            return
        state = self.state
        if self.scheme.solves_next_position and time > state.time:
            before = state.x.copy()
            self.scheme.advance(state, h)
            self.turns = turns_by(self._turn(state.x - before)[0]) @ self.turns
        state.time = time
        self._balance, self._start = self.scheme.balance(state, h), self.turns
        self._known = 0.0 if self._balance.a_hat is None else self._balance.a_hat
        self._times, self._ends = (time, self._balance.time), (state.x.copy(), state.x)
        self._place()
        self._move(self._u)

    def finish(self, h: float, end: float) -> None:
        """Complete the walls' state with the solution; ``end`` is the time of the truss then, to the last bit."""
        if not self.any:
            return
        state = self.state
        self.scheme.finish(state, self._balance, self._u, h)
        if not self.scheme.solves_next_position:
            state.time, before = end, self._ends[0]
            vectors, _ = self._turn(state.x - before)
            self.turns = turns_by(vectors) @ self._start
            if self.scheme.solves_end:  # else contact holds at the end of the balance
                self._times, self._ends, self._vectors = (self._times[0], end), (before, state.x.copy()), vectors
            self._place()

    def _place(self) -> None:
        """Take account of another state."""
        self.moves += 1
        self._state_moves = self.moves

    def version(self, time: float) -> int:
        """Return a number that changes when the walls are elsewhere at a time [s]: they move as they are solved for."""
        return self._state_moves if time == self.state.time else self.moves

    def _move(self, u: np.ndarray) -> None:
        """Move the walls to the increments (f + t, 3) of the step being solved [m]."""
        self._u, self.moves = u, self.moves + 1
        self._ends = self._ends[0], self._balance.predictor + u
        self._vectors, self._slopes = self._turn(self._ends[1] - self._ends[0])

    @property
    def way(self) -> tuple[np.ndarray, np.ndarray]:
        """Displacements (f, 3) [m] at the end of the step being solved, and rotation vectors (t, 3) [rad] in it."""
        return self._ends[1][: len(self.at)], self._vectors

    def strays(self, way: tuple[np.ndarray, np.ndarray], limits: np.ndarray) -> bool:
        """Return whether any wall has moved farther from where it was by a ``way`` than limits (2,) [m], [rad]."""
        changes = (np.sqrt(((one - other) ** 2).sum(axis=1)) for one, other in zip(self.way, way, strict=True))
        return any(change.max(initial=0.0) > limit for change, limit in zip(changes, limits, strict=True))

    def _turn(self, ways: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the rotation vectors (t, 3) [rad] by which walls turn from the present state while the particles go
        ``ways`` (f + t, 3) [m], and the derivatives (t, 3, 3) of small rotations at the end by these ways [rad/m].

        Raises
        ------
        TurnsTooFarError
            On all ranks, if a wall turns too far.
        """
        if not len(self.turners):
            return self._vectors, self._slopes
        momenta = self._scale * ways[len(self.at) :]  # their integrals
        vectors, slopes = turn_bodies(self.turns, self._scale, self.inertia, ways[len(self.at) :])
        if not np.isfinite(vectors).all():
            # the rotation itself is not known: that of the angular velocity at the start of the step
            own = np.einsum("tji,tj->ti", self.turns, momenta)
            angles = np.linalg.norm(np.linalg.solve(self.inertia, own[:, :, None])[:, :, 0], axis=1)
            j = int(np.argmax(np.where(np.isfinite(vectors).all(axis=1), -1.0, angles)))
            raise TurnsTooFarError(
                f"wall {self._names[self.turners[j]]!r} with inertia turns by about {angles[j]:.3g} rad in the step; "
                "turns of more than about a radian in a step do not determine its motion; reduce time.step"
            )
        return vectors, slopes

    def _part(self, time: float) -> float:
        """Return the part of the step that has gone by at a time [s]."""
        begin, end = self._times
        part = (time - begin) / (end - begin) if end > begin else 0.0
        return 0.0 if part < TIME else 1.0 if part > 1.0 - TIME else part

    def displacements(self, time: float) -> np.ndarray:
        """Return displacements (f, 3) [m] at a time of the step being solved, or the last one [s]."""
        return (self.state.x if time == self.state.time else self._at(self._part(time)))[: len(self.at)]

    def _at(self, part: float) -> np.ndarray:
        before, after = self._ends
        return before if part == 0.0 else after if part == 1.0 else before + part * (after - before)

    def turned(self, time: float) -> np.ndarray:
        """Return matrices (t, 3, 3) of the turns from rest at a time of the step being solved, or the last one [s]."""
        return self.turns if time == self.state.time else self._turned(self._part(time))

    def _turned(self, part: float) -> np.ndarray:
        return turns_by(part * self._vectors) @ self._start if part else self._start

    def pivots(self, part: float) -> np.ndarray:
        """Return the places (f, 3) of the centres at a part of the step being solved [m]."""
        return self.centres + self._at(part)[: len(self.at)]

    def unpushed(self) -> tuple[np.ndarray, np.ndarray]:
        """Return displacements (f, 3) [m] and turns (t, 3, 3) at the end of the step being solved, without contact."""
        balance = self._balance
        free = balance.predictor + (self._load(balance.acting) / self._masses - self._known) / balance.alpha
        return free[: len(self.at)], turns_by(self._turn(free - self._ends[0])[0]) @ self._start

    def _wrench(self, force: np.ndarray, moment: np.ndarray) -> np.ndarray:
        """Return the forces (f + t, 3) on the particles of forces and moments about the centres (f, 3) [N]."""
        about = np.einsum("tij,tj->ti", self._along, moment[self.turners])
        return np.vstack([np.where(self.hinged[:, None], 0.0, force), about / self._radii])

    def _load(self, part: float) -> np.ndarray:
        """Return the weights of the particles (f + t, 3) [N]."""
        if not self.hinged.any():
            return self._wrench(self.weight, np.zeros_like(self.weight))
        return self._wrench(self.weight, np.cross(self._reach(self._turned(part)), self.weight))

    def _reach(self, turns: np.ndarray) -> np.ndarray:
        """Return the centres of mass (f, 3) from the centres [m]."""
        arms = self._arms.copy()
        arms[self.turners] = np.einsum("tij,tj->ti", turns, arms[self.turners])
        return arms

    def twists(self, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return velocities of the centres [m/s] and angular velocities [rad/s] (f, 3) of those of the particles
        (f + t, 3) in the present state."""
        spins, turns = np.zeros((len(self.at), 3)), self.turns
        own = np.einsum("tji,tj->ti", turns, self._scale * v[len(self.at) :])
        spins[self.turners] = np.einsum("tij,tj->ti", turns, np.linalg.solve(self.inertia, own[:, :, None])[:, :, 0])
        return v[: len(self.at)], spins

    @property
    def motion(self) -> BodyMotion:
        """The motion in the present state."""
        n, (v, spins) = len(self.at), self.twists(self.state.v)
        place = self.centres + self.state.x[:n] + self._reach(self.turns)
        return BodyMotion(v, place, self._scale * self.state.v[n:], spins[self.turners])

    @property
    def rotation(self) -> np.ndarray:
        """Rotation vectors from rest [rad], angular velocities [rad/s] and angular momenta about the centres [kg m2/s]
        of the walls with inertia (t, 9) in the present state."""
        motion = self.motion
        return np.hstack([vectors_of(self.turns), motion.spin, motion.momentum])

    @property
    def kinetic(self) -> float:
        """Kinetic energy of the walls [J]."""
        motion = self.motion
        return 0.5 * float((self.mass[:, None] * motion.velocity**2).sum() + (motion.momentum * motion.spin).sum())

    def works(self, before: BodyMotion, after: BodyMotion, h: float) -> tuple[float, float, float]:
        """Return the work of moments of contact on the truss, of weight, and the numerical dissipation [J] in a step
        of ``h`` [s].

        Angular momentum times the mean angular velocity is the work of moments. What the energy changes by beside, as
        the inertia turns with the wall, is of the scheme.
        """
        fallen, moved = after.place - before.place, 0.5 * h * (before.velocity + after.velocity)
        weights = (self.weight * fallen).sum(axis=1)
        gained = 0.5 * float(((after.momentum - before.momentum) * (before.spin + after.spin)).sum())
        twisted = 0.5 * float((before.momentum * after.spin - after.momentum * before.spin).sum())
        lost = float((self.weight * (fallen - moved))[~self.hinged].sum())
        return float(weights[self.hinged].sum()) - gained, float(weights.sum()), lost - twisted

    def changes(self, earlier: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """Return by how much velocities of the centres and angular velocities (f, 3) differ without contact: they are
        those of the state with ``earlier`` velocities (f + t, 3), or None of the balance without its contact forces."""
        if earlier is not None:
            return self.twists(earlier - self.state.v)
        balance = self._balance
        pushed = self._load(balance.acting) / self._masses - (balance.alpha * self._u + self._known)
        return self.twists(balance.eta / balance.alpha * pushed)

    def inertias(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the motions (k, 6) that wall i has, of translations and rotations, and its inertia in them (k, k)."""
        turner, whole = np.flatnonzero(self.turners == i), np.zeros((6, 6))
        whole[:3, :3] = self.mass[i] * np.eye(3)
        motions = np.eye(6)[:3]
        if len(turner):
            j, turns = turner[0], self.turns[turner[0]]
            whole[3:, 3:], motions = turns @ self.inertia[j] @ turns.T, np.eye(6)
            if self.hinged[i]:
                motions = np.append(np.zeros(3), np.linalg.eigh(self._along[j])[1][:, -1])[None]
        return motions, motions @ whole @ motions.T

    def solve(self, forces: Callable[[], Answer], tolerance: float) -> bool:
        """Solve for the walls' increments; return whether the iteration converged, equal on all ranks. Collective.

        Parameters
        ----------
        forces : returns, where the walls are at the end of the step, this rank's sums of their forces on the truss [N]
            and of the moments of these about the origin [N m] (2, f, 3), and what returns that of the derivatives
            (f, 6, 6) of force and moment about the centre by displacement and small rotation of the wall, or None where
            these are not known
        tolerance : of the walls' positions [m]
        """
        if not self.any:
            forces()
            return True
        balance, masses = self._balance, self._masses
        inertial = masses * self._known
        weight = np.repeat(balance.alpha * masses, 3)
        u = ((self._load(0.0) - inertial) / (balance.alpha * masses)).ravel()
        matrix, earlier, last = np.diag(weight), None, np.inf

        def evaluate(u: np.ndarray) -> tuple[np.ndarray, Callable | None, np.ndarray]:
            self._move(u.reshape(-1, 3))
            pushes, slope = forces()
            pushes = pushes.copy()
            self.comm.Allreduce(MPI.IN_PLACE, pushes)
            about = pushes[1] - np.cross(self.pivots(balance.acting), pushes[0])
            force = self._wrench(pushes[0], about) + (inertial - self._load(balance.acting))
            return force, slope, weight * u + force.ravel()

        force, slope, residual = evaluate(u)
        for iteration in range(_ITERATIONS):
            if np.abs(np.linalg.solve(matrix, residual)).max() <= tolerance:
                break
            if slope is not None:
                derivatives = slope()
                self.comm.Allreduce(MPI.IN_PLACE, derivatives)
                matrix = self._matrix(weight, derivatives)
            elif earlier is not None:
                # Broyden: the matrix nearest to the previous one that is consistent with the last move
                du, dr = u - earlier[0], residual - earlier[1]
                size = float(du @ du)
                if size > 0.0:
                    matrix = matrix + np.outer(dr - matrix @ du, du) / size
            earlier = u, residual
            move = np.linalg.solve(matrix, -residual)
            before, last = last, float(np.abs(move).max())
            rounded = last <= _ROUNDED * tolerance and (0.5 * before <= last or iteration > _FULL_MOVES)
            if last <= tolerance or rounded:
                break
            u = u + move
            force, slope, residual = evaluate(u)
            start = -float(move @ earlier[1])
            if iteration < _FULL_MOVES or start <= 0.0:
                continue
            # the active set changed within the move, where the slope no longer holds: bisect along the move
            least, most, part = 0.0, 1.0, 1.0
            size = np.abs(move).max()
            while abs(along := float(move @ residual)) > 0.5 * start and not (along < 0.0 and part == 1.0):
                least, most = (least, part) if along > 0.0 else (part, most)
                if (most - least) * size <= tolerance:
                    return False
                part = 0.5 * (least + most)
                u = earlier[0] + part * move
                force, slope, residual = evaluate(u)
        else:
            return False
        # the acceleration follows from the force and not from the position, so that momentum is conserved to rounding
        self._move(-force / (balance.alpha * masses))
        return True

    def _matrix(self, weight: np.ndarray, slope: np.ndarray) -> np.ndarray:
        """Return the derivatives (3 (f + t), 3 (f + t)) of the residual of the walls' balances from those (f, 6, 6) of
        :meth:`solve`, and the inertia (3 (f + t),) [N/m]."""
        matrix, n = np.diag(weight), len(self.at)
        ways, rows = np.zeros((n, 6, 6)), np.zeros((n, 6, 6))
        ways[:, :3, :3] = rows[:, :3, :3] = np.where(self.hinged[:, None, None], 0.0, np.eye(3))
        ways[self.turners, 3:, 3:] = self._slopes @ self._along
        rows[self.turners, 3:, 3:] = self._along / self._radii[:, :, None]
        for at, part in zip(self._rows, rows @ slope @ ways, strict=True):
            matrix[np.ix_(at, at)] += part[: len(at), : len(at)]
        return matrix

    def step_changed(self, scheme: Scheme) -> None:
        """Notify the scheme that the step size has changed."""
        if self.any:
            scheme.step_changed(self.state)

    _KEPT = ("_u", "_times", "_ends", "_start", "_vectors", "turns")

    def kept(self) -> dict[str, Any] | None:
        """Return the state for a checkpoint, None if no wall has mass."""
        if not self.any:
            return None
        state = self.state
        memory = {name: array.tolist() for name, array in state.memory.items()}
        step = {name: np.asarray(getattr(self, name)).tolist() for name in self._KEPT}
        return {name: getattr(state, name).tolist() for name in ("x", "v", "a")} | {
            "time": state.time,
            "memory": memory,
            "step": step,
        }

    def load_state(self, kept: dict[str, Any] | None) -> None:
        """Restore the state from a checkpoint."""
        if kept is None:
            return
        state, shape = self.state, self.state.x.shape
        for name in ("x", "v", "a"):
            setattr(state, name, np.array(kept[name], dtype=float).reshape(shape))
        state.time = kept["time"]
        for name, array in kept["memory"].items():
            state.memory[name] = np.array(array, dtype=float).reshape(shape)
        for name in self._KEPT:
            setattr(self, name, np.array(kept["step"][name], dtype=float).reshape(np.shape(getattr(self, name))))
        self._place()

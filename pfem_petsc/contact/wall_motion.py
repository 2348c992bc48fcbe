"""Motion of walls: prescribed displacements and rotations, and walls with mass that move under the contact forces."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np
from mpi4py import MPI

from ..integrators.base import Balance, Scheme, State
from ..mechanics.motion import Motion, motion_of, rotation_of

if TYPE_CHECKING:
    from .walls.base import WallKeys


_ITERATIONS = 200
_LATEST = 8  # times whose poses are kept
_FULL_MOVES = 20  # Newton's method converges after a few active sets, or else alternates between some of them

Answer = tuple[np.ndarray, np.ndarray | None]


class Poses(NamedTuple):
    """Where walls (w,) are at a time [s]: a point X of a wall at rest is at ``turns`` X + ``shifts``; (w, 3, 3) and
    (w, 3) [m]. The former is (0, 3, 3) if no wall turns."""

    shifts: np.ndarray
    turns: np.ndarray
    time: float = 0.0

    def rest(self, k: int, x: np.ndarray) -> np.ndarray:
        """Return where points of wall k at (m, 3) are at rest."""
        x = x - self.shifts[k]
        return x @ self.turns[k] if len(self.turns) else x

    def reached(self, k: int, x: np.ndarray) -> np.ndarray:
        """Return where points of wall k are that are at (m, 3) at rest."""
        return self.turned(k, x) + self.shifts[k]

    def carried(self, walls: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Return where points of walls (m,) are that are at (m, 3) at rest, each of one wall."""
        return (np.einsum("mij,mj->mi", self.turns[walls], x) if len(self.turns) else x) + self.shifts[walls]

    def turned(self, k: int, vectors: np.ndarray) -> np.ndarray:
        """Return vectors (m, 3) that turn with wall k, given at rest."""
        return vectors @ self.turns[k].T if len(self.turns) else vectors

    def ways(self, later: Self, x: np.ndarray) -> np.ndarray:
        """Return how far the points of all walls at (m, 3) are from there at ``later`` poses, (m, w, 3) [m]."""
        if not len(self.turns):
            return np.broadcast_to(later.shifts - self.shifts, (len(x), *self.shifts.shape))
        turns = later.turns @ self.turns.swapaxes(1, 2)
        moved = np.einsum("wij,mwj->mwi", turns, x[:, None, :] - self.shifts)
        return moved + later.shifts - x[:, None, :]


def turns_about(axes: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Return matrices (w, 3, 3) of rotations by angles (w,) [rad] about unit axes (w, 3), by Rodrigues' formula."""
    across = np.cross(np.eye(3), axes[:, None, :])  # the matrices of axis x ...
    sine, versed = np.sin(angles), 2.0 * np.sin(0.5 * angles) ** 2
    return np.eye(3) + sine[:, None, None] * across + versed[:, None, None] * (across @ across)


class FreeWalls:
    """The walls of a case that have a mass, if there are any; the same on all ranks.

    Attributes
    ----------
    any : whether there are such walls
    at : (f,) indices of these walls among all walls of the case
    state : of the walls; x is the displacement from the initial position (f, 3)
    weight : (f, 3) [N], zero where gravity does not act
    """

    def __init__(
        self,
        walls: Sequence[WallKeys],
        scheme: Scheme | None = None,
        comm: MPI.Comm | None = None,
        gravity: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        self.at = np.array([k for k, wall in enumerate(walls) if wall.mass is not None], dtype=np.int64)
        self.any = len(self.at) > 0
        self.mass = np.array([walls[k].mass for k in self.at], dtype=float)
        self.scheme, self.comm = scheme, comm
        speeds = np.array([walls[k].velocity or (0.0, 0.0, 0.0) for k in self.at], dtype=float).reshape(-1, 3)
        n = len(self.at)
        heavy = np.array([walls[k].gravity for k in self.at], dtype=bool)
        self.weight = np.where(heavy, self.mass, 0.0)[:, None] * np.array(gravity)
        self.state = State(np.zeros((n, 3)), speeds, *(np.zeros((n, 3)) for _ in range(5)))
        self._balance: Balance | None = None
        self._u = np.zeros((n, 3))

    def start(self, h: float) -> None:
        """Initialise the acceleration and the scheme's memory."""
        if not self.any:
            return
        self.state.a = self.weight / self.mass[:, None]
        self.scheme.start(self.state, h)

    def begin(self, time: float, h: float) -> None:
        """Set the balance of a step from ``time``; schemes that solve for the next position move the walls first."""
        if not self.any:
            return
        if self.scheme.solves_next_position and time > self.state.time:
            self.scheme.advance(self.state, h)
        self.state.time = time
        self._balance = self.scheme.balance(self.state, h)

    def finish(self, h: float, end: float) -> None:
        """Complete the walls' state with the solution; ``end`` is the time of the truss then, to the last bit."""
        if not self.any:
            return
        self.scheme.finish(self.state, self._balance, self._u, h)
        if not self.scheme.solves_next_position:
            self.state.time = end

    @property
    def kinetic(self) -> float:
        """Kinetic energy of the walls [J]."""
        return 0.5 * float((self.mass[:, None] * self.state.v**2).sum())

    @property
    def balanced(self) -> np.ndarray:
        """Return the accelerations (f, 3) of the last balance [m/s2]."""
        if not self.any:
            return self._u
        known = 0.0 if self._balance.a_hat is None else self._balance.a_hat
        return self._balance.alpha * self._u + known

    def displacements(self, time: float) -> np.ndarray:
        """Return displacements (f, 3) [m] at the state's time, or at the end of the step being solved."""
        if self._balance is None or time == self.state.time:
            return self.state.x
        return self._balance.predictor + self._u

    def unpushed(self) -> np.ndarray:
        """Return displacements (f, 3) [m] at the end of the step being solved, without contact."""
        balance = self._balance
        known = 0.0 if balance.a_hat is None else balance.a_hat
        return balance.predictor + (self.weight / self.mass[:, None] - known) / balance.alpha

    def solve(self, forces: Callable[[], Answer], tolerance: float) -> bool:
        """Solve for the walls' increments; return whether the iteration converged, equal on all ranks. Collective.

        Parameters
        ----------
        forces : returns, for the current :meth:`displacements`, this rank's sums of the walls' forces on the truss
            (f, 3) [N] and of their derivatives dF/du (f, 3, 3) [N/m], or None where these are not known
        tolerance : of the walls' positions [m]
        """
        if not self.any:
            forces()
            return True
        balance = self._balance
        weight = np.repeat(balance.alpha * self.mass, 3)
        rest = -self.weight if balance.a_hat is None else self.mass[:, None] * balance.a_hat - self.weight
        u = (-rest / (balance.alpha * self.mass[:, None])).ravel()
        matrix, earlier = np.diag(weight), None

        def evaluate(u: np.ndarray) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
            self._u = u.reshape(-1, 3)
            force, slope = forces()
            force = force.copy()
            self.comm.Allreduce(MPI.IN_PLACE, force)
            return force, slope, weight * u + rest.ravel() + force.ravel()

        force, slope, residual = evaluate(u)
        for iteration in range(_ITERATIONS):
            if slope is not None:
                slope = slope.copy()
                self.comm.Allreduce(MPI.IN_PLACE, slope)
                matrix = np.diag(weight)
                for k in range(len(self.at)):
                    matrix[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += slope[k]
            elif earlier is not None:
                # Broyden: the matrix nearest to the previous one that is consistent with the last move
                du, dr = u - earlier[0], residual - earlier[1]
                size = float(du @ du)
                if size > 0.0:
                    matrix = matrix + np.outer(dr - matrix @ du, du) / size
            earlier = u, residual
            move = np.linalg.solve(matrix, -residual)
            if np.abs(move).max(initial=0.0) <= tolerance:
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
        self._u = (-force - rest) / (balance.alpha * self.mass[:, None])
        return True

    def step_changed(self, scheme: Scheme) -> None:
        """Notify the scheme that the step size has changed."""
        if self.any:
            scheme.step_changed(self.state)

    def kept(self) -> dict[str, Any] | None:
        """Return the state for a checkpoint, None if no wall has mass."""
        if not self.any:
            return None
        state = self.state
        memory = {name: array.tolist() for name, array in state.memory.items()}
        return {
            "x": state.x.tolist(),
            "v": state.v.tolist(),
            "a": state.a.tolist(),
            "time": state.time,
            "memory": memory,
            "increment": self._u.tolist(),
        }

    def load_state(self, kept: dict[str, Any] | None) -> None:
        """Restore the state from a checkpoint."""
        if kept is None:
            return
        shape = self.state.x.shape
        for name in ("x", "v", "a"):
            setattr(self.state, name, np.array(kept[name], dtype=float).reshape(shape))
        self.state.time = kept["time"]
        self._u = np.array(kept["increment"], dtype=float).reshape(shape)
        for name, array in kept["memory"].items():
            self.state.memory[name] = np.array(array, dtype=float).reshape(shape)


class WallMotion:
    """Displacements and rotations of all walls of a case.

    Attributes
    ----------
    moving, turning : (w,) bool, walls that move, and those of them that turn
    bodies : FreeWalls, the walls with mass
    held : Poses at the start of a stage of walls that stay in force and rest there
    """

    def __init__(self, walls: Sequence[WallKeys], holds: bool = False) -> None:
        self._motions = [None if holds else motion_of(wall) for wall in walls]
        self._rotations = [None if holds else rotation_of(wall) for wall in walls]
        n = len(walls)
        self.turning = np.array([wall.rotation is not None for wall in walls], dtype=bool)
        self.held = Poses(np.zeros((n, 3)), np.tile(np.eye(3), (n if self.turning.any() else 0, 1, 1)))
        self._last: tuple[Poses, dict[float, Poses]] = self.held, {}
        self._axes, self._centres = np.zeros((2, n, 3))
        for k in np.flatnonzero(self.turning):
            axis = np.array(walls[k].rotation.axis)
            self._axes[k], self._centres[k] = axis / np.linalg.norm(axis), walls[k].rotation.centre
        self.bodies = FreeWalls([])  # until their scheme is known
        moves = [wall.velocity is not None or wall.motion is not None or wall.mass is not None for wall in walls]
        self.moving = np.array(moves, dtype=bool) | self.turning

    def _prescribed(self, motions: list[Motion | None], quantity: int, time: float, ahead: bool = True) -> np.ndarray:
        """Return the displacements, velocities or accelerations (w, 3) of motions at a time [s], zero for none."""
        values = np.zeros((len(motions), 3))
        for k, motion in enumerate(motions):
            if motion is not None:
                values[k] = motion.at(time, ahead=ahead)[quantity]
        return values

    def displacements(self, time: float) -> np.ndarray:
        """Return displacements (w, 3) [m] at a time [s], those of the centres of rotation of walls that turn."""
        displacements = self._prescribed(self._motions, 0, time)
        displacements[self.bodies.at] = self.bodies.displacements(time)
        return displacements

    def poses(self, time: float) -> Poses:
        """Return where walls are at a time [s], read-only."""
        if self.bodies.any:  # which move as they are solved for
            return self._poses(time)
        if self._last[0] is not self.held or len(self._last[1]) > _LATEST:
            self._last = self.held, {}
        known = self._last[1]
        if time not in known:
            known[time] = self._poses(time)
        return known[time]

    def _poses(self, time: float) -> Poses:
        held, bodies = self.held, self.bodies
        shifts, turns = held.shifts + self._prescribed(self._motions, 0, time), held.turns
        shifts[bodies.at] = bodies.displacements(time)
        if not len(turns):
            return Poses(shifts, turns, time)
        turned = turns_about(self._axes, self._prescribed(self._rotations, 0, time)[:, 0])
        turns = turned @ turns
        about = np.where(np.isin(np.arange(len(turns)), bodies.at)[:, None, None], turns, turned)
        return Poses(shifts + self._centres - np.einsum("wij,wj->wi", about, self._centres), turns, time)

    def schedule(self, times: np.ndarray) -> np.ndarray:
        """Return displacements [m] and velocities [m/s] (t, 2, w, 3) of walls with prescribed motion at times (t,) [s];
        at the kinks of a linear table the right limit."""
        values = np.zeros((len(times), 2, len(self._motions), 3))
        values[:, 0] = self.held.shifts
        for k, motion in enumerate(self._motions):
            if motion is not None:
                values[:, :, k] += motion.at(times)[:, :2]
        return values

    def turns(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return angles (t, w) [rad] and :class:`Poses` (t, w, 12), the elements of the turns and shifts, of walls with
        prescribed motion at times (t,) [s]."""
        size, angles = (len(times), len(self._motions)), np.zeros((len(times), len(self._motions)))
        for k, rotation in enumerate(self._rotations):
            if rotation is not None:
                angles[:, k] = rotation.at(times)[:, 0, 0]
        turned = turns_about(np.tile(self._axes, (len(times), 1)), angles.ravel()).reshape(*size, 3, 3)
        shifts = self.schedule(times)[:, 0] + self._centres - np.einsum("twij,wj->twi", turned, self._centres)
        if len(self.held.turns):
            turned = turned @ self.held.turns
        return angles, np.concatenate([turned.reshape(*size, 9), shifts], axis=2)

    @property
    def pivots(self) -> tuple[np.ndarray, np.ndarray]:
        """Unit axes of rotation and points of them at rest (w, 3) [m]; zero for walls that do not turn."""
        return self._axes, self._centres

    def rates(self, time: float, ahead: bool = False) -> np.ndarray:
        """Return velocities (w, 3) [m/s] at a time [s], those of the centres of rotation of walls that turn; at the
        kinks of a linear table the left limit, or the right one if ``ahead``."""
        rates = self._prescribed(self._motions, 1, time, ahead)
        rates[self.bodies.at] = self.bodies.state.v
        return rates

    def spins(self, time: float, ahead: bool = False) -> np.ndarray:
        """Return angular velocities (w, 3) [rad/s] at a time [s]."""
        return self._axes * self._prescribed(self._rotations, 1, time, ahead)[:, :1]

    def rates_at(self, x: np.ndarray, time: float, ahead: bool = False) -> np.ndarray:
        """Return the velocities (m, w, 3) [m/s] of the walls' points that are at (m, 3) at a time [s]."""
        rates = self.rates(time, ahead)
        if not self.turning.any():
            return np.broadcast_to(rates, (len(x), *rates.shape))
        return rates + np.cross(self.spins(time, ahead), self._arms(x, time))

    def _arms(self, x: np.ndarray, time: float) -> np.ndarray:
        """Return positions (m, w, 3) [m] of points (m, 3) relative to the centres of rotation."""
        return x[:, None, :] - (self._centres + self.displacements(time))

    def accelerations_at(self, x: np.ndarray, time: float) -> np.ndarray:
        """Return accelerations (m, w, 3) [m/s2] of the points at (m, 3) of walls with prescribed motion at a time
        [s]; zero for others."""
        accelerations = self._prescribed(self._motions, 2, time)
        if not self.turning.any():
            return np.broadcast_to(accelerations, (len(x), *accelerations.shape))
        arms, spins = self._arms(x, time), self.spins(time, ahead=True)
        twists = self._axes * self._prescribed(self._rotations, 2, time)[:, :1]
        return accelerations + np.cross(twists, arms) + np.cross(spins, np.cross(spins, arms))

    def torques(self, force: np.ndarray, moment: np.ndarray, time: float) -> np.ndarray:
        """Return the moments (w,) [N m] about the axes of rotation of forces (w, 3) with moments about the origin."""
        centres = self._centres + self.displacements(time)
        return np.einsum("wi,wi->w", self._axes, moment - np.cross(centres, force))

    def angles(self, time: float) -> np.ndarray:
        """Return the angles (w,) [rad] by which walls have turned at a time [s]."""
        return self._prescribed(self._rotations, 0, time)[:, 0]
